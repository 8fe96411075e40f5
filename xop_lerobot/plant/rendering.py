"""Pictures of a simulation, by OpenGL in software where there is no graphics card."""

from __future__ import annotations

import atexit
import ctypes.util
import functools
import importlib
import os
import sys
import threading
import weakref
from contextlib import AbstractContextManager, nullcontext, suppress
from typing import Protocol

import mujoco
import numpy as np

from xop_lerobot.core.errors import UnknownName, XopError

_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}
_OFF = ("disable", "disabled", "off", "false", "0")
_HELP = (
    "Install Mesa's EGL: 'apt-get install libegl1 libgl1-mesa-dri' (Debian, Ubuntu), "
    "'dnf install mesa-libEGL mesa-dri-drivers' (Fedora), or run without cameras."
)


class RenderingUnavailable(XopError, RuntimeError):
    """No OpenGL for pictures; the message says what was tried and which package to install."""

    def __init__(self, faults: dict[str, str]) -> None:
        tried = "; ".join(f"{name}: {fault}" for name, fault in faults.items())
        super().__init__(f"pictures can't be rendered on this machine ({tried}). {_HELP}")


class GlContext(Protocol):
    """What every context of MuJoCo's offers."""

    def make_current(self) -> None:
        """Bind the context to this thread."""

    def free(self) -> None:
        """Release it."""


def choose_backends() -> list[str]:
    """Names of the backends to try, best first.

    `MUJOCO_GL` decides where it is set. Otherwise EGL comes first on Linux, with a display or
    without: it needs no window and works in any thread. `import mujoco` reads the variable too,
    but only for its own renderer, so it may be imported before or after.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wanted in _OFF:
        return []
    if sys.platform != "linux":
        return ["cgl", "glfw"] if sys.platform == "darwin" else ["glfw"]
    if wanted in (*_LIBRARIES, "glfw"):
        return [wanted]
    return ["egl", "osmesa", *(["glfw"] if has_display() else [])]


def has_display() -> bool:
    """Whether a window can be opened."""
    if sys.platform != "linux":
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def make_gl_context(width: int, height: int) -> GlContext:
    """Make an offscreen context; it belongs to the thread that makes it.

    Args:
        width: Largest width that will be rendered [pixel].
        height: Largest height that will be rendered [pixel].

    Raises:
        RenderingUnavailable: If no backend works; carries the fault of each.
    """
    faults: dict[str, str] = {}
    for name in choose_backends():
        library = _LIBRARIES.get(name)
        if library and ctypes.util.find_library(library) is None:
            faults[name] = f"lib{library} is not installed"
            continue
        try:
            # PyOpenGL keeps to the platform of its first import, so a later one can't succeed
            # after an earlier one was imported and failed; its fault then says so.
            context = importlib.import_module(f"mujoco.{name}").GLContext(width, height)
            context.make_current()
        except Exception as fault:  # each library has its own errors
            faults[name] = str(fault) or type(fault).__name__
            continue
        return context
    raise RenderingUnavailable(faults or {"MUJOCO_GL": "rendering is switched off"})


MAX_GEOMS = 2000
_COSTLY = (
    mujoco.mjtRndFlag.mjRND_SHADOW,
    mujoco.mjtRndFlag.mjRND_REFLECTION,
    mujoco.mjtRndFlag.mjRND_FOG,
    mujoco.mjtRndFlag.mjRND_HAZE,
)
"""Effects that cost a software renderer more than all else, and teach a policy nothing."""


class Cameras:
    """The cameras of a model.

    An OpenGL context belongs to one thread, so each thread that asks for a picture gets its own
    renderer, made at its first picture. The picture is computed from a copy of the position:
    rendering never writes to the physics, and a seed gives the same run with cameras or without.

    Args:
        model: Model with named cameras.
        width: Width of a picture [pixel].
        height: Height of a picture [pixel].
    """

    def __init__(self, model: mujoco.MjModel, width: int = 320, height: int = 240) -> None:
        self._model = model
        self.width, self.height = width, height
        self.names = tuple(model.cam(i).name or f"camera {i}" for i in range(model.ncam))
        # The context takes both from the model: its buffer must hold the picture, and smoothing
        # edges by four samples a pixel costs four times the work of a software renderer.
        visual = model.vis
        visual.global_.offwidth = max(visual.global_.offwidth, width)
        visual.global_.offheight = max(visual.global_.offheight, height)
        visual.quality.offsamples = 0
        self._threads = threading.local()

    def check_camera(self, camera: str) -> int:
        """Return the id of `camera`.

        Raises:
            UnknownName: Listing the cameras.
        """
        if camera not in self.names:
            raise UnknownName("camera", camera, self.names)
        return self.names.index(camera)

    def render(
        self, camera: str, data: mujoco.MjData, lock: AbstractContextManager[object] | None = None
    ) -> np.ndarray:
        """Render what `camera` sees of the positions in `data`, which is only read.

        Args:
            camera: Name of the camera.
            data: Physics to look at.
            lock: Held while the positions are copied, where another thread steps them.

        Returns:
            Fresh picture. Shape (height, width, 3), uint8.

        Raises:
            UnknownName: Listing the cameras.
            RenderingUnavailable: If this machine has no OpenGL for it.
        """
        index = self.check_camera(camera)
        renderer: _Renderer | None = getattr(self._threads, "renderer", None)
        if renderer is None:
            renderer = _Renderer(self._model, self.width, self.height)
            self._threads.renderer = renderer
        with lock or nullcontext():
            renderer.copy_positions(data)
        return renderer.render(index)

    def close(self) -> None:
        """Release this thread's renderer; those of other threads go when their threads end."""
        renderer: _Renderer | None = getattr(self._threads, "renderer", None)
        if renderer is not None:
            del self._threads.renderer
            renderer.close()


class _Renderer:
    """OpenGL context, scene and scratch data of one thread."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        self._model = model
        self._gl: GlContext | None = None
        self._data = mujoco.MjData(model)
        self._gl = make_gl_context(width, height)
        _LIVING.add(self)
        _close_all_at_exit()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(model, maxgeom=max(MAX_GEOMS, 2 * model.ngeom))
        for flag in _COSTLY:
            self._scene.flags[flag] = False
        self._option = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._rect = mujoco.MjrRect(0, 0, width, height)

    def copy_positions(self, data: mujoco.MjData) -> None:
        """Take over all that positions follow from."""
        self._data.qpos[:] = data.qpos
        self._data.mocap_pos[:] = data.mocap_pos
        self._data.mocap_quat[:] = data.mocap_quat

    def render(self, camera: int) -> np.ndarray:
        """Picture of the positions copied last. Shape (height, width, 3), uint8."""
        if self._gl is None:
            raise RuntimeError("the renderer is closed")
        self._gl.make_current()
        scratch = self._data
        mujoco.mj_kinematics(self._model, scratch)
        mujoco.mj_comPos(self._model, scratch)
        mujoco.mj_camlight(self._model, scratch)
        self._camera.fixedcamid = camera
        mujoco.mjv_updateScene(
            self._model,
            scratch,
            self._option,
            None,
            self._camera,
            mujoco.mjtCatBit.mjCAT_ALL,
            self._scene,
        )
        mujoco.mjr_render(self._rect, self._scene, self._context)
        picture = np.empty((self._rect.height, self._rect.width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(picture, None, self._rect, self._context)
        return np.ascontiguousarray(picture[::-1])  # OpenGL counts rows from the bottom

    def close(self) -> None:
        """Release the context; may be called twice."""
        if self._gl is not None:
            self._gl.make_current()
            self._context.free()
            self._gl.free()
            self._gl = None

    def __del__(self) -> None:
        """Release the context in the thread that ends with it."""
        with suppress(Exception):
            self.close()


_LIVING: weakref.WeakSet[_Renderer] = weakref.WeakSet()


@functools.cache
def _close_all_at_exit() -> None:
    """Release what is left before the OpenGL library's own end, which would take it along.

    Called once a context exists: exit handlers run last registered first.
    """
    atexit.register(_close_all)


def _close_all() -> None:
    for renderer in list(_LIVING):
        with suppress(Exception):  # one may be bound to a thread that still runs
            renderer.close()
