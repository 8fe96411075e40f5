"""Forward reach of a robot with stretched arms."""

from __future__ import annotations

import mujoco
import numpy as np

from xop_lerobot.morphology.morphology import ArmChain, Morphology

_SAMPLES, _ROUNDS, _GRID = 300, 4, 21  # random samples, then coordinate search on a grid


def compute_forward_reach(morphology: Morphology, model: mujoco.MjModel) -> float:
    """Horizontal distance from the head to the wrists with the arms stretched forward [m].

    For the standing robot: forward distance of the shoulder from the head, plus the length of the
    arm, which is the largest distance of the wrist from the first joint within the joint limits;
    mean over the arms.

    Args:
        morphology: The robot.
        model: Any of its models.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = morphology.standing_qpos()
    mujoco.mj_kinematics(model, data)
    head = data.site(morphology.frames["head"]).xpos.copy()
    reaches = []
    for arm in morphology.arms:
        shoulder = data.joint(arm.joints[0]).xanchor.copy()
        length = _compute_length(model, data, arm, morphology.frames[arm.frame])
        reaches.append(float(shoulder[0] - head[0]) + length)
    return float(np.mean(reaches))


def _compute_length(model: mujoco.MjModel, data: mujoco.MjData, arm: ArmChain, site: str) -> float:
    """Largest distance from the arm's first joint to `site`: random, then coordinate search."""
    rng = np.random.default_rng(0)
    joints = [model.joint(name) for name in arm.joints]
    addresses = [int(joint.qposadr[0]) for joint in joints]
    full = np.array([-np.pi, np.pi])
    ranges = [joint.range if model.jnt_limited[joint.id] else full for joint in joints]
    low, high = np.array(ranges).T
    first = data.joint(arm.joints[0])

    def measure(angles: np.ndarray) -> float:
        data.qpos[addresses] = angles
        mujoco.mj_kinematics(model, data)
        return float(np.linalg.norm(data.site(site).xpos - first.xanchor))

    rest = data.qpos[addresses].copy()
    best = max((rng.uniform(low, high) for _ in range(_SAMPLES)), key=measure)
    length = measure(best)
    for _ in range(_ROUNDS):
        for i in range(len(joints)):
            for angle in np.linspace(low[i], high[i], _GRID):
                other = best.copy()
                other[i] = angle
                if (reached := measure(other)) > length:
                    best, length = other, reached
    measure(rest)
    return length
