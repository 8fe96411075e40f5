r"""MuJoCo model of RB-Y1 M: the upper body of RB-Y1 A on four mecanum wheels.

The rollers are ideal: they roll without friction perpendicular to their axis and never slip along
it. So the motor of a wheel acts on the base at the wheel's ground contact, along the axis of the
roller there, and its speed is that of the contact point along this axis:

.. math:: r \omega_i = v_{x,i} + s_i v_{y,i}, \qquad F_i = \frac{\tau_i}{r} (1, s_i)

with the velocity of the contact point in the base's axes and :math:`s_i = \pm 1` by the mounting
direction of the rollers. The rotation of a wheel is not a joint of the model, and the contacts
with the ground only carry the weight.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from xop_lerobot.morphology.links import FLOOR_BIT
from xop_lerobot.morphology.rby1.model import build_on_base
from xop_lerobot.morphology.rby1m import shapes
from xop_lerobot.morphology.rby1m.links import LINKS, WHEEL_RADIUS

if TYPE_CHECKING:
    import mujoco

GRIPPERS = {
    "left_gripper": ("gripper_finger_l1", "gripper_finger_l2"),
    "right_gripper": ("gripper_finger_r1", "gripper_finger_r2"),
}
"""Gripper motors: the finger joint that each drives, and the one that mirrors it."""

ROLLERS = {"fr": 1.0, "fl": -1.0, "rr": -1.0, "rl": 1.0}
"""Coefficient s of the lateral velocity in the speed of each wheel [1]: seen from above, the upper
rollers form an X and those on the ground a diamond, the usual mounting."""

WHEEL_GAIN = 60.0
"""Torque per speed error of a wheel [N m s/rad]."""

WHEEL_TORQUE = 24.0
"""Torque limit of a wheel [N m]; the URDF gives none. That is 316 N along the floor, about the
traction of a wheel that carries a quarter of 164 kg."""

WHEEL_SPEED = 31.4
"""Speed limit of a wheel [rad/s]; the URDF gives none."""


def build_rby1m(kind: str) -> mujoco.MjSpec:
    """Build RB-Y1 M without a scene; see `build_on_base`."""
    return build_on_base(
        "rby1m",
        kind,
        LINKS,
        GRIPPERS,
        shapes.SHAPES,
        shapes.SITES,
        add_wheels,
        shapes.WRIST_CAMERAS,
    )


def add_wheels(spec: mujoco.MjSpec) -> None:
    """Add the frictionless ground contact of each wheel, and its motor."""
    import mujoco  # noqa: PLC0415

    for name, wheel in shapes.WHEELS.items():
        spec.body(f"wheel_{wheel}_link").add_geom(
            name=f"{name}_wheel",
            type=mujoco.mjtGeom.mjGEOM_ELLIPSOID,
            size=(WHEEL_RADIUS, 0.03, WHEEL_RADIUS),
            condim=1,
            contype=0,
            conaffinity=FLOOR_BIT,
            mass=0,
            priority=1,
            group=3,
        )
        motor = spec.add_actuator(
            name=f"wheel_{wheel}", target=f"wheel_{wheel}", trntype=mujoco.mjtTrn.mjTRN_SITE
        )
        motor.set_to_velocity(kv=WHEEL_GAIN)
        motor.gear = (1 / WHEEL_RADIUS, ROLLERS[wheel] / WHEEL_RADIUS, 0, 0, 0, 0)
        motor.forcelimited, motor.forcerange = True, (-WHEEL_TORQUE, WHEEL_TORQUE)
        motor.ctrllimited, motor.ctrlrange = True, (-WHEEL_SPEED, WHEEL_SPEED)
