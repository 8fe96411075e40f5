"""Checks of `xop-doctor` on this machine and its installation; each returns a finding.

Anything that may crash or hang (a driver, a plugin) runs in a child process.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import shutil
import sys

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from xop_lerobot.doctor.finding import Finding, Level, Setup, run_child
from xop_lerobot.morphology.morphology import MORPHOLOGIES
from xop_lerobot.plant.rendering import choose_backends

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
    """Render a sphere in a child process, which a faulty driver may crash."""
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
"""Free space below which the check warns, and fails [GB]."""


def check_disk(setup: Setup) -> Finding:
    """Check free space at the folder, or at its nearest existing parent."""
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


STEPS, WARMUP = 40, 10
"""Timed and untimed plans of the CPU check."""
SHARE = 0.8
"""Share of the period above which the planner leaves too little time for the rest."""


def check_cpu(setup: Setup) -> Finding:
    """Time the robot's planner and compare it with its period."""
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


DISTRIBUTION = "lerobot_teleoperator_xop"


def check_interpreter(setup: Setup) -> Finding:
    """Check Python and its packages against the requirements of the installed distribution."""
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
    """List unmet requirements of this Python, without extras."""
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
    """Check in a child process that LeRobot lists this project's types and fits every patch."""
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
