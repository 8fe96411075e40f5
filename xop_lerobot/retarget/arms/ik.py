"""Differential inverse kinematics of the arms, by mink."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import mink
import mujoco
import numpy as np

from xop_lerobot.morphology.morphology import Morphology

ARM_MAX_RATE = 3.0
"""Largest speed of arm targets, from inverse kinematics or plan [rad/s]."""
ARM_MAX_DT = 0.05
"""Upper bound of the time step, so that the arms do not lurch after a stall [s]."""


CLEARANCE = 0.025
"""Distance that arms keep from the rest of the body and from each other [m]."""
_DETECTED = 0.1  # distance from which two geoms are looked at [m]
_APPROACH_S = 0.1  # time constant with which geoms approach: soft arms lag and overshoot [s]
_RETREAT = 0.5  # speed with which geoms that are too close part [m/s]; a torso turns an elbow at it
_DEEP = -1.0  # distance below any penetration [m]


class Clearance(mink.CollisionAvoidanceLimit):
    r"""Keeps pairs of geoms apart: :math:`\dot d \ge -(d - d_{min}) / T`.

    A velocity damper (Faverjon and Tournassoud, 1987). That of mink bounds the displacement of a
    step by a velocity, which at steps of 20 ms is fifty times too much, and lets geoms that are
    too close stay so: a turning torso then takes the arms into the belly. Here they part, by at
    most `_RETREAT`.

    Args:
        model: The model.
        pairs: Pairs of groups of geoms.
    """

    def __init__(self, model: mujoco.MjModel, pairs: list[tuple[list[int], list[int]]]) -> None:
        # With a distance below any that occurs, the bound of mink tells the distance itself.
        super().__init__(
            model,
            pairs,
            gain=1.0,
            minimum_distance_from_collisions=_DEEP,
            collision_detection_distance=_DETECTED,
        )

    def compute_qp_inequalities(
        self, configuration: mink.Configuration, dt: float
    ) -> mink.Constraint:
        r"""Compute the inequality :math:`G\,\Delta q \le h`."""
        matrix, bound = super().compute_qp_inequalities(configuration, dt)
        assert bound is not None
        distance = bound * dt + _DEEP  # infinite for pairs that are far apart
        approach = np.maximum((distance - CLEARANCE) / _APPROACH_S, -_RETREAT)
        return mink.Constraint(matrix, approach * dt)


class ArmIk:
    """Moves the arms towards wrist goals, with the rest of the body fixed as measured.

    Each solve starts from its own last solution, not from the measured arms, so that sensor noise
    and sag do not enter. Joint limits and a speed limit hold by construction. Elbows, forearms and
    hands keep a distance from the rest of the body and from each other (`Clearance`), up to the
    servo lag. A weak posture task pulls towards the rest angles and keeps the elbows from drifting
    in the null space.

    Args:
        morphology: The robot.
        max_speed: Speed limit of the arm joints [rad/s].
        iterations: Steps per solve.
        arm_limits: Joint limits in addition to those of the morphology [rad].
    """

    def __init__(
        self,
        morphology: Morphology,
        max_speed: float = ARM_MAX_RATE,
        iterations: int = 2,
        arm_limits: Mapping[str, tuple[float, float]] = MappingProxyType({}),
    ) -> None:
        self.iterations = iterations
        self.model = model = morphology.build_spec("full").compile()
        joints = [joint for arm in morphology.arms for joint in arm.joints]
        self.num_joints = len(joints)
        self.qpos_address = np.array([int(model.joint(joint).qposadr[0]) for joint in joints])
        """Addresses of the arm joints in the robot's qpos. Shape (num_joints,), int."""
        self.joint_range = np.array([model.joint(joint).range for joint in joints])
        """Limits of the arm joints [rad]. Shape (num_joints, 2)."""
        for joint, (low, high) in (*morphology.arm_limits.items(), *arm_limits.items()):
            least, most = model.joint(joint).range
            model.joint(joint).range = max(low, least), min(high, most)
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
        self._dofs = np.array(dofs)
        frames = [arm.frame for arm in morphology.arms for _ in arm.joints]
        self._owner = np.array(frames)  # tracked frame of each joint's arm
        self._freezing: dict[frozenset[str], mink.DofFreezingTask] = {}
        self._limits = [
            mink.ConfigurationLimit(model, gain=0.5),
            mink.VelocityLimit(model, dict.fromkeys(joints, max_speed)),
            Clearance(model, _find_pairs(model, morphology)),
        ]
        limited = np.flatnonzero(model.jnt_limited)
        self._limited = model.jnt_qposadr[limited]
        self._range = model.jnt_range[limited]
        self.failures = 0
        """Number of failed quadratic programs; the arms then keep their targets."""

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
            arms: The last solution [rad]. Shape (num_joints,).
            goals: Desired pose of each wrist in the world; arms without a goal stay. Shapes (7,).
            dt: Time since the last solve [s]; nothing moves if it is not positive.

        Returns:
            New angles within the limits. Shape (num_joints,).
        """
        tasks: list[mink.Task] = []
        for name, task in self._tasks.items():
            if name in goals:
                pose = goals[name]
                task.set_target(mink.SE3(np.concatenate([pose[3:], pose[:3]])))
                tasks.append(task)
        if not tasks or dt <= 0:
            return arms.copy()
        moving = np.isin(self._owner, list(goals))
        q = qpos.copy()
        q[self.qpos_address] = arms
        # A frozen joint measured beyond its limit would make the program infeasible.
        q[self._limited] = np.clip(q[self._limited], *self._range.T)
        rest = q.copy()
        rest[self.qpos_address] = self._rest
        self._posture.set_target(rest)
        self._configuration.update(q)
        step = min(dt, ARM_MAX_DT) / self.iterations
        for _ in range(self.iterations):
            try:
                velocity = mink.solve_ik(
                    self._configuration,
                    [*tasks, self._posture],
                    step,
                    solver="daqp",
                    damping=1e-4,
                    limits=self._limits,
                    constraints=[self._freeze(moving)],
                )
            except mink.NoSolutionFound:
                self.failures += 1
                break
            self._configuration.integrate_inplace(velocity, step)
        return np.where(moving, self._configuration.q[self.qpos_address], arms)

    def _freeze(self, moving: np.ndarray) -> mink.DofFreezingTask:
        """Constraint that freezes all joints but the `moving` arm joints, (num_joints,), bool."""
        owners = frozenset(self._owner[moving])
        if owners not in self._freezing:
            model = self._configuration.model
            frozen = sorted(set(range(model.nv)) - set(self._dofs[moving].tolist()))
            self._freezing[owners] = mink.DofFreezingTask(model, frozen)
        return self._freezing[owners]


def _find_pairs(model: mujoco.MjModel, morphology: Morphology) -> list[tuple[list[int], list[int]]]:
    """Pairs of colliding geoms: each arm from the elbow on, against the rest of the body."""
    solid = [i for i in range(model.ngeom) if model.geom_contype[i] and model.geom_conaffinity[i]]
    pairs, forearms = [], []
    for arm in morphology.arms:
        whole = _find_subtree(model, arm.joints[0])
        # From the upper arm's rotation on, which moves the elbow: that touches the body first.
        forearm = _find_subtree(model, arm.joints[len(arm.joints) // 2 - 1])
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
