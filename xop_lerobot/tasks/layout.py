"""Measures of a robot's hands and arms, and placement of objects around it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from xop_lerobot.core.transforms import make_pose, pose_multiply, quat_from_matrix
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.retarget.arms.ik import ArmIk
from xop_lerobot.retarget.model.kinematics import SiteKinematics

DRAW_IN = 0.12
"""Largest distance by which hands are drawn in [m]."""
_STEPS, _DT, _NEAR = 50, 0.04, 0.005
"""Inverse kinematics: iterations, time step [s], and error that counts as reached [m]."""


@dataclass(frozen=True)
class Reach:
    """Resting palms of a standing robot, and the reach of its arms.

    Attributes:
        forward: Distance of the palms ahead of the base frame [m].
        height: Height of the palms above the floor [m].
        shoulder: Height of the shoulders above the floor [m].
        arm: Length of the stretched arm from shoulder to palm [m].
    """

    forward: float
    height: float
    shoulder: float
    arm: float


def find_palms(morphology: Morphology, model: mujoco.MjModel) -> dict[str, str]:
    """Sites of `left_palm` and `right_palm`; the wrist's site if a hand has no palm."""
    sites = {model.site(i).name for i in range(model.nsite)}
    palms = {}
    for arm in morphology.arms:
        palm = arm.frame.replace("_wrist", "_palm")
        palms[palm] = palm if palm in sites else morphology.frames[arm.frame]
    return palms


def measure_reach(morphology: Morphology) -> Reach:
    """Measure a robot in its standing posture."""
    model = morphology.build_spec("full").compile()
    data = mujoco.MjData(model)
    data.qpos[:] = morphology.standing_qpos()
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    palms, shoulders, lengths = [], [], []
    for site, arm in zip(find_palms(morphology, model).values(), morphology.arms, strict=True):
        palm = data.site_xpos[model.site(site).id]
        anchors = [data.xanchor[model.joint(joint).id] for joint in arm.joints]
        path = np.diff([*anchors, palm], axis=0)
        palms.append(palm)
        shoulders.append(anchors[0])
        lengths.append(float(np.linalg.norm(path, axis=1).sum()))
    base = data.xpos[model.body(morphology.base_body).id]
    middle = np.mean(palms, axis=0)
    return Reach(
        forward=float(middle[0] - base[0]),
        height=float(middle[2]),
        shoulder=float(np.mean(shoulders, axis=0)[2]),
        arm=min(lengths),
    )


def make_direction(angle: float) -> np.ndarray:
    """Horizontal unit vector at `angle` [rad] to the left of X. Shape (3,)."""
    return np.array([math.cos(angle), math.sin(angle), 0.0])


def find_room(model: mujoco.MjModel) -> np.ndarray | None:
    """Inner corners of the walls `wall_*`, lower and upper (x, y) [m]; None without walls.

    Shape (2, 2).
    """
    walls = {}
    for side in ("front", "back", "left", "right"):
        geom = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, f"wall_{side}")
        if geom < 0:
            return None
        walls[side] = (model.geom_pos[geom], model.geom_size[geom])
    (front, front_half), (back, back_half) = walls["front"], walls["back"]
    (left, left_half), (right, right_half) = walls["left"], walls["right"]
    return np.array(
        [
            [back[0] + back_half[0], right[1] + right_half[1]],
            [front[0] - front_half[0], left[1] - left_half[1]],
        ]
    )


def measure_draw_in(morphology: Morphology) -> float:
    """Measure how far the wrists can be drawn in towards the body from rest [m].

    Some arms already rest with their elbows fully bent. At most `DRAW_IN`, in three steps.
    """
    ik = ArmIk(morphology)
    sites = {arm.frame: morphology.frames[arm.frame] for arm in morphology.arms}
    kinematics = SiteKinematics(ik.model, tuple(sites.values()))
    qpos = morphology.standing_qpos()
    joints = [joint for arm in morphology.arms for joint in arm.joints]
    angles = np.array([morphology.arm_rest.get(joint, 0.0) for joint in joints])

    def find_wrists() -> dict[str, np.ndarray]:
        posture = qpos.copy()
        posture[ik.qpos_address] = angles
        poses = kinematics.compute_poses(posture)
        return {name: poses[site] for name, site in sites.items()}

    rest, drawn_in = find_wrists(), 0.0
    for way in DRAW_IN * np.array([1, 2, 3]) / 3:
        back = make_pose(np.array([-way, 0, 0]), np.array([1.0, 0, 0, 0]))
        goals = {name: pose_multiply(back, pose) for name, pose in rest.items()}
        for _ in range(_STEPS):
            angles = ik.solve(qpos, angles, goals, _DT)
        reached = find_wrists()
        if max(math.dist(reached[n][:3], goals[n][:3]) for n in goals) > _NEAR:
            break
        drawn_in = float(way)
    return drawn_in


@dataclass(frozen=True)
class Pad:
    """Pressing side of a hand, in the frame of its palm site.

    Attributes:
        forward: Middle of the flat surface ahead of the site [m].
        depth: Distance of the surface beyond the site, out of the palm [m].
        wrist_end: End of the arm and start of the hand, ahead of the site [m]; negative.
    """

    forward: float
    depth: float
    wrist_end: float


def measure_pad(morphology: Morphology) -> Pad:
    """Measure the left hand: the box geom that protrudes farthest out of the palm.

    Of boxes that protrude equally (within two centimetres), the largest counts. A hand without
    boxes has its pad at the palm site.
    """
    model = morphology.build_spec("full").compile()
    data = mujoco.MjData(model)
    data.qpos[:] = morphology.standing_qpos()
    mujoco.mj_kinematics(model, data)
    site = model.site(find_palms(morphology, model)["left_palm"]).id
    axes, origin = data.site_xmat[site].reshape(3, 3), data.site_xpos[site]
    hand = int(model.site_bodyid[site])
    arm = {int(model.joint(joint).bodyid[0]) for joint in morphology.arms[0].joints} - {hand}
    pads, wrist_end = [], -math.inf
    for geom in np.flatnonzero(model.geom_contype):
        turn = axes.T @ data.geom_xmat[geom].reshape(3, 3)
        middle, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        centre = axes.T @ (data.geom_xpos[geom] - origin) + turn @ middle
        extent = np.abs(turn) @ half
        body = int(model.geom_bodyid[geom])
        if body in arm:
            wrist_end = max(wrist_end, float(centre[0] + extent[0]))
        elif body == hand and model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
            pads.append((float(extent[2] - centre[2]), float(half.prod()), float(centre[0])))
    if not pads:
        return Pad(0.0, 0.0, wrist_end)
    farthest = max(pad[0] for pad in pads)
    alike = [pad for pad in pads if pad[0] > farthest - 0.02]  # tolerance of the docstring
    depth, _, forward = max(alike, key=lambda pad: pad[1])
    return Pad(forward, depth, wrist_end)


NAME = "task"
OPEN = ((2.6, -2.2, 1.9), (0.2, 0.1, 0.6), 45.0)
"""Camera position and target [m], and vertical field of view [deg]."""
IN_ROOM = ((2.1, -2.1, 2.4), (0.0, 0.0, 0.5), 66.0)
"""The same in a room of at least 4.4 m: in its corner, below the ceiling."""


def add_task_camera(spec: mujoco.MjSpec) -> None:
    """Add the static camera `task`."""
    has_walls = any(geom.name.startswith("wall_") for geom in spec.geoms)
    position, target, fovy = IN_ROOM if has_walls else OPEN
    # MuJoCo's cameras look along -Z, with Y up.
    back = np.subtract(position, target)
    back = back / np.linalg.norm(back)
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(back, right), back], axis=1)
    spec.worldbody.add_camera(name=NAME, pos=position, quat=quat_from_matrix(axes), fovy=fovy)
