"""Protocol of the control socket: one JSON object per line, answered by one line.

A request is a change in the form of `parse_change`, `{"toggle": name}`, or `{"get": "settings"}`.
The answer is `{"ok": true, "settings": {...}}` with the settings that apply from the next tick on,
or `{"ok": false, "error": "..."}`.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from xop_lerobot.core.errors import BadValue, XopError

MAX_LINE = 16_384
"""Longest request or answer [bytes]."""
_OFF, _ON = {"", "false", "off", "no", "none"}, {"true", "on", "yes"}
_MAX_ERROR = 2_000  # longest error in an answer [characters]
_MAX_PATH = 100  # the kernel takes 107 bytes on Linux and 103 on macOS


class Changeable(Protocol):
    """Interface that requests act on, such as `Teleoperation`."""

    @property
    def settings(self) -> dict[str, Any]:
        """Current settings."""
        ...

    def change(self, change: Mapping[str, Any], source: str = "call") -> dict[str, Any]:
        """Request a change of settings."""
        ...

    def toggle(self, name: str, source: str = "call") -> dict[str, Any]:
        """Toggle a setting."""
        ...


class NotJson(XopError):
    """A line is not a JSON object; the client does not speak this protocol."""


def find_socket(control: str, session: str) -> Path | None:
    """Find the path of the control socket.

    Args:
        control: Empty, `false`, `off`, `no` or `none` for no socket; `true`, `on` or `yes` for the
            session's path in the user's runtime directory; or a path.
        session: Name of the session.

    Returns:
        The path; None for no socket.

    Raises:
        BadValue: If the path is too long for a socket, or the session name is not a file name.
    """
    if control.lower() in _OFF:
        return None
    path = Path(control)
    if control.lower() in _ON:
        if "/" in session:
            raise BadValue(f"session {session!r} names no file. Give --teleop.control a path")
        path = find_runtime_dir() / f"{session}.sock"
    if len(os.fsencode(path)) > _MAX_PATH:
        raise BadValue(
            f"the path of a socket may have {_MAX_PATH} bytes, '{path}' has "
            f"{len(os.fsencode(path))}. Choose another --teleop.control"
        )
    return path


def find_runtime_dir() -> Path:
    """Directory of this user's sockets, private to the user."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime and Path(runtime).is_dir():
        return Path(runtime) / "xop"
    return Path(tempfile.gettempdir()) / f"xop-{os.getuid()}"


def answer(line: bytes, target: Changeable) -> dict[str, Any]:
    """Execute a request, and return the answer.

    Raises:
        NotJson: If `line` is not a JSON object.
    """
    request = read_object(line)
    try:
        if "get" in request:
            _check_alone(request, "get", ("settings",))
            settings = target.settings
        elif "toggle" in request:
            _check_alone(request, "toggle", None)
            settings = target.toggle(request["toggle"], "control")
        else:
            settings = target.change(request, "control")
    except XopError as refusal:
        return {"ok": False, "error": str(refusal)[:_MAX_ERROR]}
    return {"ok": True, "settings": settings}


def read_object(line: bytes) -> dict[str, Any]:
    """Parse one line.

    Raises:
        NotJson: If it is not a JSON object.
    """
    try:
        request = json.loads(line)
    except (ValueError, RecursionError) as fault:
        raise NotJson(f"a request must be one JSON object a line: {fault}") from None
    if not isinstance(request, dict):
        raise NotJson("a request must be one JSON object a line")
    return request


def write_object(values: Mapping[str, Any]) -> bytes:
    """Serialise one line."""
    return json.dumps(values).encode() + b"\n"


def _check_alone(request: Mapping[str, Any], key: str, known: tuple[str, ...] | None) -> None:
    value = request[key]
    if len(request) > 1:
        raise BadValue(f"{key!r} must be the only key of a request, got {', '.join(request)}")
    if not isinstance(value, str) or (known is not None and value not in known):
        expected = "a name" if known is None else " or ".join(map(repr, known))
        raise BadValue(f"{key!r} must be {expected}, got {value!r:.80}")
