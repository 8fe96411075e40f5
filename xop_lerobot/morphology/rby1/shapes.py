"""Shapes of RB-Y1 for display and collision, its cameras and named frames."""

from __future__ import annotations

from xop_lerobot.morphology.links import Frame, Shape, look, mirror

WHEEL_RADIUS = 0.1
"""Radius of the driven wheels [m]."""

TRACK = 0.53
"""Distance between the contact points of the wheels [m]."""

CASTER_RADIUS = 0.03
CASTERS = {"left_caster": (-0.275, 0.085, CASTER_RADIUS), "right_caster": (-0.275, -0.085,
CASTER_RADIUS)}  # fmt: skip
"""Centres of the spheres that represent the casters, in the base frame [m]; frictionless."""

MATERIALS = {
    "shell": (0.90, 0.91, 0.92, 0.3),
    "grey": (0.62, 0.64, 0.67, 0.2),
    "dark": (0.14, 0.14, 0.16, 0.2),
    "visor": (0.03, 0.03, 0.05, 0.9),
    "accent": (0.13, 0.36, 0.72, 0.2),
}
"""Red, green, blue, gloss."""

ACROSS = (1.5708, 0, 0)
"""Orientation of a cylinder along Y: roll, pitch, yaw [rad]."""

BODY = (
    Shape("base", "box", (0.32, 0.235, 0.09), (-0.018, 0, 0.16), material="shell"),
    look("base", "box", (0.305, 0.222, 0.025), "dark", pos=(-0.018, 0, 0.05)),
    look("base", "box", (0.012, 0.12, 0.02), "visor", pos=(0.296, 0, 0.19)),
    Shape("base", "box", (0.19, 0.15, 0.05), (-0.135, 0, 0.29), material="grey"),
    look("base", "cylinder", (0.15, 0.05), "grey", pos=(0.05, 0, 0.29)),
    Shape("link_torso_0", "capsule", (0.09,), ends=(-0.17, 0, 0, 0, 0, 0), material="dark"),
    look("link_torso_1", "cylinder", (0.1, 0.105), "dark", rpy=ACROSS),
    Shape("link_torso_1", "capsule", (0.092,), ends=(0.01, 0, 0.1, 0.01, 0, 0.27),
          material="shell"),
    look("link_torso_2", "cylinder", (0.095, 0.1), "dark", rpy=ACROSS),
    Shape("link_torso_2", "capsule", (0.084,), ends=(0.015, 0, 0.1, 0.015, 0, 0.26),
          material="shell"),
    look("link_torso_3", "cylinder", (0.085, 0.095), "dark", rpy=ACROSS),
    Shape("link_torso_4", "capsule", (0.09,), ends=(-0.1, 0, 0.0385, 0.01, 0, 0.0385),
          material="shell"),
    look("link_torso_4", "cylinder", (0.075, 0.06), "dark", pos=(-0.015, 0, 0.15)),
    Shape("link_torso_5", "box", (0.095, 0.13, 0.13), (-0.025, 0, -0.01), material=None),
    look("link_torso_5", "capsule", (0.095,), "shell",
         ends=(-0.02, -0.09, 0.05, -0.02, 0.09, 0.05)),
    look("link_torso_5", "ellipsoid", (0.115, 0.155, 0.17), "shell", pos=(-0.02, 0, -0.03)),
    look("link_torso_5", "ellipsoid", (0.02, 0.05, 0.012), "accent", pos=(0.082, 0, 0.0)),
    look("link_head_0", "cylinder", (0.042, 0.045), "dark", pos=(0, 0, 0.03)),
    look("link_head_1", "sphere", (0.045,), "dark"),
    Shape("link_head_2", "box", (0.035, 0.06, 0.035), (0.045, 0, 0.07), material=None),
    look("link_head_2", "capsule", (0.05,), "shell",
         ends=(0.035, -0.055, 0.07, 0.035, 0.055, 0.07)),
    look("link_head_2", "capsule", (0.034,), "visor",
         ends=(0.06, -0.052, 0.07, 0.06, 0.052, 0.07)),
)  # fmt: skip

WHEELS = tuple(
    look(f"wheel_{side}", kind, size, material, rpy=ACROSS)
    for side in ("l", "r")
    for kind, size, material in (
        ("cylinder", (WHEEL_RADIUS - 0.001, 0.026), "dark"),
        ("cylinder", (0.055, 0.028), "grey"),
    )
)

LEFT = (
    Shape("link_left_arm_0", "capsule", (0.07,),
          ends=(-0.035, -0.018, -0.008, 0.012, -0.018, -0.008), material="dark"),
    look("link_left_arm_1", "sphere", (0.074,), "shell", pos=(0, 0.01, 0)),
    Shape("link_left_arm_1", "capsule", (0.052,), ends=(0, 0, 0, 0, 0, -0.12), material="shell"),
    look("link_left_arm_2", "capsule", (0.047,), "grey", ends=(0, 0, -0.15, 0.01, 0, -0.24)),
    Shape("link_left_arm_2", "cylinder", (0.05, 0.055), (0.026, 0, -0.276), ACROSS,
          material="dark"),
    Shape("link_left_arm_3", "capsule", (0.042,), ends=(-0.031, 0, -0.05, -0.031, 0, -0.165),
          material="shell"),
    Shape("link_left_arm_4", "capsule", (0.033,), ends=(0, 0.03, -0.02, 0, 0.03, 0.065),
          material="dark"),
    Shape("link_left_arm_5", "capsule", (0.046,), ends=(0, 0, 0, 0, 0, -0.06), material="shell"),
    Shape("link_left_arm_6", "cylinder", (0.042, 0.018), (0, 0, -0.108), material="dark"),
    Shape("ee_left", "box", (0.058, 0.03, 0.036), (0, 0, -0.038), material="grey",
          name="left_hand"),
)  # fmt: skip


def _finger(link: str) -> Shape:
    """Return the pad of a finger; the pads of a closed gripper touch in the middle."""
    return Shape(link, "box", (0.008, 0.012, 0.035), (0.005, 0, -0.035), material="dark", name=link)


FINGERS = tuple(_finger(f"ee_finger_{finger}") for finger in ("r1", "r2", "l1", "l2"))

SHAPES = (*BODY, *WHEELS, *LEFT, *(mirror(shape) for shape in LEFT), *FINGERS)

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
    *((f"link_{side}_arm_6", f"ee_finger_{side[0]}{i}")
      for side in ("left", "right") for i in (1, 2)),
    ("ee_finger_r1", "ee_finger_r2"),
    ("ee_finger_l1", "ee_finger_l2"),
)  # fmt: skip
"""Pairs of links excluded from collision, since their shapes overlap by construction."""

SITES = (
    Frame("head", "link_head_2", (0.05, 0, 0.06)),
    Frame("imu", "base", (0, 0, 0.2)),
    Frame("left_wrist", "ee_left", (0, 0, 0), (0, 0, -1), (0, 1, 0)),
    Frame("right_wrist", "ee_right", (0, 0, 0), (0, 0, -1), (0, -1, 0)),
    Frame("left_palm", "ee_left", (0, 0, -0.12), (0, 0, -1), (0, 1, 0)),
    Frame("right_palm", "ee_right", (0, 0, -0.12), (0, 0, -1), (0, -1, 0)),
    Frame("left_elbow", "link_left_arm_3", (0, 0, 0)),
    Frame("right_elbow", "link_right_arm_3", (0, 0, 0)),
    Frame("hull_front_left", "base", (0.19, 0.145, 0.2)),
    Frame("hull_front_right", "base", (0.19, -0.145, 0.2)),
    Frame("hull_rear_left", "base", (-0.22, 0.145, 0.2)),
    Frame("hull_rear_right", "base", (-0.22, -0.145, 0.2)),
    Frame("left_wheel_center", "wheel_l", (0, 0, 0)),
    Frame("right_wheel_center", "wheel_r", (0, 0, 0)),
)
"""Hands point along the gripper's -Z; the back of the hand faces outwards, the palm inwards."""

HEAD_CAMERA = Frame(
    "head", "link_head_2", (0.095, 0, 0.065), (0.8253, 0, -0.5646), (0.5646, 0, 0.8253)
)
"""Camera in the face, pitched down by 0.6 rad."""

HEAD_FOVY = 58.0
"""Vertical field of view of the head camera [deg]."""

WRIST_CAMERAS = (
    Frame("left_wrist", "ee_left", (0, 0.16, 0.06), (0, -0.62, -0.78), (1, 0, 0)),
    Frame("right_wrist", "ee_right", (0, -0.16, 0.06), (0, 0.62, -0.78), (1, 0, 0)),
)
"""On the back of the hand, looking at the fingers."""

WRIST_FOVY = 75.0
"""Vertical field of view of the wrist cameras [deg]."""

SCENE_CAMERA = Frame("scene", "base", (1.75, 1.4, 1.15), (-1.75, -1.4, -0.5))
"""From the front left, following the base and showing the whole robot."""
SCENE_FOVY = 45.0
"""Vertical field of view of the scene camera [deg]."""
