"""Shapes of RB-Y1 M that differ from those of RB-Y1 A, its wrist cameras and named frames."""

from __future__ import annotations

from xop_lerobot.morphology.links import Frame, Shape, look, mirror
from xop_lerobot.morphology.rby1.shapes import ACROSS
from xop_lerobot.morphology.rby1.shapes import SHAPES as RBY1_SHAPES
from xop_lerobot.morphology.rby1.shapes import SITES as RBY1_SITES
from xop_lerobot.morphology.rby1m.links import WHEEL_RADIUS

WHEELS = {"front_right": "fr", "front_left": "fl", "rear_right": "rr", "rear_left": "rl"}
"""Names of the wheels, and their abbreviations in the names of links and motors."""

BASE = (
    Shape("base", "box", (0.3, 0.205, 0.09), (-0.002, 0, 0.16), material="shell"),
    look("base", "box", (0.285, 0.19, 0.025), "dark", pos=(-0.002, 0, 0.05)),
    look("base", "box", (0.012, 0.12, 0.02), "visor", pos=(0.292, 0, 0.19)),
    Shape("base", "box", (0.19, 0.15, 0.05), (-0.1, 0, 0.3), material="grey"),
    look("base", "cylinder", (0.15, 0.05), "grey", pos=(0.03, 0, 0.3)),
    *(
        look(f"wheel_{wheel}_link", "cylinder", size, material, rpy=ACROSS)
        for wheel in WHEELS.values()
        for size, material in (((WHEEL_RADIUS - 0.001, 0.03), "dark"), ((0.045, 0.032), "grey"))
    ),
)

LEFT = (
    Shape("link_left_arm_3", "capsule", (0.042,), ends=(-0.031, 0, -0.05, -0.031, 0, -0.19),
          material="shell"),
    Shape("link_left_arm_4", "capsule", (0.038,), ends=(0, 0, 0.02, 0, 0, 0.1), material="dark"),
    look("link_left_arm_5", "sphere", (0.046,), "shell"),
    Shape("link_left_arm_6", "capsule", (0.042,), ends=(0, 0, -0.03, 0, 0, -0.085),
          material="shell"),
    Shape("ee_left", "box", (0.03, 0.058, 0.036), (0, 0, -0.038), material="grey",
          name="left_hand"),
)  # fmt: skip

FINGERS = tuple(
    # The finger frames are at the flange; the offset puts the pads where RB-Y1 A has them.
    Shape(name, "box", (0.008, 0.012, 0.035), (0.008, 0, -0.11), material="dark", name=name)
    for name in ("ee_finger_r1", "ee_finger_r2", "ee_finger_l1", "ee_finger_l2")
)

WRIST_CAMERAS = tuple(
    Frame(f"{side}_wrist", f"ee_{side}", (0.15, 0, 0.06), (-0.62, 0, -0.78), (1, 0, 0))
    for side in ("left", "right")
)
"""Above the hand, looking at the fingers, which open sideways."""

_OWN = (*BASE, *LEFT, *(mirror(shape) for shape in LEFT), *FINGERS)
_REPLACED = {"wheel_l", "wheel_r", *(shape.link for shape in _OWN)}

SHAPES = (*(shape for shape in RBY1_SHAPES if shape.link not in _REPLACED), *_OWN)

SITES = (
    *(site for site in RBY1_SITES if site.link not in ("base", "wheel_l", "wheel_r")),
    Frame("imu", "base", (0, 0, 0.2)),
    Frame("hull_front_left", "base", (0.18, 0.13, 0.2)),
    Frame("hull_front_right", "base", (0.18, -0.13, 0.2)),
    Frame("hull_rear_left", "base", (-0.184, 0.13, 0.2)),
    Frame("hull_rear_right", "base", (-0.184, -0.13, 0.2)),
    *(Frame(f"{name}_wheel_center", f"wheel_{w}_link", (0, 0, 0)) for name, w in WHEELS.items()),
    *(Frame(f"wheel_{w}", f"wheel_{w}_link", (0, 0, -WHEEL_RADIUS)) for w in WHEELS.values()),
)
"""Sites of the upper body are those of RB-Y1 A; `wheel_*` are the ground contacts."""
