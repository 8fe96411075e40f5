"""`xop-doctor`: check whether this machine is ready for teleoperation, and advise on fixes.

    xop-doctor                                        the machine alone
    xop-doctor --device avp --host 192.168.1.40       and a streaming Vision Pro
    xop-doctor --device webxr --host 0.0.0.0          and any other headset with the page open

Exit status: 0 if no check fails, 1 if one does, 2 for an invalid command line.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from xop_lerobot.core.command_line import CommandParser, make_output_readable
from xop_lerobot.core.errors import BadValue, UnknownName, XopError
from xop_lerobot.doctor.checks import (
    check_cpu,
    check_disk,
    check_gl,
    check_interpreter,
    check_plugin,
)
from xop_lerobot.doctor.finding import Finding, Level, Setup
from xop_lerobot.doctor.headset import check_certificate, check_headset, check_ports

CHECKS: dict[str, Callable[[Setup], Finding]] = {
    "interpreter": check_interpreter,
    "gl": check_gl,
    "plugin": check_plugin,
    "disk": check_disk,
    "ports": check_ports,
    "certificate": check_certificate,
    "headset": check_headset,
    "cpu": check_cpu,
}
"""Checks by name, in the order in which they run."""
DEVICES = ("avp", "webxr")


def run_checks(setup: Setup, names: Sequence[str] = tuple(CHECKS)) -> Iterator[tuple[str, Finding]]:
    """Run the checks `names` one after another; an exception counts as a failure."""
    for name in names:
        try:
            yield name, CHECKS[name](setup)
        except Exception as error:  # one broken check must not stop the others
            kind = "" if isinstance(error, XopError) else f"{type(error).__name__}: "
            yield name, Finding(Level.FAIL, f"{kind}{error}")


def make_parser() -> CommandParser:
    """Make the parser of the command line."""
    default = Setup()
    parser = CommandParser("xop-doctor", __doc__)
    add = parser.add_argument
    add("--device", default="", help="headset: avp or webxr (default: none)")
    add("--host", default="", help="avp: its address; webxr: address to listen at (default: "
        "127.0.0.1)")  # fmt: skip
    add(
        "--port",
        type=int,
        default=0,
        help="its port (default: avp 12345, webxr 8012)",
    )
    add("--seconds", type=float, default=default.seconds,
        help=f"duration of the stream measurement [s] (default: {default.seconds:g})")  # fmt: skip
    add("--wait", type=float, default=default.wait,
        help=f"time to wait for the stream [s] (default: {default.wait:g})")  # fmt: skip
    add("--robot", default=default.robot, help="robot whose planner is timed (default: g1)")
    add("--mode", default=default.mode, help="mode of the planner (default: stationary)")
    add("--root", type=Path, default=None, help="folder of datasets (default: LeRobot's)")
    add(
        "--only",
        default="",
        help=f"checks to run, comma-separated: {', '.join(CHECKS)} (default: all)",
    )
    add("--json", action="store_true", help="print one JSON object instead of lines")
    return parser


def parse_arguments(arguments: Sequence[str]) -> tuple[Setup, tuple[str, ...], bool]:
    """Read the command line: the setup, the checks to run, and whether to print JSON.

    Raises:
        BadValue: If a flag is malformed or out of its range.
        UnknownName: If a flag, device, robot, mode or check is unknown, listing the known ones.
    """
    from xop_lerobot.core.command import Mode  # noqa: PLC0415
    from xop_lerobot.morphology.morphology import make_morphology  # noqa: PLC0415

    args = make_parser().parse(arguments)
    if args.device and args.device not in DEVICES:
        raise UnknownName("--device", args.device, DEVICES)
    modes = [mode.name.lower() for mode in Mode]
    if args.mode not in modes:
        raise UnknownName("--mode", args.mode, modes)
    make_morphology(args.robot)
    for name in ("seconds", "wait"):
        if not getattr(args, name) > 0:
            raise BadValue(f"--{name} must be above 0, got {getattr(args, name):g}")
    names = tuple(filter(None, (each.strip() for each in args.only.split(",")))) or tuple(CHECKS)
    for name in names:
        if name not in CHECKS:
            raise UnknownName("check", name, CHECKS)
    fields = {each.name for each in dataclasses.fields(Setup)}
    args.root = args.root or find_root()
    values = {name: value for name, value in vars(args).items() if name in fields}
    return Setup(**values), names, args.json


def find_root() -> Path:
    """Return LeRobot's dataset folder, resolved as LeRobot does but without importing it."""
    home = os.environ.get("HF_LEROBOT_HOME")
    if home:
        return Path(home).expanduser()
    hugging = os.environ.get("HF_HOME")
    base = Path(hugging).expanduser() if hugging else Path.home() / ".cache" / "huggingface"
    return base / "lerobot"


def print_finding(name: str, finding: Finding) -> None:
    """Print a finding and its advice."""
    print(f"{finding.level.value.upper():<5} {name:<12} {finding.text}", flush=True)
    if finding.advice:
        print(f"{'':18} → {finding.advice}", flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `xop-doctor`; returns the exit status."""
    make_output_readable()
    try:
        setup, names, as_json = parse_arguments(sys.argv[1:] if arguments is None else arguments)
    except XopError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    findings = []
    # The WebXR server prints its address to stdout; keep it out of the JSON object.
    with contextlib.redirect_stdout(sys.stderr) if as_json else contextlib.nullcontext():
        for name, finding in run_checks(setup, names):
            findings.append((name, finding))
            if not as_json:
                print_finding(name, finding)
    failed = sum(finding.level is Level.FAIL for _, finding in findings)
    warned = sum(finding.level is Level.WARN for _, finding in findings)
    if as_json:
        checks = [
            {
                "check": name,
                "level": finding.level.value,
                "text": finding.text,
                "advice": finding.advice,
                "figures": dict(finding.figures),
            }
            for name, finding in findings
        ]
        print(json.dumps({"ok": not failed, "checks": checks}, indent=1))
    else:
        verdict = "not ready" if failed else "ready"
        print(f"\n{verdict}: {failed} of {len(findings)} checks failed, {warned} with a warning")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
