"""An OpenGL context without a window, on whatever this machine offers."""

from __future__ import annotations

import ctypes.util
import importlib
import os
import sys
from typing import Protocol

from xop_lerobot.core.errors import XopError

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
