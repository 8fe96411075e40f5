"""Checks of `xop-doctor`: each returns a finding with advice.

What may crash or hang (a driver, a plugin) runs in a Python of its own.
"""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import os
import platform
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from xop_lerobot.morphology.morphology import MORPHOLOGIES
from xop_lerobot.plant.rendering import choose_backends


class Answer(NamedTuple):
    """Result of a child process."""

    ok: bool
    """Whether it has ended well."""
    text: str
    """What it has printed, or the last line of why not."""


def run_child(code: str, *arguments: str, timeout: float = 120.0) -> Answer:
    """Run `code` with `arguments` in `sys.argv[1:]`.

    Args:
        code: The program.
        arguments: What it is given.
        timeout: It is ended after so long [s].
    """
    try:
        done = subprocess.run(
            [sys.executable, "-c", code, *arguments],
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return Answer(False, f"no answer within {timeout:g} s")
    if done.returncode == 0:
        return Answer(True, done.stdout.strip())
    lines = done.stderr.strip().splitlines()
    return Answer(False, lines[-1] if lines else f"it ended with status {done.returncode}")


class Level(Enum):
    """Severity of a finding."""

    OK = "ok"
    WARN = "warn"
    """It works, with a warning."""
    FAIL = "fail"
    """It does not work."""
    SKIP = "skip"
    """Not requested, or not decidable."""


@dataclass(frozen=True)
class Finding:
    """Result of a check.

    Attributes:
        level: How well it is.
        text: What was found, in a sentence.
        advice: What to do about it; empty where there is nothing to do.
        figures: The same in numbers, fit for JSON.
    """

    level: Level
    text: str
    advice: str = ""
    figures: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True)
class Setup:
    """Intended use of this machine.

    Attributes:
        device: The headset, `avp` or `webxr`; empty for none.
        host: `avp`: its address. `webxr`: address to listen at; empty is loopback.
        port: Its port, 0 for the usual one.
        seconds: How long its stream is measured [s].
        wait: How long it is waited for [s].
        robot: Robot whose planner is timed.
        mode: In which mode.
        root: Where datasets are written.
    """

    device: str = ""
    host: str = ""
    port: int = 0
    seconds: float = 3.0
    wait: float = 60.0
    robot: str = MORPHOLOGIES.built_in[0]
    mode: str = "stationary"
    root: Path = Path()


_CODE = """
import time
from xop_lerobot.plant.rendering import make_gl_context
context = make_gl_context(640, 480)
name = "unknown"
try:
    from OpenGL.GL import GL_RENDERER, glGetString
    name = glGetString(GL_RENDERER).decode()
except Exception:
    pass
import mujoco
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><light pos='0 0 3'/><geom size='1' rgba='1 0 0 1'/>"
    "<camera name='c' pos='0 -4 0' xyaxes='1 0 0 0 0 1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
scene = mujoco.MjvScene(model, 100)
draw = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, draw)
camera = mujoco.MjvCamera()
camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
import numpy as np
picture, rect = np.zeros((480, 640, 3), np.uint8), mujoco.MjrRect(0, 0, 640, 480)
begin = time.perf_counter()
for _ in range(5):
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, camera,
                           mujoco.mjtCatBit.mjCAT_ALL, scene)
    mujoco.mjr_render(rect, scene, draw)
    mujoco.mjr_readPixels(picture, None, rect, draw)
took = (time.perf_counter() - begin) / 5
red, _, blue = map(int, picture[240, 320])
assert red > 40 and red > 2 * blue, "the picture is not what it should be"
print(f"{took * 1e3:.1f}|{name}")
"""


def check_gl(setup: Setup) -> Finding:
    """Render a ball in a separate process, which a faulty driver may crash."""
    del setup
    answer = run_child(_CODE)
    tried = ", ".join(choose_backends()) or "none"
    variable = os.environ.get("MUJOCO_GL", "")
    if not answer.ok:
        return Finding(
            Level.FAIL,
            f"no images (tried: {tried}): {answer.text}",
            "install Mesa's EGL (apt-get install libegl1 libgl1-mesa-dri), "
            + (f"or unset MUJOCO_GL={variable}" if variable else "or record without cameras"),
        )
    took, name = answer.text.split("|", 1)
    figures = {"picture_ms": float(took), "renderer": name, "backend": tried.split(",")[0]}
    text = f"an image of 640 x 480 takes {took} ms ({tried.split(',')[0]}, {name})"
    if any(word in name.lower() for word in ("llvmpipe", "softpipe", "swrast")):
        return Finding(
            Level.WARN,
            f"{text}; no graphics card is used",
            "smaller or fewer images cost less: --robot.width, --robot.height, --robot.cameras",
            figures,
        )
    return Finding(Level.OK, text, "", figures)


ENOUGH_GB, LEAST_GB = 10.0, 1.0


def check_disk(setup: Setup) -> Finding:
    """Check the disk of the folder, or of its nearest existing parent."""
    wanted = setup.root.expanduser().absolute()
    folder = wanted
    while not folder.exists():
        folder = folder.parent
    free = shutil.disk_usage(folder).free / 1e9
    figures = {"free_gb": round(free, 2), "folder": str(folder)}
    if not os.access(folder, os.W_OK):
        return Finding(
            Level.FAIL,
            f"{wanted} cannot be written: {folder} belongs to another user",
            "choose another --dataset.root",
            figures,
        )
    text = f"{free:.1f} GB are free for {wanted}"
    if free < ENOUGH_GB:
        return Finding(
            Level.FAIL if free < LEAST_GB else Level.WARN,
            text,
            "free some, or choose another --dataset.root; videos take most of it",
            figures,
        )
    return Finding(Level.OK, text, "", figures)


def check_certificate(setup: Setup) -> Finding:
    """Check the certificate without changing it."""
    if setup.device == "avp":
        return Finding(Level.SKIP, "a Vision Pro with Tracking Streamer needs none")
    if setup.host in ("", "127.0.0.1", "localhost", "::1"):
        return Finding(Level.SKIP, "on loopback the page needs none")
    from xop_lerobot.operator.webxr.certificate import (  # noqa: PLC0415  brings cryptography
        find_folder,
        inspect_certificate,
        list_own_names,
    )

    folder, now = find_folder(), datetime.datetime.now(datetime.UTC)
    found, fault = inspect_certificate(folder, list_own_names(), now)
    if found is not None:
        days = (found.end - now).days
        return Finding(
            Level.OK,
            f"the certificate in {folder} is valid for {days} days and all addresses of this "
            "machine; only its user can read the key",
            "",
            {"days": days, "fingerprint": found.fingerprint},
        )
    exists = (folder / "webxr.crt").exists()
    return Finding(
        Level.WARN if exists else Level.OK,
        f"the certificate in {folder}: {fault}; the next session makes one",
        "headsets will ask again whether to trust it" if exists else "",
    )


STEPS, WARMUP = 40, 10
SHARE = 0.8
"""A planner that needs more of its period leaves too little to the rest."""


def check_cpu(setup: Setup) -> Finding:
    """Time the planner of the robot, and compare with its period."""
    from xop_lerobot.core.command import Mode  # noqa: PLC0415
    from xop_lerobot.evaluation.bench import BenchConfig, run_bench  # noqa: PLC0415  MuJoCo

    mode = Mode[setup.mode.upper()]
    figures = run_bench(BenchConfig(setup.robot, mode, steps=STEPS, warmup=WARMUP))
    period = 1e3 / figures["wanted_hz"]
    median, slow = figures["step_ms_median"], figures["step_ms_p99"]
    cores, load = os.cpu_count() or 1, os.getloadavg()[0]
    kept = {
        "period_ms": round(period, 2),
        "step_ms_median": round(median, 2),
        "step_ms_p99": round(slow, 2),
        "cores": cores,
        "load": round(load, 2),
    }
    text = (
        f"a plan for {setup.robot}, {setup.mode}, takes {median:.1f} ms of the {period:.0f} ms "
        f"available (1 in 100: {slow:.1f} ms; {cores} cores, load {load:.1f})"
    )
    busy = " Other programs are using the CPU: close them first." if load > cores else ""
    if median > period:
        return Finding(
            Level.FAIL,
            text,
            "in real time plans come late: take fewer samples (--teleop.retargeter.num_samples), "
            "a lower rate (--teleop.retargeter.control_hz), --teleop.retargeter.type=direct, or "
            f"record in lock-step.{busy}",
            kept,
        )
    if slow > SHARE * period:
        return Finding(
            Level.WARN,
            text,
            "cameras and video encoding need time too: smaller images, or a lower "
            f"--teleop.retargeter.control_hz.{busy}",
            kept,
        )
    return Finding(Level.OK, text, "", kept)


TIMEOUT_S = 3.0


def check_ports(setup: Setup) -> Finding:
    """Listen on the page's port, or connect to that of a Vision Pro."""
    # Where the protocols are not installed, this check fails alone.
    from xop_lerobot.operator.devices import avp as avp_protocol  # noqa: PLC0415
    from xop_lerobot.operator.webxr import protocol as webxr_protocol  # noqa: PLC0415

    if setup.device == "avp":
        return _knock(setup.host, setup.port or avp_protocol.PORT)
    host = setup.host or "127.0.0.1"
    return _listen(host, setup.port or webxr_protocol.PORT)


def _listen(host: str, port: int) -> Finding:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
            probe.listen(1)
    except OSError as error:
        return Finding(
            Level.FAIL,
            f"port {port} at {host} cannot be opened: {error.strerror or error}",
            "end the other program (another session of ours?), or choose another port with "
            "--teleop.device.port; the address must be one of this machine's",
        )
    return Finding(Level.OK, f"port {port} at {host} is free for the page of a headset")


def _knock(host: str, port: int) -> Finding:
    if not host:
        return Finding(Level.FAIL, "no address of a Vision Pro", "pass --host ADDRESS")
    try:
        with socket.create_connection((host, port), timeout=TIMEOUT_S):
            return Finding(Level.OK, f"{host} answers at port {port}")
    except OSError as error:
        return Finding(
            Level.FAIL,
            f"{host} does not answer at port {port}: {error.strerror or error}",
            "open Tracking Streamer in the headset and press Start; both must be in one network, "
            "without a firewall or client isolation of the access point between them",
        )


DISTRIBUTION = "lerobot_teleoperator_xop"


def check_interpreter(setup: Setup) -> Finding:
    """Compare Python and its packages with what the installed distribution asks for."""
    del setup
    here = f"Python {platform.python_version()} in {sys.prefix}"
    try:
        metadata = importlib.metadata.metadata(DISTRIBUTION)
    except importlib.metadata.PackageNotFoundError:
        return Finding(
            Level.FAIL,
            f"{here} does not have {DISTRIBUTION}",
            "install it into this Python: pip install -e . in the project's folder",
        )
    wanted = metadata.get("Requires-Python") or ""
    if not SpecifierSet(wanted).contains(platform.python_version(), prereleases=True):
        return Finding(
            Level.FAIL, f"{here}; {wanted} is needed", "make a new environment with that Python"
        )
    faults = find_faults(importlib.metadata.requires(DISTRIBUTION) or [])
    if faults:
        return Finding(
            Level.FAIL,
            f"{here} lacks packages: {'; '.join(faults)}",
            "reinstall: pip install -e . in the project's folder",
            {"faults": faults},
        )
    return Finding(Level.OK, f"{here}, with all packages")


def find_faults(requirements: list[str]) -> list[str]:
    """List unfulfilled requirements of this Python, without extras."""
    faults = []
    for each in requirements:
        requirement = Requirement(each)
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        try:
            version = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            faults.append(f"{requirement.name} is not installed")
            continue
        if not requirement.specifier.contains(version, prereleases=True):
            faults.append(f"{requirement.name} is {version}, and {requirement.specifier} is needed")
    return faults


GOOD_HZ, LEAST_HZ = 50.0, 25.0
SLOW_S = 0.1
"""Who drives with a delay of more than this feels it [s]."""


def check_headset(setup: Setup) -> Finding:
    """Connect, and measure the stream; for a page, wait until it is opened."""
    if not setup.device:
        return Finding(
            Level.SKIP, "no headset was named", "pass --device avp --host ADDRESS, or webxr"
        )
    from xop_lerobot.operator.devices import DeviceConfig, make_device  # noqa: PLC0415
    from xop_lerobot.operator.devices.live import LiveDevice  # noqa: PLC0415

    config = DeviceConfig(type=setup.device, host=setup.host or None, port=setup.port)
    device = make_device(config)
    assert isinstance(device, LiveDevice)
    device.connect()
    try:
        end = time.monotonic() + setup.wait
        while device.read(0.0) is None and time.monotonic() < end:
            time.sleep(0.05)
        if device.read(0.0) is None:
            return Finding(
                Level.FAIL,
                f"{device.address}: no pose has come within {setup.wait:g} s"
                + (f" ({device.trouble})" if device.trouble else ""),
                "update xop-lerobot, or use a version of the app that this one speaks to"
                if "empty" in device.status.counts
                else "put the headset on, and open its app or the page's address",
                {"counts": device.status.counts},
            )
        return _measure(device, setup.seconds)
    finally:
        device.disconnect()


def _measure(device, seconds: float) -> Finding:  # noqa: ANN001  a LiveDevice, which is not loaded
    before = device.status.counts
    seen, ticks, ages = [0, 0, 0], 0, []
    begin = time.monotonic()
    while time.monotonic() < begin + seconds:
        frame = device.read(0.0)
        seen = [n + int(flag) for n, flag in zip(seen, frame.tracked, strict=True)]
        ages.append(device.status.age)
        ticks += 1
        time.sleep(0.02)
    status = device.status
    counts = {name: n - before.get(name, 0) for name, n in status.counts.items()}
    rate = counts.get("taken", 0) / (time.monotonic() - begin)
    shares = [round(n / ticks, 3) for n in seen]
    delay = None if status.delay is None else round(status.delay * 1e3, 1)
    gap = max(ages)
    figures = {
        "rate_hz": round(rate, 1),
        "delay_ms": delay,
        "longest_gap_ms": round(gap * 1e3, 1),
        "seen": dict(zip(("head", "left", "right"), shares, strict=True)),
        "hand_rates_hz": dict(zip(("left", "right"), status.hand_rates, strict=True)),
        "counts": {name: n for name, n in counts.items() if n},
    }
    late = "unknown" if delay is None else f"{delay:.0f} ms"
    text = (
        f"{device.address}: {rate:.0f} poses a second, delay {late}, longest gap "
        f"{gap * 1e3:.0f} ms; head, left and right hand seen for "
        f"{', '.join(f'{share:.0%}' for share in shares)} of the time"
    )
    if rate < LEAST_HZ or gap > device.config.stale_s:
        return Finding(
            Level.FAIL,
            text,
            "the robot would be disengaged repeatedly: come nearer to the access point, use "
            "5 GHz or a cable, and close other programs",
            figures,
        )
    if status.slow_hands:
        return Finding(
            Level.FAIL,
            f"{text}. {status.trouble}",
            "hold both hands in front of you, in good light, and close other apps of the headset: "
            "hands with so few poses cannot engage",
            figures,
        )
    if rate < GOOD_HZ or (status.delay or 0) > SLOW_S or min(shares) < 0.9:
        return Finding(
            Level.WARN,
            text,
            "hold both hands in front of you, in good light; a better network shortens the delay",
            figures,
        )
    return Finding(Level.OK, text, "", figures)


WANTED = {
    "robots": tuple(f"xop_{name}" for name in MORPHOLOGIES.built_in),
    "teleoperators": ("xop",),
}
_PLUGIN_CODE = """
import json
from lerobot.utils.import_utils import register_third_party_plugins
register_third_party_plugins()
from lerobot.robots.config import RobotConfig
from lerobot.teleoperators.config import TeleoperatorConfig
from xop_lerobot.recording.lerobot_patches import PATCHES, find_misfit
misfits = [(find_misfit(patch), patch.required) for patch in PATCHES]
print(json.dumps({"robots": sorted(RobotConfig.get_known_choices()),
                  "teleoperators": sorted(TeleoperatorConfig.get_known_choices()),
                  "patches": len(PATCHES),
                  "refused": [text for text, required in misfits if text and required],
                  "warned": [text for text, required in misfits if text and not required]}))
"""


def check_plugin(setup: Setup) -> Finding:
    """List LeRobot's types as its commands do, and check what is patched in it.

    In a separate process.
    """
    del setup
    answer = run_child(_PLUGIN_CODE, timeout=300.0)
    if not answer.ok:
        return Finding(
            Level.FAIL,
            f"LeRobot cannot be loaded: {answer.text}",
            "reinstall it: pip install -e .",
        )
    known = json.loads(answer.text.splitlines()[-1])
    missing = [name for kind, names in WANTED.items() for name in names if name not in known[kind]]
    if missing:
        return Finding(
            Level.FAIL,
            f"LeRobot does not know {', '.join(missing)}",
            "install this project into the same Python as LeRobot (pip install -e .), and look "
            "for a warning of LeRobot's about a plugin that it could not import",
            {"missing": missing},
        )
    here = (
        f"LeRobot {importlib.metadata.version('lerobot')} knows {', '.join(WANTED['robots'])} and "
        "the teleoperator xop"
    )
    misfits = [*known["refused"], *known["warned"]]
    if misfits:
        return Finding(
            Level.FAIL if known["refused"] else Level.WARN,
            f"{here}; of {known['patches']} patches of it {len(misfits)} do not fit. "
            + " ".join(misfits),
            "install the LeRobot that this release is made for (pip install -e .), or a newer "
            "release of this project",
            {"patches": known["patches"], "misfits": misfits},
        )
    return Finding(
        Level.OK,
        f"{here}; all {known['patches']} patches fit it",
        "",
        {"patches": known["patches"], "misfits": []},
    )
