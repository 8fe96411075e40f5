"""Static obstacles of a scene or a YAML file, and batched exact distances to all of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from xop_lerobot.core.errors import BadValue, UnknownName, XopError
from xop_lerobot.core.transforms import quat_conjugate, quat_from_rpy, quat_rotate
from xop_lerobot.core.yaml_words import load_yaml

SHAPES = ("box", "sphere", "cylinder", "capsule")
_GEOMS = {
    int(mujoco.mjtGeom.mjGEOM_BOX): "box",
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
}
_GROUND = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))


@dataclass(frozen=True)
class Obstacle:
    """A static solid.

    Attributes:
        name: Its name.
        position: Centre in the world [m]. Shape (3,).
        quat: Orientation wxyz; cylinders and capsules lie along their Z. Shape (4,).
        half_size: Half the edges of its bounding box along its own axes [m]: r, r, l/2 for a
            cylinder; the length of a capsule includes its caps. Shape (3,).
        shape: One of `SHAPES`.
        handled: Whether hands work at it or close to it, and need not avoid it.

    Raises:
        UnknownName: If the shape is unknown.
        BadValue: If a size is not positive.
    """

    name: str
    position: np.ndarray
    quat: np.ndarray
    half_size: np.ndarray
    shape: str = "box"
    handled: bool = False

    def __post_init__(self) -> None:
        if self.shape not in SHAPES:
            raise UnknownName("shape of an obstacle", self.shape, SHAPES)
        if not (np.asarray(self.half_size) > 0).all():
            raise BadValue(f"obstacle '{self.name}': sizes must be positive, got {self.half_size}")

    def compute_distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distance of points to the surface, negative inside [m]. (..., 3) -> (...).

        The plain formula of each shape; `ObstacleSet` computes the same for many obstacles.
        """
        local = np.abs(quat_rotate(quat_conjugate(self.quat), points - self.position))
        radius, half = self.half_size[0], self.half_size[2]
        if self.shape == "sphere":
            return np.linalg.norm(local, axis=-1) - radius
        if self.shape == "capsule":
            beyond = np.maximum(local - [0, 0, half - radius], [-np.inf, -np.inf, 0])
            return np.linalg.norm(beyond, axis=-1) - radius
        if self.shape == "cylinder":
            across = np.hypot(local[..., 0], local[..., 1])
            outside = np.stack([across - radius, local[..., 2] - half], axis=-1)
        else:
            outside = local - self.half_size
        outer = np.linalg.norm(np.maximum(outside, 0), axis=-1)
        return outer + np.minimum(outside.max(-1), 0)


class ObstacleSet:
    r"""Signed distances of many points to many obstacles in one vectorised pass.

    With :math:`q = |R_j^\top(p - c_j)|`, for a cylinder :math:`q = (\sqrt{q_x^2 + q_y^2}, 0, q_z)`,
    every shape is a core of half sizes :math:`h_j`, rounded by :math:`r_j`:

    .. math:: d_j(p) = \|\max(q - h_j, 0)\| + \min(\max_i(q - h_j)_i, 0) - r_j.

    The core of a sphere is a point, that of a capsule a line; box and cylinder have r_j = 0.

    Args:
        obstacles: The obstacles.
    """

    def __init__(self, obstacles: Iterable[Obstacle] = ()) -> None:
        self.obstacles = tuple(obstacles)
        rows = [_make_row(obstacle) for obstacle in self.obstacles]
        self._axes = np.array([row[0] for row in rows]).reshape(-1, 3, 3)  # (J, 3, 3)
        self._centres = np.array([row[1] for row in rows]).reshape(-1, 3)
        self._cores = np.array([row[2] for row in rows]).reshape(-1, 3)
        self._radii = np.array([row[3] for row in rows])
        self._round = np.array([each.shape == "cylinder" for each in self.obstacles], dtype=bool)
        self.handled = np.array([each.handled for each in self.obstacles], dtype=bool)
        """Which obstacles the hands work at. Shape (J,), bool."""

    def __len__(self) -> int:
        return len(self.obstacles)

    def find_near(self, points: np.ndarray, distance: float) -> np.ndarray:
        """Obstacles to which any of `points` may be closer than `distance` (conservative).

        A signed distance changes by no more than the point moves (Lipschitz constant 1), so an
        obstacle farther from the centre of the points' bounding box than `distance` plus half its
        diagonal cannot be close to any of them.

        Args:
            points: Points. Shape (..., 3).
            distance: Distance threshold [m].

        Returns:
            Indices of the obstacles. Shape (n,).
        """
        flat = points.reshape(-1, 3)
        low, high = flat.min(axis=0), flat.max(axis=0)
        if not np.isfinite(low + high).all():  # a diverged sample: cull nothing
            return np.arange(len(self))
        spread = float(np.linalg.norm(high - low)) / 2
        return np.flatnonzero(self.compute_distances((low + high) / 2) < distance + spread)

    def compute_distances(self, points: np.ndarray, which: np.ndarray | None = None) -> np.ndarray:
        """Signed distances, negative inside [m].

        Args:
            points: Points in the world [m]. Shape (..., 3).
            which: Obstacles of interest; all by default. Shape (n,), int.

        Returns:
            Distance of every point to every obstacle. Shape (..., n).
        """
        which = np.arange(len(self)) if which is None else which
        axes, cores = self._axes[which], self._cores[which]
        # Components first, points last: every pass is over contiguous memory.
        turned = np.einsum("jab->bja", axes).reshape(-1, 3) @ points.reshape(-1, 3).T
        local = turned.reshape(3, len(which), points[..., 0].size)
        local -= np.einsum("jab,ja->bj", axes, self._centres[which])[..., None]
        np.abs(local, out=local)
        cylinders = self._round[which]
        if cylinders.any():
            local[0, cylinders] = np.hypot(local[0, cylinders], local[1, cylinders])
            local[1, cylinders] = 0
        local -= cores.T[..., None]
        depth = np.minimum(np.maximum(np.maximum(local[0], local[1]), local[2]), 0)
        np.maximum(local, 0, out=local)
        np.square(local, out=local)
        distances = np.sqrt(local[0] + local[1] + local[2]) + depth
        distances -= self._radii[which][:, None]
        return distances.T.reshape(*points.shape[:-1], len(which))


def _make_row(obstacle: Obstacle) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Axes (columns), centre, half sizes of the core, and its rounding."""
    axes = quat_rotate(obstacle.quat, np.eye(3)).T
    half, radius = np.array(obstacle.half_size, dtype=float), 0.0
    if obstacle.shape in ("sphere", "capsule"):
        radius = float(half[0])
        half = np.array([0.0, 0, half[2] - radius])
    elif obstacle.shape == "cylinder":
        half[1] = np.inf  # the second axis is folded into the first and must not limit the depth
    return axes, np.asarray(obstacle.position, float), half, radius


def make_obstacles(
    model: mujoco.MjModel,
    movable: Iterable[str] = (),
    data: mujoco.MjData | None = None,
    handled: Iterable[str] = (),
) -> tuple[Obstacle, ...]:
    """Make obstacles of the solid geoms fixed to the world, except planes and height fields.

    Boxes, spheres, cylinders and capsules are exact; meshes and ellipsoids are replaced by their
    bounding boxes.

    Args:
        model: Model of the scene; the robot in it is not fixed, so it is no obstacle.
        movable: Movable bodies to include at their present pose.
        data: Present configuration; by default the initial one of the model.
        handled: Bodies among `movable` that the hands work at.

    Raises:
        UnknownName: If there is no such movable body; lists those there are.
    """
    if data is None:
        data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    bodies = {model.body(i).name: i for i in range(model.nbody) if model.body_weldid[i]}
    wanted, worked_at = set(), {bodies[name] for name in handled if name in bodies}
    for name in movable:
        if name not in bodies:
            raise UnknownName("movable body", name, bodies)
        wanted.add(int(model.body_weldid[bodies[name]]))
    obstacles = []
    for i in range(model.ngeom):
        weld = int(model.body_weldid[model.geom_bodyid[i]])
        solid = model.geom_contype[i] or model.geom_conaffinity[i]
        if (weld and weld not in wanted) or not solid or model.geom_type[i] in _GROUND:
            continue
        obstacle = _make_obstacle(model, data, i)
        at_work = int(model.geom_bodyid[i]) in worked_at
        obstacles.append(replace(obstacle, handled=True) if at_work else obstacle)
    return tuple(obstacles)


def _make_obstacle(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> Obstacle:
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, data.geom_xmat[geom])
    # geom_aabb is the box around the geom in its own frame: centre, half sizes.
    centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    position = data.geom_xpos[geom] + quat_rotate(quat, centre)
    shape = _GEOMS.get(int(model.geom_type[geom]), "box")
    name = model.geom(geom).name or model.body(model.geom_bodyid[geom]).name or f"geom {geom}"
    return Obstacle(name, position, quat, half.copy(), shape)


SIZES = {
    "box": ("size",),
    "sphere": ("radius",),
    "cylinder": ("radius", "length"),
    "capsule": ("radius", "length"),
}
"""Size keys of each shape in an obstacle file."""

_OPTIONAL = ("name", "rpy")


class BadObstacles(XopError, ValueError):
    """An obstacle file is missing or malformed; the message names the file and the fault."""

    def __init__(self, path: object, fault: str) -> None:
        super().__init__(f"obstacles '{path}': {fault}")


def load_obstacles(path: str | Path) -> tuple[Obstacle, ...]:
    """Read an obstacle file; see docs/how_it_works/retargeter.md for the format.

    Raises:
        BadObstacles: If it cannot be read or is malformed; names the file, entry and fault.
    """
    import yaml  # noqa: PLC0415 (needed only for an obstacle file)

    try:
        content = load_yaml(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise BadObstacles(path, f"cannot be read: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise BadObstacles(path, f"is no YAML: {error}") from error
    entries = content.get("obstacles") if isinstance(content, Mapping) else None
    if not isinstance(entries, list):
        raise BadObstacles(path, "must hold 'obstacles:' and a list of them")
    obstacles = []
    for i, entry in enumerate(entries):
        try:
            obstacles.append(_parse(entry, i))
        except _Fault as fault:
            raise BadObstacles(path, f"obstacle {_label(entry, i)}: {fault}") from None
    names = [obstacle.name for obstacle in obstacles]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise BadObstacles(path, f"the name '{twice[0]}' is used twice")
    return tuple(obstacles)


class _Fault(Exception):
    """Fault of one entry."""


def _label(entry: Any, index: int) -> str:
    name = entry.get("name") if isinstance(entry, Mapping) else None
    return f"{index + 1}" if name is None else f"{index + 1} ('{name}')"


def _parse(entry: Any, index: int) -> Obstacle:
    """Make the obstacle of one entry, or raise `_Fault`."""
    if not isinstance(entry, Mapping):
        raise _Fault(f"must be keys and values, got {entry!r}")
    shape = entry.get("shape")
    if shape not in SIZES:
        raise _Fault(f"unknown shape {shape!r}. Known: {', '.join(sorted(SIZES))}")
    needed = ("shape", "position", *SIZES[shape])
    for key in needed:
        if key not in entry:
            raise _Fault(f"a {shape} needs '{key}'")
    allowed = sorted({*needed, *_OPTIONAL})
    for key in entry:
        if key not in allowed:
            raise _Fault(f"unknown key {key!r}. Known of a {shape}: {', '.join(allowed)}")
    if shape == "box":
        half = _read_numbers(entry, "size", 3, "m", positive=True) / 2
    else:
        radius = float(_read_numbers(entry, "radius", 1, "m", positive=True)[0])
        half = np.array([radius, radius, radius])
        if shape != "sphere":
            half[2] = float(_read_numbers(entry, "length", 1, "m", positive=True)[0]) / 2
        if shape == "capsule" and half[2] < radius:
            raise _Fault(
                f"'length' holds both caps, so it must be at least twice the radius, "
                f"{2 * radius:g} m, got {2 * half[2]:g}"
            )
    rpy = _read_numbers(entry, "rpy", 3, "rad") if "rpy" in entry else np.zeros(3)
    return Obstacle(
        name=f"{shape}_{index + 1}" if entry.get("name") is None else str(entry["name"]),
        position=_read_numbers(entry, "position", 3, "m"),
        quat=quat_from_rpy(*rpy),
        half_size=half,
        shape=shape,
    )


def _read_numbers(
    entry: Mapping[str, Any], key: str, count: int, unit: str, *, positive: bool = False
) -> np.ndarray:
    """Read `count` finite numbers of `entry`. Shape (count,)."""
    what = "a number" if count == 1 else f"a list of {count} numbers"
    value = entry[key] if count > 1 else [entry[key]]
    valid = isinstance(value, list) and len(value) == count
    if not valid or any(isinstance(x, bool) or not isinstance(x, int | float) for x in value):
        raise _Fault(f"'{key}' must be {what} [{unit}], got {entry[key]!r}")
    numbers = np.array(value, dtype=float)
    if not np.isfinite(numbers).all():
        raise _Fault(f"'{key}' must be finite, got {entry[key]!r}")
    if positive and not (numbers > 0).all():
        raise _Fault(f"'{key}' must be positive [{unit}], got {entry[key]!r}")
    return numbers
