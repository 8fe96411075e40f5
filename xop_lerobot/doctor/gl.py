"""Whether pictures can be rendered."""

from __future__ import annotations

import os

from xop_lerobot.doctor.child import run_child
from xop_lerobot.doctor.finding import Finding, Level, Setup
from xop_lerobot.plant.gl import choose_backends

_CODE = """
import time
from xop_lerobot.plant.gl import make_gl_context
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
    """Render a ball in a Python of its own: a bad driver ends that, and not us."""
    del setup
    answer = run_child(_CODE)
    tried = ", ".join(choose_backends()) or "none"
    variable = os.environ.get("MUJOCO_GL", "")
    if not answer.ok:
        return Finding(
            Level.FAIL,
            f"no pictures (tried: {tried}): {answer.text}",
            "install Mesa's EGL (apt-get install libegl1 libgl1-mesa-dri), "
            + (f"or unset MUJOCO_GL={variable}" if variable else "or record without cameras"),
        )
    took, name = answer.text.split("|", 1)
    figures = {"picture_ms": float(took), "renderer": name, "backend": tried.split(",")[0]}
    text = f"a picture of 640 x 480 takes {took} ms ({tried.split(',')[0]}, {name})"
    if any(word in name.lower() for word in ("llvmpipe", "softpipe", "swrast")):
        return Finding(
            Level.WARN,
            f"{text}; no graphics card is used",
            "smaller or fewer pictures cost less: --robot.width, --robot.height, --robot.cameras",
            figures,
        )
    return Finding(Level.OK, text, "", figures)
