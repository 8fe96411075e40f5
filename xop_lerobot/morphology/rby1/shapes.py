"""RB-Y1: the primitives that make its looks and its collisions, its cameras and named frames."""

from __future__ import annotations

from xop_lerobot.morphology.links import Frame, Shape, look, mirror

WHEEL_RADIUS = 0.1
"""Radius of the driven wheels [m]."""

TRACK = 0.53
"""Distance between the contact points of the wheels [m]."""

CASTER_RADIUS = 0.03
CASTERS = {"left_caster": (-0.275, 0.085, CASTER_RADIUS), "right_caster": (-0.275, -0.085, CASTER_RADIUS)}  # fmt: skip  # noqa: E501
"""Centres of the spheres that stand for the casters, in the base [m]; they slide freely."""

MATERIALS = {
    "shell": (0.90, 0.91, 0.92, 0.3),
    "grey": (0.62, 0.64, 0.67, 0.2),
    "dark": (0.14, 0.14, 0.16, 0.2),
    "visor": (0.03, 0.03, 0.05, 0.9),
    "accent": (0.13, 0.36, 0.72, 0.2),
}
"""Red, green, blue, gloss."""

BODY = (
    Shape("base", "box", (0.32, 0.235, 0.105), (-0.018, 0, 0.145), material="shell"),
    Shape("base", "box", (0.20, 0.15, 0.055), (-0.12, 0, 0.305), material="shell"),
    Shape("link_torso_0", "capsule", (0.1,), ends=(-0.19, 0, 0, 0, 0, 0), material="dark"),
    Shape("link_torso_1", "capsule", (0.1,), ends=(0.01, 0, 0.09, 0.01, 0, 0.29), material="shell"),
    Shape("link_torso_2", "capsule", (0.088,), ends=(0.02, 0, 0.09, 0.02, 0, 0.26),
          material="shell"),
    Shape("link_torso_4", "capsule", (0.1,), ends=(-0.1, 0, 0.0385, 0.01, 0, 0.0385),
          material="dark"),
    Shape("link_torso_5", "box", (0.1, 0.135, 0.14), (-0.03, 0, -0.01), material="shell"),
    Shape("link_head_2", "box", (0.035, 0.075, 0.05), (0.055, 0, 0.06), material="shell"),
)  # fmt: skip

LEFT = (
    Shape("link_left_arm_0", "capsule", (0.07,), ends=(-0.045, -0.018, -0.008, 0.02, -0.018, -0.008),
          material="dark"),
    Shape("link_left_arm_1", "capsule", (0.052,), ends=(0, 0, 0, 0, 0, -0.19), material="shell"),
    Shape("link_left_arm_2", "capsule", (0.048,), ends=(0.026, -0.035, -0.276, 0.026, 0.035, -0.276),
          material="dark"),
    Shape("link_left_arm_3", "capsule", (0.042,), ends=(-0.031, 0, -0.05, -0.031, 0, -0.165),
          material="shell"),
    Shape("link_left_arm_4", "capsule", (0.035,), ends=(0, 0.038, -0.03, 0, 0.038, 0.065),
          material="dark"),
    Shape("link_left_arm_5", "capsule", (0.048,), ends=(0, 0, -0.0, 0, 0, -0.06),
          material="shell"),
    Shape("link_left_arm_6", "cylinder", (0.042, 0.018), (0, 0, -0.108), material="dark"),
    Shape("ee_left", "box", (0.055, 0.032, 0.036), (0, 0, -0.038), material="shell",
          name="left_hand"),
)  # fmt: skip


def _finger(link: str) -> Shape:
    """Return the pad of a finger; closed fingers meet in the middle."""
    return Shape(link, "box", (0.008, 0.012, 0.035), (0.005, 0, -0.035), material="dark", name=link)


FINGERS = tuple(_finger(f"ee_finger_{finger}") for finger in ("r1", "r2", "l1", "l2"))

SHAPES = (*BODY, *LEFT, *(mirror(shape) for shape in LEFT), *FINGERS)

EXCLUDED = (
    ("base", "link_torso_1"),
    ("link_torso_0", "link_torso_2"),
    ("link_torso_1", "link_torso_3"),
    ("link_torso_2", "link_torso_4"),
    ("link_torso_5", "link_head_2"),
    *((("link_torso_5"), f"link_{side}_arm_1") for side in ("left", "right")),
    *((f"link_{side}_arm_{i}", f"link_{side}_arm_{i + 2}")
      for side in ("left", "right") for i in (0, 2, 3, 4)),
    *((f"link_{side}_arm_5", f"ee_{side}") for side in ("left", "right")),
    *((f"link_{side}_arm_6", f"ee_finger_{side[0]}{i}") for side in ("left", "right") for i in (1, 2)),
    ("ee_finger_r1", "ee_finger_r2"),
    ("ee_finger_l1", "ee_finger_l2"),
)  # fmt: skip
"""Pairs of links whose shapes overlap by construction and never collide."""

SITES = (
    Frame("head", "link_head_2", (0.05, 0, 0.06)),
    Frame("imu", "base", (0, 0, 0.2)),
    Frame("left_wrist", "ee_left", (0, 0, 0), (0, 0, -1), (0, 1, 0)),
    Frame("right_wrist", "ee_right", (0, 0, 0), (0, 0, -1), (0, -1, 0)),
    Frame("left_palm", "ee_left", (0, 0, -0.12), (0, 0, -1), (0, 1, 0)),
    Frame("right_palm", "ee_right", (0, 0, -0.12), (0, 0, -1), (0, -1, 0)),
    Frame("left_wheel_center", "wheel_l", (0, 0, 0)),
    Frame("right_wheel_center", "wheel_r", (0, 0, 0)),
)
"""Hands point along the gripper's -Z; the back of the hand faces outwards, the palm inwards."""

HEAD_CAMERA = Frame(
    "head", "link_head_2", (0.095, 0, 0.065), (0.8253, 0, -0.5646), (0.5646, 0, 0.8253)
)
"""The camera in the face, pitched down by 0.6 rad."""

HEAD_FOVY = 58.0
"""Vertical field of view of the head camera [deg]."""

WRIST_CAMERAS = (
    Frame("left_wrist", "ee_left", (0, 0.065, 0.0), (0, -0.3, -0.95), (1, 0, 0)),
    Frame("right_wrist", "ee_right", (0, -0.065, 0.0), (0, 0.3, -0.95), (1, 0, 0)),
)
WRIST_FOVY = 75.0

SCENE_CAMERA = Frame("scene", "base", (2.0, 1.5, 1.15), (-2.0, -1.5, -0.5), (0, 0, 1))
SCENE_FOVY = 45.0
