"""Whole-body inverse kinematics: can a robot that stands somewhere sensible reach both points?"""

from __future__ import annotations

import mink
import mujoco
import numpy as np

from xop_lerobot.core.transforms import quat_from_yaw
from xop_lerobot.morphology.morphology import Morphology

HEIGHTS = {"g1": (0.78, 0.65, 0.53, 0.42)}
"""Base heights that a robot's policy reaches [m]; others stay at their own."""


def find_posture(
    morphology: Morphology, points: dict[str, np.ndarray], stance: np.ndarray, heading: float
) -> tuple[float, np.ndarray, mujoco.MjModel]:
    """Reach for points with the palms, from a base that stands near `stance`.

    Args:
        morphology: The robot.
        points: Position of each palm's point [m]. Shapes (3,).
        stance: Position of the base on the ground [m]. Shape (3,).
        heading: Of the base [rad].

    Returns:
        Largest distance of a palm to its point [m], the configuration, and the model.
    """
    model = morphology.build_spec("full").compile()
    q = morphology.standing_qpos()
    q[:2], q[3:7] = stance[:2], quat_from_yaw(heading)
    best = (np.inf, q, model)
    for height in HEIGHTS.get(morphology.name, (q[2],)):
        q[2] = height
        error, reached = _solve(model, q, points)
        if error < best[0]:
            best = (error, reached, model)
    return best


def _solve(
    model: mujoco.MjModel, q: np.ndarray, points: dict[str, np.ndarray]
) -> tuple[float, np.ndarray]:
    """Move arms, torso and the base on the ground; legs and the base's height stay."""
    configuration = mink.Configuration(model, q)
    tasks = [mink.FrameTask(site, "site", 1.0, 0.0) for site in points]
    for task, point in zip(tasks, points.values(), strict=True):
        task.set_target(mink.SE3.from_translation(point))
    cost = np.full(model.nv, 0.01)
    cost[:2], cost[5] = 0.2, 0.2
    posture = mink.PostureTask(model, cost)
    posture.set_target(q)
    joints = [model.joint(i).name for i in range(1, model.njnt)]
    still = [
        int(model.joint(name).dofadr[0])
        for name in joints
        if any(part in name for part in ("hip", "knee", "ankle", "wheel", "gripper", "head"))
    ]
    limits = [mink.ConfigurationLimit(model), mink.VelocityLimit(model, dict.fromkeys(joints, 2.0))]
    frozen = mink.DofFreezingTask(model, [2, 3, 4, *still])
    for _ in range(100):
        velocity = mink.solve_ik(
            configuration,
            [*tasks, posture],
            0.05,
            "daqp",
            damping=1e-4,
            limits=limits,
            constraints=[frozen],
        )
        configuration.integrate_inplace(velocity, 0.05)
    data = configuration.data
    errors = [np.linalg.norm(data.site(site).xpos - point) for site, point in points.items()]
    return float(max(errors)), configuration.q.copy()
