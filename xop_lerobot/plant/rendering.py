"""Offscreen rendering of camera images with OpenGL, in software if there is no graphics card."""

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
    """No OpenGL for rendering; the message lists the failed backends and a package to install."""

    def __init__(self, faults: dict[str, str]) -> None:
        tried = "; ".join(f"{name}: {fault}" for name, fault in faults.items())
        super().__init__(f"images can't be rendered on this machine ({tried}). {_HELP}")


class GlContext(Protocol):
    """Interface of MuJoCo's OpenGL contexts."""

    def make_current(self) -> None:
        """Bind the context to this thread."""

    def free(self) -> None:
        """Release it."""


def choose_backends() -> list[str]:
    """Names of the backends to try, best first.

    `MUJOCO_GL` takes precedence. Otherwise EGL comes first on Linux, with or without a display: it
    needs no window and works in any thread. `import mujoco` reads the variable too, but only for
    its own renderer, so the order of imports does not matter.
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
    """Make an offscreen context, which belongs to the calling thread.

    Args:
        width: Largest width to render [pixel].
        height: Largest height to render [pixel].

    Raises:
        RenderingUnavailable: If no backend works; names the fault of each.
    """
    faults: dict[str, str] = {}
    for name in choose_backends():
        library = _LIBRARIES.get(name)
        if library and ctypes.util.find_library(library) is None:
            faults[name] = f"lib{library} is not installed"
            continue
        try:
            # PyOpenGL keeps the platform of its first import, so a later backend can't succeed
            # after an earlier one was imported and failed; its error then says so.
            context = importlib.import_module(f"mujoco.{name}").GLContext(width, height)
            context.make_current()
        except Exception as fault:  # each library raises its own exceptions
            faults[name] = str(fault) or type(fault).__name__
            continue
        return context
    raise RenderingUnavailable(faults or {"MUJOCO_GL": "rendering is switched off"})


MAX_GEOMS = 2000  # least capacity of the visual scene
_COSTLY = (
    mujoco.mjtRndFlag.mjRND_SHADOW,
    mujoco.mjtRndFlag.mjRND_REFLECTION,
    mujoco.mjtRndFlag.mjRND_FOG,
    mujoco.mjtRndFlag.mjRND_HAZE,
)
"""Effects that dominate the time of a software renderer and are of no use to a policy."""


class Cameras:
    """The cameras of a model.

    An OpenGL context belongs to one thread, so each thread gets its own renderer at its first
    image. Images are computed from a copy of the positions: rendering never writes to the physics,
    so a seed gives the same run with or without cameras.

    Args:
        model: Model with named cameras.
        width: Width of an image [pixel].
        height: Height of an image [pixel].
    """

    def __init__(self, model: mujoco.MjModel, width: int = 320, height: int = 240) -> None:
        self._model = model
        self.width, self.height = width, height
        self.names = tuple(model.cam(i).name or f"camera {i}" for i in range(model.ncam))
        # The context takes these from the model: its buffer must hold the image, and antialiasing
        # with four samples per pixel costs a software renderer four times the work.
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
        """Render the positions in `data` from `camera`; `data` is only read.

        Args:
            camera: Name of the camera.
            data: Physics state.
            lock: Held while the positions are copied, if another thread steps the physics.

        Returns:
            New image. Shape (height, width, 3), uint8.

        Raises:
            UnknownName: Listing the cameras.
            RenderingUnavailable: If this machine has no working OpenGL.
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
        """Release this thread's renderer; those of other threads are released as they end."""
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
        """Copy the quantities that determine all positions."""
        self._data.qpos[:] = data.qpos
        self._data.mocap_pos[:] = data.mocap_pos
        self._data.mocap_quat[:] = data.mocap_quat

    def render(self, camera: int) -> np.ndarray:
        """Render the positions copied last. Shape (height, width, 3), uint8."""
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
        image = np.empty((self._rect.height, self._rect.width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(image, None, self._rect, self._context)
        return np.ascontiguousarray(image[::-1])  # OpenGL counts rows from the bottom

    def close(self) -> None:
        """Release the context; may be called twice."""
        if self._gl is not None:
            self._gl.make_current()
            self._context.free()
            self._gl.free()
            self._gl = None

    def __del__(self) -> None:
        """Release the context when its thread ends."""
        with suppress(Exception):
            self.close()


_LIVING: weakref.WeakSet[_Renderer] = weakref.WeakSet()


@functools.cache
def _close_all_at_exit() -> None:
    """Register the release of all contexts before the exit handler of the OpenGL library.

    Called once a context exists, since exit handlers run in reverse order of registration.
    """
    atexit.register(_close_all)


def _close_all() -> None:
    for renderer in list(_LIVING):
        with suppress(Exception):  # it may be bound to a thread that is still running
            renderer.close()
