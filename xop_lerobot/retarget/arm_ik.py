"""Arm inverse kinematics: the wrists follow the operator's, whatever the body does."""

from __future__ import annotations

from collections.abc import Mapping

import mink
import mujoco
import numpy as np

from xop_lerobot.morphology.morphology import Morphology

_MAX_DT = 0.05  # after a stall the arms move as after one late tick, not all at once


class ArmIk:
    """Differential inverse kinematics of the arms with mink, the rest of the body as measured.

    Each solve starts from the targets sent last, not from the measured arms, so that sensor
    noise and sagging never reach the targets. Joint limits, a joint speed limit and a distance
    between the forearms and the rest of the body hold by construction; the posture term pulls
    weakly towards the rest angles and keeps the elbows from drifting through the null space.

    Args:
        morphology: The robot.
        max_speed: Speed limit of the arm joints [rad/s].
        iterations: Steps per solve.
    """

    def __init__(
        self,
        morphology: Morphology,
        max_speed: float = 3.0,
        iterations: int = 2,
    ) -> None:
        self.iterations = iterations
        model = morphology.build_spec("full").compile()
        joints = [joint for arm in morphology.arms for joint in arm.joints]
        self.num_joints = len(joints)
        self._qpos = np.array([int(model.joint(joint).qposadr[0]) for joint in joints])
        dofs = [int(model.joint(joint).dofadr[0]) for joint in joints]
        self._configuration = mink.Configuration(model)
        self._tasks = {
            arm.frame: mink.FrameTask(
                morphology.frames[arm.frame],
                "site",
                position_cost=1.0,
                orientation_cost=0.2,
                gain=0.6,
                lm_damping=1e-3,
            )
            for arm in morphology.arms
        }
        rest = np.array([morphology.arm_rest.get(joint, 0.0) for joint in joints])
        posture_cost = np.zeros(model.nv)
        posture_cost[dofs] = 0.02
        self._posture = mink.PostureTask(model, posture_cost)
        self._rest = rest
        frozen = sorted(set(range(model.nv)) - set(dofs))
        self._constraints = [mink.DofFreezingTask(model, frozen)]
        self._limits = [
            mink.ConfigurationLimit(model, gain=0.5),
            mink.VelocityLimit(model, dict.fromkeys(joints, max_speed)),
            mink.CollisionAvoidanceLimit(
                model,
                _find_pairs(model, morphology),
                minimum_distance_from_collisions=0.025,
                collision_detection_distance=0.1,
            ),
        ]
        limited = np.flatnonzero(model.jnt_limited)
        self._limited = model.jnt_qposadr[limited]
        self._range = model.jnt_range[limited]
        self.failures = 0
        """Number of solves that the quadratic program failed; the arms then stay."""

    def solve(
        self,
        qpos: np.ndarray,
        arms: np.ndarray,
        goals: Mapping[str, np.ndarray],
        dt: float,
    ) -> np.ndarray:
        """Move the arm targets towards the wrist goals.

        Args:
            qpos: Configuration of the robot; its arm angles are not used. Shape (nq,).
            arms: Arm joint targets sent last [rad]. Shape (num_joints,).
            goals: Wanted pose in the world of each wrist; arms without a goal stay. Shapes (7,).
            dt: Time since the last solve [s].

        Returns:
            New targets within the limits. Shape (num_joints,).
        """
        tasks: list[mink.Task] = []
        for name, task in self._tasks.items():
            if name in goals:
                pose = goals[name]
                task.set_target(mink.SE3(np.concatenate([pose[3:], pose[:3]])))
                tasks.append(task)
        if not tasks:
            return arms.copy()
        q = qpos.copy()
        q[self._qpos] = arms
        # A frozen joint measured beyond its limit would leave the program no solution.
        q[self._limited] = np.clip(q[self._limited], *self._range.T)
        rest = q.copy()
        rest[self._qpos] = self._rest
        self._posture.set_target(rest)
        self._configuration.update(q)
        step = min(dt, _MAX_DT) / self.iterations
        for _ in range(self.iterations):
            try:
                velocity = mink.solve_ik(
                    self._configuration,
                    [*tasks, self._posture],
                    step,
                    solver="daqp",
                    damping=1e-4,
                    limits=self._limits,
                    constraints=self._constraints,
                )
            except mink.NoSolutionFound:
                self.failures += 1
                break
            self._configuration.integrate_inplace(velocity, step)
        return self._configuration.q[self._qpos]


def _find_pairs(model: mujoco.MjModel, morphology: Morphology) -> list[tuple[list[int], list[int]]]:
    """Colliding geoms of each forearm and hand, against those of the rest of the body."""
    solid = [i for i in range(model.ngeom) if model.geom_contype[i] and model.geom_conaffinity[i]]
    pairs, forearms = [], []
    for arm in morphology.arms:
        whole = _find_subtree(model, arm.joints[0])
        forearm = _find_subtree(model, arm.joints[len(arm.joints) // 2])
        own = [i for i in solid if model.geom_bodyid[i] in forearm]
        rest = [
            i
            for i in solid
            if model.geom_bodyid[i] not in whole and model.geom_bodyid[i] not in forearms
        ]
        pairs.append((own, rest))
        forearms.extend(forearm)
    return pairs


def _find_subtree(model: mujoco.MjModel, joint: str) -> set[int]:
    """Bodies that `joint` moves."""
    root = int(model.joint(joint).bodyid[0])
    bodies = {root}
    for body in range(root + 1, model.nbody):
        if int(model.body_parentid[body]) in bodies:
            bodies.add(body)
    return bodies
