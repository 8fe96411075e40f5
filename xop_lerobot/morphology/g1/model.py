"""MuJoCo model of G1, built from its tables."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xop_lerobot.morphology import links as rows
from xop_lerobot.morphology.g1 import shapes
from xop_lerobot.morphology.g1.links import LINKS
from xop_lerobot.morphology.links import FLOOR_BIT

if TYPE_CHECKING:
    import mujoco

TIMESTEP = 0.005
"""Physics step [s], as in FALCON's training."""

GAINS = {
    "hip_pitch": (100.0, 2.5),
    "hip_roll": (100.0, 2.5),
    "hip_yaw": (100.0, 2.5),
    "knee": (200.0, 5.0),
    "ankle_pitch": (20.0, 0.2),
    "ankle_roll": (20.0, 0.1),
    "waist_yaw": (300.0, 5.0),
    "waist_roll": (300.0, 5.0),
    "waist_pitch": (300.0, 5.0),
    "shoulder_pitch": (90.0, 2.0),
    "shoulder_roll": (60.0, 1.0),
    "shoulder_yaw": (20.0, 0.4),
    "elbow": (60.0, 1.0),
    "wrist_roll": (4.0, 0.2),
    "wrist_pitch": (4.0, 0.2),
    "wrist_yaw": (4.0, 0.2),
}
"""FALCON's gains k_p [N m/rad] and k_d [N m s/rad] by kind of joint."""

JOINT_DAMPING = 0.05
"""Viscous friction of every joint [N m s/rad]."""

ARMATURE = 0.01
"""Reflected rotor inertia of every joint [kg m^2]."""

FRICTION_LOSS, WRIST_FRICTION_LOSS = 0.2, 0.1
"""Dry friction of the joints and of the wrist's pitch and yaw [N m]."""


def joint_kind(joint: str) -> str:
    """Return the kind of a joint: ``"knee"`` for ``"left_knee_joint"``."""
    return joint.removesuffix("_joint").removeprefix("left_").removeprefix("right_")


def build_g1(kind: str) -> mujoco.MjSpec:
    """Build G1 without a scene.

    The planning model has only the contact spheres of the feet, which collide with the floor
    alone. It has no dry friction, which saves 29 constraint rows, no visuals and no cameras.

    Args:
        kind: ``"full"`` or ``"planning"``.
    """
    planning = kind == "planning"
    spec = rows.new_spec("g1", TIMESTEP)
    rows.add_links(spec, LINKS, "floating_base_joint")
    for link in LINKS:
        if link.joint is None:
            continue
        joint_type = joint_kind(link.joint.name)
        joint = spec.joint(link.joint.name)
        joint.damping, joint.armature = (JOINT_DAMPING, 0, 0), ARMATURE
        if not planning:
            wrist = joint_type in ("wrist_pitch", "wrist_yaw")
            joint.frictionloss = WRIST_FRICTION_LOSS if wrist else FRICTION_LOSS
        rows.add_servo(spec, link.joint, *GAINS[joint_type])
    rows.add_sites(spec, shapes.SITES)
    add_feet(spec)
    if not planning:
        rows.add_materials(spec, shapes.MATERIALS)
        rows.add_shapes(spec, shapes.SHAPES)
        for geom in (spec.geom(f"{side}_sole") for side in ("left", "right")):
            # Soles collide with links and objects; the spheres collide with the ground.
            geom.contype, geom.conaffinity = rows.ROBOT_BIT, rows.ROBOT_BIT | rows.OBJECT_BIT
        for first, second in shapes.EXCLUDED:
            spec.add_exclude(bodyname1=first, bodyname2=second)
        rows.add_camera(spec, shapes.HEAD_CAMERA, shapes.HEAD_FOVY)
        for camera in shapes.WRIST_CAMERAS:
            rows.add_camera(spec, camera, shapes.WRIST_FOVY)
        rows.add_camera(spec, shapes.SCENE_CAMERA, shapes.SCENE_FOVY, tracking=True)
        rows.add_imu(spec)
    return spec


def add_feet(spec: mujoco.MjSpec) -> None:
    """Add four contact spheres per foot, which collide with the floor."""
    import mujoco  # noqa: PLC0415

    for side in ("left", "right"):
        foot = spec.body(f"{side}_ankle_roll_link")
        for i, point in enumerate(shapes.FOOT_POINTS):
            foot.add_geom(
                name=f"{side}_foot_{i}",
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=(shapes.FOOT_RADIUS, 0, 0),
                pos=point,
                mass=0,
                contype=0,
                conaffinity=FLOOR_BIT,
                group=3,
            )
