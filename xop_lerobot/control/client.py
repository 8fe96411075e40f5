"""`xop-control`: change the settings of a running session from another terminal.

xop-control --preset conservative --weights position=2 orientation=0.5
xop-control --targets left_wrist --constraints upright=on
xop-control --toggle upright
xop-control                      # show the settings
"""

from __future__ import annotations

import argparse
import json
import logging
import socket
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, Self

from xop_lerobot.control.protocol import MAX_LINE, find_socket, read_object, write_object
from xop_lerobot.core.command_line import make_output_readable, split_pair
from xop_lerobot.core.errors import BadValue, XopError
from xop_lerobot.core.paced_log import PacedLog
from xop_lerobot.retarget.config import PRESETS

_SWITCH = {"on": True, "true": True, "yes": True, "off": False, "false": False, "no": False}


class NoSession(XopError):
    """No session listens at the control socket."""


class Refused(XopError):
    """The session refused a request; the message gives the reason, and nothing has changed."""


class ControlClient:
    """A connection to the control socket of a session.

    Args:
        path: Path of the socket.
        timeout: Longest wait for an answer [s].

    Raises:
        NoSession: If nobody listens there.
    """

    def __init__(self, path: Path, timeout: float = 5.0) -> None:
        self.path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.settimeout(timeout)
        try:
            self._socket.connect(str(path))
        except OSError as fault:
            self._socket.close()
            raise NoSession(
                f"no session listens at '{path}' ({fault.strerror or fault}). Start it with "
                "--teleop.control=true, and name it with --session or --socket"
            ) from fault
        self._lines = self._socket.makefile("rb")

    def request(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Send a request; return the settings that apply from the next tick on.

        Raises:
            Refused: If it is refused; the message gives the reason.
            NoSession: If the session has ended meanwhile.
        """
        try:
            self._socket.sendall(write_object(request))
            line = self._lines.readline(MAX_LINE)
        except OSError as fault:
            raise NoSession(f"the session at '{self.path}' does not answer: {fault}") from fault
        if not line:
            raise NoSession(f"the session at '{self.path}' has ended")
        reply = read_object(line)
        if not reply.get("ok"):
            raise Refused(str(reply.get("error", "refused")))
        return reply["settings"]

    def close(self) -> None:
        """Close the connection."""
        self._lines.close()
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def build_request(flags: argparse.Namespace) -> dict[str, Any]:
    """Build the request from the flags.

    Raises:
        BadValue: If a pair is malformed, or a value is not the number or switch it must be.
    """
    request: dict[str, Any] = {
        name: getattr(flags, name)
        for name in ("preset", "variant", "mode", "targets", "body", "toggle")
        if getattr(flags, name) is not None
    }
    for name, read in (("weights", _to_number), ("constraints", _to_switch)):
        if pairs := getattr(flags, name):
            split = dict(split_pair(pair, f"--{name} takes name=value") for pair in pairs)
            request[name] = {key: read(key, text) for key, text in split.items()}
    return request or {"get": "settings"}


def _to_number(name: str, text: str) -> float | str:
    try:
        return "inf" if text == "inf" else float(text)
    except ValueError:
        raise BadValue(f"weight {name!r} must be a number, got {text!r}") from None


def _to_switch(name: str, text: str) -> bool:
    if text.lower() not in _SWITCH:
        raise BadValue(f"constraint {name!r} must be on or off, got {text!r}")
    return _SWITCH[text.lower()]


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the flags."""
    parser = argparse.ArgumentParser(
        prog="xop-control",
        description="Change the settings of a running session; without a change, show them.",
    )
    parser.add_argument("--session", default="default", help="--teleop.session of the session")
    parser.add_argument("--socket", default="true", help="--teleop.control of the session")
    parser.add_argument("--preset", help=f"one of {', '.join(PRESETS)}")
    parser.add_argument("--weights", nargs="+", metavar="NAME=VALUE", help="cost weights")
    parser.add_argument("--constraints", nargs="+", metavar="NAME=on|off", help="such as upright")
    parser.add_argument("--variant", help="named binding of the robot, such as v2")
    parser.add_argument("--targets", nargs="+", help="tracked frames to follow")
    parser.add_argument(
        "--body", nargs="*", help="commands and arm joints the planner may move; none: all commands"
    )
    parser.add_argument("--mode", help="stationary or mobile")
    parser.add_argument("--toggle", help="toggle mode, a constraint, or a preset against default")
    return parser


def main(arguments: Sequence[str] | None = None) -> None:
    """Run `xop-control`; a refusal exits with one line and status 1."""
    make_output_readable()
    flags = make_parser().parse_args(arguments)
    try:
        path = find_socket(flags.socket, flags.session)
        if path is None:
            raise BadValue("--socket must be a path, or true for that of the session")
        with ControlClient(path) as client:
            print(json.dumps(client.request(build_request(flags)), indent=2))
    except XopError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()


_log = PacedLog(logging.getLogger(__name__))  # a held key repeats

PRESET_KEYS = {"d": "default", "c": "conservative", "a": "aggressive", "t": "table1"}
TOGGLE_KEYS = {"m": "mode", "u": "upright"}
HELP = "d/c/a/t: preset default, conservative, aggressive, table1; u: upright; m: mode"
"""Help on the keys. LeRobot's own are n, r, q, the arrows and Esc."""


class Target(Protocol):
    """Interface that the keys act on, such as `Teleoperation`."""

    def change(self, change: dict[str, Any], source: str = "call") -> dict[str, Any]:
        """Request a change of settings."""
        ...

    def toggle(self, name: str, source: str = "call") -> dict[str, Any]:
        """Toggle a setting."""
        ...


def press(key: str, target: Target) -> bool:
    """Execute the action of `key`; return whether it has one. Refusals are logged."""
    key = key.lower()
    try:
        if key in PRESET_KEYS:
            settings = target.change({"preset": PRESET_KEYS[key]}, "key")
        elif key in TOGGLE_KEYS:
            settings = target.toggle(TOGGLE_KEYS[key], "key")
        else:
            return False
    except XopError as refusal:
        _log.warning("Key %r changes nothing: %s", key, refusal)
        return True
    constraints = ", ".join(settings["constraints"]) or "none"
    _log.info("Key %r: preset %s, constraints %s.", key, settings["preset"], constraints)
    return True
