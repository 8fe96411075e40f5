"""MuJoCo model of RB-Y1, built from its tables; other bases with its upper body reuse it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from xop_lerobot.morphology import links as rows
from xop_lerobot.morphology.links import FLOOR_BIT, Frame, Joint, Link, Shape
from xop_lerobot.morphology.rby1 import shapes
from xop_lerobot.morphology.rby1.links import LINKS

if TYPE_CHECKING:
    import mujoco

TIMESTEP = 0.005
"""Physics step [s]."""

FULL_TORQUE_ERROR = 0.01
"""Position error at which a torso or arm servo reaches its rated torque [rad].

The stiffness of a joint is its effort over this error, so it sags by at most 0.01 rad under any
load that it can carry (4 mrad at the ready pose). MuJoCo's gravity compensation is not used: it is
an external force without a reaction, so the wheels would carry only half the robot, which could
then lean anywhere without tipping.
"""

INERTIA = {
    "torso_0": 30.0, "torso_1": 30.0, "torso_2": 16.0, "torso_3": 5.5, "torso_4": 6.0,
    "torso_5": 3.0,
    "arm_0": 0.8, "arm_1": 0.5, "arm_2": 0.45, "arm_3": 0.4, "arm_4": 0.12, "arm_5": 0.13,
    "arm_6": 0.1,
}  # fmt: skip
"""Inertia about each joint at the ready pose, including the rotor [kg m^2]; sets the damping."""

ARMATURE = {"torso": 1.0, "arm": 0.1, "head": 0.05, "wheel": 0.2, "finger": 0.1}
"""Reflected rotor inertia by kind of joint [kg m^2], for fingers [kg]; estimates."""

JOINT_DAMPING = 0.5
"""Viscous friction of torso, arms and head [N m s/rad]."""

WHEEL_GAIN = 100.0
"""Wheel torque per speed error [N m s/rad]: in a curve at 0.8 m/s and 0.8 rad/s, where the mass
behind the axle straightens the path, 2 % of the yaw rate is lost."""

HEAD_GAINS = (200.0, 7.0)
"""k_p [N m/rad], k_d [N m s/rad]."""

FINGER_GAINS = (1500.0, 60.0)
"""k_p [N/m], k_d [N s/m]: 75 N when closing on an object of the full opening, 5 cm."""

GRIPPERS = {
    "left_gripper": ("gripper_finger_l2", "gripper_finger_l1"),
    "right_gripper": ("gripper_finger_r2", "gripper_finger_r1"),
}
"""Gripper motors: the finger joint that each drives, and the one that mirrors it."""


def compute_gains(joint: Joint) -> tuple[float, float]:
    r"""Servo gains of a torso or arm joint.

    :math:`k_p = \tau_{max} / e`, :math:`k_d = 2\sqrt{k_p I}`: critical damping of the inertia I.

    Returns:
        k_p [N m/rad] and k_d [N m s/rad].
    """
    stiffness = joint.effort / FULL_TORQUE_ERROR
    inertia = INERTIA[joint.name.removeprefix("left_").removeprefix("right_")]
    return stiffness, 2 * math.sqrt(stiffness * inertia)


def build_rby1(kind: str) -> mujoco.MjSpec:
    """Build RB-Y1 without a scene; see `build_on_base`."""
    return build_on_base("rby1", kind, LINKS, GRIPPERS, shapes.SHAPES, shapes.SITES, add_wheels)


def build_on_base(
    name: str,
    kind: str,
    links: Sequence[Link],
    grippers: Mapping[str, tuple[str, str]],
    looks: Sequence[Shape],
    sites: Sequence[Frame],
    add_base: Callable[[mujoco.MjSpec], None],
    wrist_cameras: Sequence[Frame] = shapes.WRIST_CAMERAS,
) -> mujoco.MjSpec:
    """Build a robot with the upper body of RB-Y1 on a given base, without a scene.

    The planning model has only the contacts with the floor, no visuals and no cameras.

    Args:
        name: Name of the model.
        kind: ``"full"`` or ``"planning"``.
        links: Its links.
        grippers: Gripper motors, as `GRIPPERS`.
        looks: Shapes for collision and display.
        sites: Its named frames.
        add_base: Adds the geoms, and motors if any, that act on the floor.
        wrist_cameras: The cameras of the hands.
    """
    import mujoco  # noqa: PLC0415

    planning = kind == "planning"
    spec = rows.new_spec(name, TIMESTEP)
    # Implicit integration of the servos' damping keeps the stiff joints stable at this step.
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    rows.add_links(spec, links, "base_joint")
    joints = {link.joint.name: link.joint for link in links if link.joint is not None}
    for joint in joints.values():
        add_motor(spec, joint)
    add_grippers(spec, joints, grippers)
    rows.add_sites(spec, sites)
    add_base(spec)
    if not planning:
        rows.add_materials(spec, shapes.MATERIALS)
        rows.add_shapes(spec, looks)
        for first, second in shapes.EXCLUDED:
            spec.add_exclude(bodyname1=first, bodyname2=second)
        rows.add_camera(spec, shapes.HEAD_CAMERA, shapes.HEAD_FOVY)
        for camera in wrist_cameras:
            rows.add_camera(spec, camera, shapes.WRIST_FOVY)
        rows.add_camera(spec, shapes.SCENE_CAMERA, shapes.SCENE_FOVY, tracking=True)
        rows.add_imu(spec)
    return spec


def add_motor(spec: mujoco.MjSpec, row: Joint) -> None:
    """Set armature, friction and motor of a joint; fingers get their motors in `add_grippers`."""
    import mujoco  # noqa: PLC0415

    joint = spec.joint(row.name)
    part = next(part for part in ARMATURE if part in row.name)
    joint.armature = ARMATURE[part]
    if part == "wheel":
        wheel = spec.add_actuator(name=row.name, target=row.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        wheel.set_to_velocity(kv=WHEEL_GAIN)
        wheel.forcelimited, wheel.forcerange = True, (-row.effort, row.effort)
        wheel.ctrllimited, wheel.ctrlrange = True, (-row.velocity, row.velocity)
    elif part == "head":
        joint.damping = (JOINT_DAMPING, 0, 0)
        rows.add_servo(spec, row, *HEAD_GAINS)
    elif part != "finger":
        joint.damping = (JOINT_DAMPING, 0, 0)
        rows.add_servo(spec, row, *compute_gains(row))


def add_grippers(
    spec: mujoco.MjSpec, joints: Mapping[str, Joint], grippers: Mapping[str, tuple[str, str]]
) -> None:
    """Add one motor per hand, whose target is the position of one finger [m]."""
    import mujoco  # noqa: PLC0415

    for name, (driven, mirrored) in grippers.items():
        rows.add_servo(spec, joints[driven], *FINGER_GAINS, name=name)
        equality = spec.add_equality(
            name=name,
            type=mujoco.mjtEq.mjEQ_JOINT,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            name1=mirrored,
            name2=driven,
        )
        equality.data[:5] = (0, -1, 0, 0, 0)  # polynomial: mirrored = -driven


def add_wheels(spec: mujoco.MjSpec) -> None:
    """Add the contacts with the floor: wheels with point contact, frictionless casters."""
    import mujoco  # noqa: PLC0415

    # With priority, these geoms' friction counts instead of the floor's.
    floor_only = {"contype": 0, "conaffinity": FLOOR_BIT, "mass": 0, "priority": 1, "group": 3}
    for side in ("left", "right"):
        spec.body(f"wheel_{side[0]}").add_geom(
            name=f"{side}_wheel",
            type=mujoco.mjtGeom.mjGEOM_ELLIPSOID,
            size=(shapes.WHEEL_RADIUS, 0.03, shapes.WHEEL_RADIUS),
            friction=(1.0, 0.005, 0.0001),
            **floor_only,
        )
    for name, pos in shapes.CASTERS.items():
        spec.body("base").add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=(shapes.CASTER_RADIUS, 0, 0),
            pos=pos,
            condim=1,
            **floor_only,
        )
