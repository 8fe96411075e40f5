"""Shapes of G1 for display and collision, its cameras and named frames."""

from __future__ import annotations

from xop_lerobot.morphology.links import Frame, Shape, look, mirror

MATERIALS = {
    "shell": (0.86, 0.87, 0.88, 0.3),
    "grey": (0.46, 0.47, 0.49, 0.2),
    "dark": (0.13, 0.13, 0.14, 0.2),
    "visor": (0.03, 0.03, 0.05, 0.9),
    "light": (0.45, 0.75, 0.95, 0.1),
}
"""Red, green, blue, gloss."""


ACROSS = (1.5708, 0, 0)
"""Orientation of a cylinder along Y: roll, pitch, yaw [rad]."""

BODY = (
    Shape("pelvis", "ellipsoid", (0.072, 0.08, 0.062), (0, 0, -0.07), material="shell"),
    look("pelvis", "cylinder", (0.045, 0.075), "dark", pos=(0, 0, -0.1), rpy=ACROSS),
    look("waist_yaw_link", "cylinder", (0.048, 0.045), "dark", pos=(0, 0, 0.025)),
    Shape("torso_link", "box", (0.045, 0.052, 0.065), (0.0, 0, 0.075), material="dark"),
    Shape("torso_link", "box", (0.055, 0.085, 0.075), (0.002, 0, 0.205), material=None),
    look("torso_link", "ellipsoid", (0.075, 0.105, 0.1), "shell", pos=(0.004, 0, 0.205)),
    look("torso_link", "capsule", (0.054,), "shell", ends=(0, -0.062, 0.243, 0, 0.062, 0.243)),
    look("torso_link", "ellipsoid", (0.066, 0.08, 0.065), "shell", pos=(0.004, 0, 0.14)),
    look("torso_link", "cylinder", (0.036, 0.035), "dark", pos=(0.0, 0, 0.325)),
    Shape("torso_link", "capsule", (0.06,), ends=(0.002, 0, 0.385, 0.002, 0, 0.42),
          material="shell"),
    look("torso_link", "ellipsoid", (0.042, 0.0535, 0.068), "visor", pos=(0.03, 0, 0.402)),
    look("torso_link", "ellipsoid", (0.008, 0.03, 0.0035), "light", pos=(0.061, 0, 0.445)),
)  # fmt: skip

LEFT = (
    Shape("left_hip_pitch_link", "cylinder", (0.048, 0.032), (0, 0.045, -0.025), ACROSS,
          material="dark"),
    Shape("left_hip_roll_link", "capsule", (0.048,), ends=(0.022, 0, -0.02, 0.022, 0, -0.09),
          material="shell"),
    Shape("left_hip_yaw_link", "capsule", (0.054,), ends=(-0.012, 0, -0.02, -0.06, 0, -0.13),
          material="shell"),
    look("left_knee_link", "cylinder", (0.05, 0.046), "dark", pos=(0, 0.002, 0), rpy=ACROSS),
    Shape("left_knee_link", "capsule", (0.046,), ends=(0.008, 0, -0.045, 0.008, 0, -0.13),
          material="shell"),
    Shape("left_knee_link", "capsule", (0.032,), ends=(0.004, 0, -0.16, 0, 0, -0.27),
          material="dark"),
    look("left_ankle_roll_link", "ellipsoid", (0.075, 0.034, 0.03), "grey", pos=(0.03, 0, -0.012)),
    look("left_shoulder_pitch_link", "ellipsoid", (0.045, 0.036, 0.047), "shell",
         pos=(0, 0.04, -0.005)),
    Shape("left_shoulder_pitch_link", "cylinder", (0.035, 0.025), (0, 0.035, -0.01), ACROSS,
          material="dark"),
    Shape("left_shoulder_roll_link", "capsule", (0.036,), ends=(0, 0.006, -0.025, 0, 0.006, -0.07),
          material="dark"),
    Shape("left_shoulder_yaw_link", "capsule", (0.037,), ends=(0.003, 0, 0.01, 0.011, 0, -0.06),
          material="shell"),
    look("left_elbow_link", "cylinder", (0.036, 0.034), "dark", rpy=ACROSS),
    Shape("left_elbow_link", "capsule", (0.032,), ends=(0.03, 0, -0.01, 0.09, 0.002, -0.01),
          material="shell"),
    Shape("left_wrist_pitch_link", "capsule", (0.027,), ends=(-0.015, 0, 0, 0.035, 0, 0),
          material="dark"),
    Shape("left_wrist_yaw_link", "box", (0.046, 0.016, 0.034), (0.085, 0.003, 0), material="grey",
          name="left_hand"),
    Shape("left_wrist_yaw_link", "box", (0.036, 0.012, 0.031), (0.161, -0.006, -0.002),
          (0, 0, -0.25), material="grey", name="left_fingers"),
    look("left_wrist_yaw_link", "capsule", (0.011,), "grey",
         ends=(0.07, -0.008, 0.032, 0.12, -0.03, 0.045)),
)  # fmt: skip

FEET = tuple(
    Shape(
        f"{side}_ankle_roll_link",
        "box",
        (0.095, 0.032, 0.012),
        (0.034, 0, -0.02),
        material="dark",
        name=f"{side}_sole",
    )
    for side in ("left", "right")
)
"""Soles for display; they end above the contact spheres, which alone touch the ground."""

SHAPES = (*BODY, *LEFT, *(mirror(shape) for shape in LEFT), *FEET)

FOOT_POINTS = ((-0.05, 0.025, -0.03), (-0.05, -0.025, -0.03), (0.12, 0.03, -0.03), (0.12, -0.03,
-0.03))  # fmt: skip
"""Centres of the contact spheres in the ankle roll link [m]."""

FOOT_RADIUS = 0.005
"""Radius of the contact spheres [m]."""

EXCLUDED = (
    ("pelvis", "torso_link"),
    ("pelvis", "waist_roll_link"),
    ("waist_yaw_link", "torso_link"),
    *((body, f"{side}_{link}_link") for side in ("left", "right") for body, link in (
        ("pelvis", "hip_roll"), ("pelvis", "hip_yaw"),
        ("torso_link", "shoulder_roll"), ("torso_link", "shoulder_yaw"),
    )),
    *((f"{side}_{a}_link", f"{side}_{b}_link") for side in ("left", "right") for a, b in (
        ("hip_pitch", "hip_yaw"), ("hip_roll", "knee"), ("knee", "ankle_roll"),
        ("shoulder_pitch", "shoulder_yaw"), ("shoulder_roll", "elbow"),
        ("elbow", "wrist_pitch"), ("elbow", "wrist_yaw"), ("wrist_roll", "wrist_yaw"),
    )),
)  # fmt: skip
"""Pairs of links excluded from collision, since their shapes overlap by construction."""

SITES = (
    Frame("head", "torso_link", (0.05, 0, 0.42)),
    Frame("imu", "torso_link", (-0.03959, -0.00224, 0.13792)),
    Frame("left_wrist", "left_wrist_yaw_link", (0, 0, 0), (1, 0, 0), (0, 1, 0)),
    Frame("right_wrist", "right_wrist_yaw_link", (0, 0, 0), (1, 0, 0), (0, -1, 0)),
    Frame("left_palm", "left_wrist_yaw_link", (0.1, -0.013, 0), (1, 0, 0), (0, 1, 0)),
    Frame("right_palm", "right_wrist_yaw_link", (0.1, 0.013, 0), (1, 0, 0), (0, -1, 0)),
    *(
        Frame(f"{side}_foot_{i}", f"{side}_ankle_roll_link", point)
        for side in ("left", "right")
        for i, point in enumerate(FOOT_POINTS)
    ),
)

HEAD_CAMERA = Frame(
    "head", "torso_link", (0.0576235, 0.01753, 0.41987), (0.6743, 0, -0.7384), (0.7384, 0, 0.6743)
)
"""Depth camera in the visor, pitched down by 0.8308 rad."""

HEAD_FOVY = 58.0
"""Vertical field of view of the head camera [deg]."""

WRIST_CAMERAS = tuple(
    Frame(f"{side}_wrist", f"{side}_wrist_yaw_link", (-0.01, 0, 0.085), (0.88, 0, -0.47))
    for side in ("left", "right")
)
"""On the thumb's side of the hand, looking along the hand."""

WRIST_FOVY = 75.0
"""Vertical field of view of the wrist cameras [deg]."""

SCENE_CAMERA = Frame("scene", "pelvis", (1.5, 1.2, 0.35), (-1.5, -1.2, -0.5))
"""From the front left, following the pelvis and showing the whole robot."""
SCENE_FOVY = 45.0
"""Vertical field of view of the scene camera [deg]."""
