"""Live view of a simulation: MuJoCo's window, or a browser page without a display."""

from __future__ import annotations

import logging
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import cast

import mujoco
import numpy as np
import trimesh
import trimesh.visual

from xop_lerobot.plant.rendering import has_display

logger = logging.getLogger(__name__)

UPDATE_PERIOD = 0.05
"""Wall time between two updates of the view [s]."""

HOST = "127.0.0.1"
"""The browser view is only accessible from this machine."""

VISIBLE_GROUPS = 3
"""Geoms of groups 0 to 2 are shown, as by default in MuJoCo's own viewer."""


class Viewer(ABC):
    """Shows a simulation while it runs. `update` may be called at every step.

    Args:
        clock: Wall clock [s]; tests pass their own.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._next_update = -np.inf

    def update(self, data: mujoco.MjData) -> bool:
        """Show the positions in `data`, unless the last update was less than 50 ms ago.

        Returns:
            Whether the view was updated.
        """
        now = self._clock()
        if now < self._next_update:
            return False
        self._next_update = now + UPDATE_PERIOD
        self._show(data)
        return True

    @abstractmethod
    def _show(self, data: mujoco.MjData) -> None:
        """Show the positions in `data`."""

    @abstractmethod
    def close(self) -> None:
        """Stop showing; may be called twice."""


class WindowViewer(Viewer):
    """MuJoCo's own window; closing it does not stop the simulation."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        super().__init__()
        from mujoco.viewer import launch_passive  # noqa: PLC0415 opens the window system

        self._handle = launch_passive(model, data, show_left_ui=False, show_right_ui=False)

    def _show(self, data: mujoco.MjData) -> None:
        if self._handle.is_running():
            self._handle.sync()

    def close(self) -> None:
        """Close the window; may be called twice."""
        self._handle.close()


class BrowserViewer(Viewer):
    """A local web page that shows all bodies of the model.

    Each body is one node `/bodies/<name>`, made of its visible geoms; an update sends only the
    poses of bodies that moved, and nothing without a client.

    Args:
        model: Model to show.
        data: Its initial positions.
        port: Port of the page; the next free one is taken if it is in use.
        clock: Wall clock [s].
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        port: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(clock)
        import viser  # noqa: PLC0415 loads a web server

        self._server = viser.ViserServer(HOST, port, label="xop-lerobot", verbose=False)
        self._is_open = True
        self._nodes: dict[int, viser.SceneNodeHandle] = {}
        scene = self._server.scene
        scene.set_up_direction("+z")
        scene.add_grid(
            "/floor", infinite_grid=True, cell_size=0.5, section_size=1.0, fade_distance=25.0
        )
        for body, mesh in build_body_meshes(model).items():
            name = model.body(body).name or f"body_{body}"
            self._nodes[body] = scene.add_mesh_trimesh(f"/bodies/{name}", mesh)
        # Look at the robot from the front left, like the scene camera.
        self._server.initial_camera.position = (2.2, 1.6, 1.6)
        self._server.initial_camera.look_at = (0.0, 0.0, 0.8)
        self._shown: dict[int, np.ndarray] = {}
        self.update(data)

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{HOST}:{self._server.get_port()}"

    @property
    def body_ids(self) -> tuple[int, ...]:
        """Ids of the bodies that are shown."""
        return tuple(self._nodes)

    def get_shown_pose(self, body: int) -> np.ndarray:
        """Pose at which `body` is shown, x y z qw qx qy qz. Shape (7,)."""
        node = self._nodes[body]
        return np.concatenate([node.position, node.wxyz])

    def _show(self, data: mujoco.MjData) -> None:
        if not self._is_open:
            return
        with self._server.atomic():
            for body, node in self._nodes.items():
                pose = np.concatenate([data.xpos[body], data.xquat[body]])
                if body in self._shown and np.allclose(pose, self._shown[body], atol=1e-4):
                    continue
                self._shown[body] = pose
                node.position, node.wxyz = pose[:3], pose[3:]

    def close(self) -> None:
        """Stop the server; may be called twice."""
        if self._is_open:
            self._is_open = False
            self._server.stop()


def build_body_meshes(model: mujoco.MjModel) -> dict[int, trimesh.Trimesh]:
    """Build one coloured mesh for every body with visible geoms, in the body's frame.

    Planes are left out: the page draws its own floor.
    """
    parts: dict[int, list[trimesh.Trimesh]] = {}
    for geom in range(model.ngeom):
        rgba = _get_colour(model, geom)
        mesh = _build_mesh(model, geom)
        if mesh is None or rgba[3] == 0 or model.geom_group[geom] >= VISIBLE_GROUPS:
            continue
        transform = np.eye(4)
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, model.geom_quat[geom])
        transform[:3, :3], transform[:3, 3] = matrix.reshape(3, 3), model.geom_pos[geom]
        mesh.apply_transform(transform)
        mesh.visual = trimesh.visual.ColorVisuals(
            mesh, face_colors=np.rint(rgba * 255).astype(np.uint8)
        )
        parts.setdefault(int(model.geom_bodyid[geom]), []).append(mesh)
    return {
        body: cast(trimesh.Trimesh, trimesh.util.concatenate(meshes))
        for body, meshes in parts.items()
    }


def _get_colour(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Colour of a geom or of its material, red green blue opacity. Shape (4,)."""
    material = model.geom_matid[geom]
    return np.array(model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom])


def _build_mesh(  # noqa: PLR0911 one return a shape
    model: mujoco.MjModel, geom: int
) -> trimesh.Trimesh | None:
    """Build a geom's surface in its own frame; None for a plane or height field."""
    kinds = mujoco.mjtGeom
    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind == kinds.mjGEOM_BOX:
        return trimesh.creation.box(extents=2 * size)
    if kind == kinds.mjGEOM_SPHERE:
        return trimesh.creation.icosphere(subdivisions=2, radius=size[0])
    if kind == kinds.mjGEOM_CAPSULE:
        return trimesh.creation.capsule(height=2 * size[1], radius=size[0], count=[16, 16])
    if kind == kinds.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=24)
    if kind == kinds.mjGEOM_ELLIPSOID:
        return trimesh.creation.icosphere(subdivisions=2, radius=1.0).apply_scale(size)
    if kind == kinds.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        first_face, num_faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        return trimesh.Trimesh(
            model.mesh_vert[first : first + count],
            model.mesh_face[first_face : first_face + num_faces],
            process=False,
        )
    return None


def start_viewer(model: mujoco.MjModel, data: mujoco.MjData, port: int) -> Viewer:
    """Open a window on the simulation, or serve a page if there is no display.

    Args:
        model: Model to show.
        data: Its initial positions.
        port: Port of the page on this machine.
    """
    if has_display() and _can_open_window():
        try:
            return WindowViewer(model, data)
        except Exception as fault:  # fall back to the browser if the display does not work
            logger.warning("no window can be opened (%s); showing the browser view", fault)
    viewer = BrowserViewer(model, data, port)
    print(f"The simulation can be watched at {viewer.url}", flush=True)
    return viewer


def _can_open_window() -> bool:
    """Whether GLFW can be initialised: MuJoCo would end the process if its window failed."""
    import glfw  # noqa: PLC0415 loads the window system

    with warnings.catch_warnings(record=True) as faults:
        warnings.simplefilter("always")
        can_open = bool(glfw.init())
    if not can_open:
        reason = str(faults[-1].message) if faults else "no reason given"
        logger.warning("no window can be opened (%s); showing the browser view", reason)
    return can_open
