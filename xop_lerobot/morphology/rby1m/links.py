"""Link table of RB-Y1 M v1.3, from the manufacturer's URDF (rby1-sdk, Apache-2.0).

Torso, upper arms and head are those of RB-Y1 A; base, wheels, forearms, wrists and hands differ.
See docs/how_it_works/models.md.
"""

from dataclasses import replace

from xop_lerobot.morphology.links import Joint, Link
from xop_lerobot.morphology.rby1.links import LINKS as RBY1_LINKS
from xop_lerobot.morphology.rby1.links import PLACEHOLDER

HALF_LENGTH, HALF_WIDTH, WHEEL_RADIUS = 0.245, 0.245, 0.076
"""Distances of the wheels from their common centre along X and Y, and their radius [m]."""

BASE = (
    Link(
        "base",
        None,
        pos=(0, 0, 0),
        mass=82.93082168,
        com=(-0.05361531, -0.00279946, 0.13500266),
        inertia=(2.38184773, 4.04857218, 5.45210782, 0.00958286, 0.32695003, -0.01527373),
    ),
    Link(
        "wheel_fr_link",
        "base",
        pos=(0.243, -0.245, 0.076),
        mass=2.54410022,
        com=(-0.00010511, 0.0009458, 0),
        inertia=(0.00470985, 0.00616429, 0.00470754, -2.5e-07, 0, 0),
    ),
    Link(
        "wheel_fl_link",
        "base",
        pos=(0.243, 0.245, 0.076),
        mass=2.54417879,
        com=(-0.00010433, -0.00094577, 0),
        inertia=(0.00471013, 0.00616468, 0.00470782, 2.5e-07, 0, 0),
    ),
    Link(
        "wheel_rr_link",
        "base",
        pos=(-0.247, -0.245, 0.076),
        mass=2.54410022,
        com=(-0.00010511, 0.0009458, 0),
        inertia=(0.00470985, 0.00616429, 0.00470754, -2.5e-07, 0, 0),
    ),
    Link(
        "wheel_rl_link",
        "base",
        pos=(-0.247, 0.245, 0.076),
        mass=2.54417879,
        com=(-0.00010433, -0.00094577, 0),
        inertia=(0.00471013, 0.00616468, 0.00470782, 2.5e-07, 0, 0),
    ),
)
"""The wheels have no joints: their motors act on the base (`model.py`)."""

CHANGED = (
    Link(
        "link_right_arm_4",
        "link_right_arm_3",
        pos=(-0.031, 0, -0.3095),
        mass=1.49373286,
        com=(-6.159e-05, 0.00402933, 0.09539632),
        inertia=(0.00327354, 0.00252231, 0.00186828, -4.05e-06, -2.7e-07, -1.749e-05),
        joint=Joint("right_arm_4", (0, 0, 1), (-3.141592654, 3.141592654), 10, 6.283185308),
    ),
    Link(
        "link_right_arm_5",
        "link_right_arm_4",
        pos=(0, 0, 0),
        mass=0.8716378,
        com=(0.00178191, 0.00092083, 6.831e-05),
        inertia=(0.00047456, 0.00056446, 0.00067619, 2.11e-05, 2.22e-06, -1.1e-07),
        joint=Joint("right_arm_5", (0, 1, 0), (-0.872664626, 0.872664626), 10, 6.283185308),
    ),
    Link(
        "link_right_arm_6",
        "link_right_arm_5",
        pos=(0, 0, 0),
        mass=0.74448182,
        com=(0.00706872, -0.00102308, -0.08649522),
        inertia=(0.00187469, 0.00160335, 0.00115053, -3.209e-05, -0.00035074, 5e-08),
        joint=Joint("right_arm_6", (1, 0, 0), (-1.5707963268, 1.5707963268), 8, 2.094395102),
    ),
    Link(
        "ee_right",
        "link_right_arm_6",
        pos=(0, 0, -0.125),
        mass=0.47470074,
        com=(0.00041345, 0.00160451, -0.02702162),
        inertia=(0.00053136, 0.00031059, 0.00060261, 1.907e-05, 5e-07, 8.8e-06),
    ),
    Link(
        "ee_finger_r1",
        "ee_right",
        pos=(0, 0, 0),
        quat=(0.7071067811865476, 0, 0, 0.7071067811865476),
        mass=0.03326999,
        com=(0.00278346, -3.29e-06, -0.02570112),
        inertia=(1.231e-05, 1.066e-05, 2.24e-06, 0, -4.2e-07, 0),
        joint=Joint("gripper_finger_r1", (1, 0, 0), (0, 0.05), PLACEHOLDER, 0.05, slides=True),
    ),
    Link(
        "ee_finger_r2",
        "ee_right",
        pos=(0, 0, 0),
        quat=(0.7071067811865476, 0, 0, -0.7071067811865476),
        mass=0.03326999,
        com=(0.00278346, -3.29e-06, -0.02570112),
        inertia=(1.231e-05, 1.066e-05, 2.24e-06, 0, -4.2e-07, 0),
        joint=Joint("gripper_finger_r2", (-1, 0, 0), (-0.05, 0), PLACEHOLDER, 0.05, slides=True),
    ),
    Link(
        "link_left_arm_4",
        "link_left_arm_3",
        pos=(-0.031, 0, -0.3095),
        mass=1.49373286,
        com=(6.159e-05, -0.00402933, 0.09539632),
        inertia=(0.00327354, 0.00252231, 0.00186828, -4.05e-06, 2.7e-07, 1.749e-05),
        joint=Joint("left_arm_4", (0, 0, 1), (-3.141592654, 3.141592654), 10, 6.283185308),
    ),
    Link(
        "link_left_arm_5",
        "link_left_arm_4",
        pos=(0, 0, 0),
        mass=0.8716378,
        com=(0.00178191, 0.00092083, 6.831e-05),
        inertia=(0.00047456, 0.00056446, 0.00067619, -2.11e-05, -2.22e-06, -1.1e-07),
        joint=Joint("left_arm_5", (0, 1, 0), (-0.872664626, 0.872664626), 10, 6.283185308),
    ),
    Link(
        "link_left_arm_6",
        "link_left_arm_5",
        pos=(0, 0, 0),
        mass=0.74448182,
        com=(0.00706872, -0.00102308, -0.08649522),
        inertia=(0.00187469, 0.00160335, 0.00115053, -3.209e-05, -0.00035074, 5e-08),
        joint=Joint("left_arm_6", (1, 0, 0), (-1.5707963268, 1.5707963268), 8, 2.094395102),
    ),
    Link(
        "ee_left",
        "link_left_arm_6",
        pos=(0, 0, -0.125),
        mass=0.47470074,
        com=(0.00041345, 0.00160451, -0.02702162),
        inertia=(0.00053136, 0.00031059, 0.00060261, 1.907e-05, 5e-07, 8.8e-06),
    ),
    Link(
        "ee_finger_l1",
        "ee_left",
        pos=(0, 0, 0),
        quat=(0.7071067811865476, 0, 0, 0.7071067811865476),
        mass=0.03326999,
        com=(0.00278346, -3.29e-06, -0.02570112),
        inertia=(1.231e-05, 1.066e-05, 2.24e-06, 0, -4.2e-07, 0),
        joint=Joint("gripper_finger_l1", (1, 0, 0), (0, 0.05), PLACEHOLDER, 0.05, slides=True),
    ),
    Link(
        "ee_finger_l2",
        "ee_left",
        pos=(0, 0, 0),
        quat=(0.7071067811865476, 0, 0, -0.7071067811865476),
        mass=0.03326999,
        com=(0.00278346, -3.29e-06, -0.02570112),
        inertia=(1.231e-05, 1.066e-05, 2.24e-06, 0, -4.2e-07, 0),
        joint=Joint("gripper_finger_l2", (-1, 0, 0), (-0.05, 0), PLACEHOLDER, 0.05, slides=True),
    ),
)

_CHANGED = {link.name: link for link in CHANGED}
_OMITTED = ("base", "wheel_r", "wheel_l")


def _change(link: Link) -> Link:
    """Return the link of RB-Y1 M that replaces `link` of RB-Y1 A."""
    if link.name == "link_torso_0":
        return replace(link, pos=(0, 0, 0.2965))
    return _CHANGED.get(link.name, link)


LINKS = (*BASE, *(_change(link) for link in RBY1_LINKS if link.name not in _OMITTED))
