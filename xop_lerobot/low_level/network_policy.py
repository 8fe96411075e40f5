"""Batched executor of policy tables: one network per mode, with blended hand-over between them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadShape, BadValue
from xop_lerobot.core.transforms import compute_projected_gravity, quat_conjugate, quat_rotate
from xop_lerobot.low_level import description as d
from xop_lerobot.low_level.joints import RobotJoints, as_index
from xop_lerobot.low_level.network_stage import NetworkStage, Situation
from xop_lerobot.low_level.policy import POLICY_DT, LowLevelPolicy, PolicyOutput
from xop_lerobot.low_level.rest import RestMap
from xop_lerobot.low_level.terms import FeatureColumns

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True)
class MotorSet:
    """Motor gains and limits by joint.

    Attributes:
        stiffness: k_p [N m/rad]. Shape (nu,).
        damping: k_d [N m s/rad]. Shape (nu,).
        torque: Torque limit [N m]; infinite to keep the model's. Shape (nu,).
    """

    stiffness: np.ndarray
    damping: np.ndarray
    torque: np.ndarray

    @classmethod
    def read(cls, table: d.Motors, joints: RobotJoints) -> MotorSet:
        """Read the motors of a table; joints that it does not name keep the model's."""
        return cls(
            joints.spread(table.stiffness, joints.stiffness),
            joints.spread(table.damping, joints.damping),
            joints.spread(table.torque, np.inf),
        )

    def matches(self, other: MotorSet) -> bool:
        """Whether both have the same gains."""
        same = np.array_equal(self.stiffness, other.stiffness)
        return same and np.array_equal(self.damping, other.damping)


def convert_targets(
    targets: np.ndarray, q: np.ndarray, v: np.ndarray, of: MotorSet, to: MotorSet
) -> np.ndarray:
    r"""Convert position targets so that servos with other gains give the same torque now.

    .. math:: q^*_2 = q + \frac{k_{p1} (q^*_1 - q) - (k_{d1} - k_{d2})\, \dot q}{k_{p2}}

    Args:
        targets: Targets for the servos `of` [rad]. Shape (n, nu).
        q: Angles [rad]. Shape (n, nu).
        v: Velocities [rad/s]. Shape (n, nu).
        of: Servos 1.
        to: Servos 2.

    Returns:
        Targets for the servos `to` [rad]. Shape (n, nu).
    """
    pull = of.stiffness * (targets - q) - (of.damping - to.damping) * v
    return q + pull / to.stiffness


@dataclass(frozen=True)
class Stage:
    """A network of a policy, with the table that it comes from.

    Attributes:
        network: The network.
        table: Its table.
        motors: The motors that it was trained with.
    """

    network: NetworkStage
    table: d.PolicyTable
    motors: MotorSet


class NetworkPolicy(LowLevelPolicy):
    r"""Policy of a table: one network for standing and one for walking, or one for both.

    With two networks, the inactive one shadows the active one: it records the frames that it would
    have seen, and the outputs that would have given the executed targets (its recurrent state is
    reset). So it can take over at any time. The difference of its first targets from the last ones
    decays over the hand-over time, so that targets never step.

    The memory is that of the network; with two networks: the mode (-1 before the first step), the
    remaining hand-over time [s], the difference of targets at its beginning (nu), the last targets
    (nu), and the memories of both.

    Args:
        name: Name of the policy.
        table: The table.
        joints: The robot's joints.
        stationary: Network for standing.
        mobile: Network for walking; the same object as `stationary` for a single network.
    """

    def __init__(
        self,
        name: str,
        table: d.PolicyTable,
        joints: RobotJoints,
        stationary: Stage,
        mobile: Stage,
    ) -> None:
        self.name, self.table, self._joints = name, table, joints
        self.arm_limits = _join_limits(joints, table, stationary.table, mobile.table)
        self.motors = MotorSet.read(table.motors, joints)
        self.dead_zones: Mapping[str, float] = mobile.table.dead_zones
        self.stop_rates: Mapping[str, float] = mobile.table.stop_rates
        self.rest = _make_rest(stationary, joints)
        self.ranges = {
            mode: dict(stage.table.ranges.get(_name(mode), {}))
            for mode, stage in zip(Mode, (stationary, mobile), strict=True)
        }
        self._stages = (stationary,) if mobile is stationary else (stationary, mobile)
        self._columns = FeatureColumns(joints)
        self._handover_s = table.handover_s
        # Entries without a threshold are always below it.
        self._slow = np.full(len(joints.commands), np.inf)
        for entry, size in table.stands_below.items():
            self._slow[joints.find_command(entry)] = size
        self._has_slow = bool(table.stands_below)
        self._turns = joints.commands.index("yaw_rate") if "yaw_rate" in joints.commands else None
        self._sees_velocity = any(stage.network.sees_velocity for stage in self._stages)
        self._waist, self._arms = _pair(joints.by_command), _pair(joints.by_arm)
        self._angles, self._speeds = as_index(joints.positions), as_index(joints.velocities)
        self.memory_size = sum(stage.network.memory_size for stage in self._stages)
        if len(self._stages) > 1:
            self.memory_size += 2 + 2 * len(joints.names)

    @property
    def num_inputs(self) -> int:
        """Width of the first network's observation."""
        return self._stages[0].network.num_inputs

    def adapt(self, model: mujoco.MjModel) -> None:
        """Set the motors of `model` to those that the policy was trained with."""
        # MuJoCo's position servo has the gain k_p and the bias (0, -k_p, -k_d).
        for joint, name in enumerate(self._joints.names):
            index = model.actuator(name).id
            model.actuator_gainprm[index, 0] = self.motors.stiffness[joint]
            model.actuator_biasprm[index, 1] = -self.motors.stiffness[joint]
            model.actuator_biasprm[index, 2] = -self.motors.damping[joint]
            torque = self.motors.torque[joint]
            if np.isfinite(torque):
                model.actuator_forcerange[index] = -torque, torque

    def initial_memory(self, n: int = 1) -> np.ndarray:
        """Initial memory. Shape (n, memory_size)."""
        memories = [stage.network.initial_memory(n) for stage in self._stages]
        if len(memories) == 1:
            return memories[0]
        handover = np.zeros((n, 2 + 2 * len(self._joints.names)))
        handover[:, 0] = -1
        return np.concatenate([handover, *memories], axis=1)

    def act(
        self,
        qpos: np.ndarray,
        qvel: np.ndarray,
        command: np.ndarray,
        arms: np.ndarray,
        memory: np.ndarray,
        mode: Mode | np.ndarray,
    ) -> PolicyOutput:
        """Compute motor targets for the next 20 ms; see `LowLevelPolicy.act`.

        `mode` may also hold one mode for each member of the batch. Shape (n,).

        Raises:
            BadShape: If an argument does not fit the robot.
        """
        n, joints = len(qpos), self._joints
        qpos = check_batch("qpos", qpos, n, joints.nq)
        qvel = check_batch("qvel", qvel, n, joints.nv)
        command = check_batch("command", command, n, len(joints.commands))
        arms = check_batch("arms", arms, n, joints.num_arms)
        memory = check_batch("memory", memory, n, self.memory_size)
        modes = np.broadcast_to(np.asarray(mode, dtype=int), (n,))
        situation = self._gather(qpos, qvel, command, arms, modes)
        if len(self._stages) == 1:
            targets, after = self._run(0, situation, memory)
        else:
            targets, after = self._run_both(situation, memory)
        np.maximum(targets, joints.low, out=targets)
        return PolicyOutput(np.minimum(targets, joints.high, out=targets), after)

    def observe(
        self,
        qpos: np.ndarray,
        qvel: np.ndarray,
        command: np.ndarray,
        arms: np.ndarray,
        memory: np.ndarray,
        mode: Mode | np.ndarray,
    ) -> np.ndarray:
        """Observation of a policy with a single network; arguments as in `act`.

        Returns:
            Observations, float32. Shape (n, num_inputs).
        """
        modes = np.broadcast_to(np.asarray(mode, dtype=int), (len(qpos),))
        situation = self._gather(qpos, qvel, command, arms, modes)
        return self._stages[0].network.observe(situation, memory)[0]

    def _gather(
        self,
        qpos: np.ndarray,
        qvel: np.ndarray,
        command: np.ndarray,
        arms: np.ndarray,
        modes: np.ndarray,
    ) -> Situation:
        """Gather the inputs that the networks share."""
        columns = self._columns
        walks = modes == Mode.MOBILE
        stands = ~walks
        if self._has_slow:
            stands = stands | (np.abs(command) < self._slow).all(axis=1)
        shared = np.zeros((len(qpos), columns.num_shared))
        if self._sees_velocity:
            velocity = quat_rotate(quat_conjugate(qpos[:, 3:7]), qvel[:, :3])
            shared[:, columns["linear_velocity"]] = velocity
        shared[:, columns["angular_velocity"]] = qvel[:, 3:6]
        shared[:, columns["gravity"]] = compute_projected_gravity(qpos[:, 3:7])
        shared[:, columns["positions"]] = qpos[:, self._angles]
        shared[:, columns["velocities"]] = qvel[:, self._speeds]
        targets = shared[:, columns["targets"]]
        waist = np.maximum(command[:, self._waist[1]], self._joints.low[self._waist[0]])
        targets[:, self._waist[0]] = np.minimum(waist, self._joints.high[self._waist[0]])
        targets[:, self._arms[0]] = arms[:, self._arms[1]]
        shared[:, columns["commands"]] = command
        shared[:, columns["gated"]] = command * walks[:, None]
        shared[:, columns["walks"]] = walks[:, None]
        yaw_rate = np.zeros(len(qpos)) if self._turns is None else command[:, self._turns]
        return Situation(shared, stands, qpos[:, 3:7], yaw_rate)

    def _run(
        self, index: int, situation: Situation, memory: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Run one network, and convert its targets to the policy's motors."""
        stage = self._stages[index]
        targets, after = stage.network.act(situation, memory)
        return self._convert(targets, situation, stage.motors, self.motors), after

    def _convert(
        self, targets: np.ndarray, situation: Situation, of: MotorSet, to: MotorSet
    ) -> np.ndarray:
        if of.matches(to):
            return targets
        q, v = (situation.shared[:, self._columns[name]] for name in ("positions", "velocities"))
        return convert_targets(targets, q, v, of, to)

    def _run_both(self, situation: Situation, memory: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Run the network of each robot's mode, and let the other one shadow it."""
        nu = len(self._joints.names)
        sizes = [2 + 2 * nu, *(stage.network.memory_size for stage in self._stages)]
        handover, *memories = np.split(memory, np.cumsum(sizes)[:-1], axis=1)
        active = np.where(situation.stands, 0, 1)
        targets = np.empty((len(memory), nu))
        after = [np.empty_like(each) for each in memories]
        rows_of = [np.flatnonzero(active == index) for index in (0, 1)]
        for index, rows in enumerate(rows_of):
            if len(rows):
                part = situation.choose(rows)
                targets[rows], after[index][rows] = self._run(index, part, memories[index][rows])
        targets, handover = self._hand_over(active, targets, handover)
        # The inactive network records the executed targets, converted to its own motors.
        for index, rows in enumerate(rows_of):
            if len(rows):
                other = self._stages[1 - index]
                part = situation.choose(rows)
                theirs = self._convert(targets[rows], part, self.motors, other.motors)
                watched = other.network.watch(part, memories[1 - index][rows], theirs)
                after[1 - index][rows] = watched
        return targets, np.concatenate([handover, *after], axis=1)

    def _hand_over(
        self, active: np.ndarray, targets: np.ndarray, handover: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Blend targets from one network to the other without a step."""
        nu = targets.shape[1]
        later = np.empty_like(handover)
        before, left = handover[:, 0], handover[:, 1]
        # The difference is taken at the switch, from then on its share decays linearly.
        changes = (before >= 0) & (before != active) & (self._handover_s > 0)
        difference = np.where(
            changes[:, None], handover[:, 2 + nu :] - targets, handover[:, 2 : 2 + nu]
        )
        left = np.where(changes, self._handover_s, np.maximum(left - POLICY_DT, 0.0))
        share = left / self._handover_s if self._handover_s > 0 else left
        targets = targets + share[:, None] * difference
        later[:, 0], later[:, 1] = active, left
        later[:, 2 : 2 + nu], later[:, 2 + nu :] = difference, targets
        return targets, later


def _name(mode: Mode) -> Literal["stationary", "mobile"]:
    return "stationary" if mode is Mode.STATIONARY else "mobile"


def _make_rest(stage: Stage, joints: RobotJoints) -> RestMap | None:
    """Make the rest map of the standing network's table.

    Raises:
        BadValue: If it is malformed, or names an unknown command entry.
    """
    rest = stage.table.rest
    if rest is None:
        return None
    for entry in rest.axes:
        joints.find_command(entry)
    held = {joints.by_command.get(joint) for joint in stage.network.held}
    names = [name for column, name in enumerate(joints.commands) if column in held]
    return RestMap(rest.axes, rest.pitch, rest.forward, names)


def _pair(mapping: Mapping[int, int]) -> tuple[slice | np.ndarray, slice | np.ndarray]:
    """Index of joints, and index of their targets."""
    return as_index(list(mapping)), as_index(list(mapping.values()))


def check_batch(name: str, array: np.ndarray, n: int, size: int) -> np.ndarray:
    """Return `array` as floats of shape (n, size).

    Raises:
        BadShape: Naming the argument, its expected and its actual shape.
    """
    array = np.asarray(array, dtype=float)
    if array.shape != (n, size):
        raise BadShape(name, (n, size), array.shape)
    return array


def _join_limits(joints: RobotJoints, *tables: d.PolicyTable) -> Mapping[str, tuple[float, float]]:
    """Intersection of the arm limits of all tables, by joint.

    Raises:
        BadValue: If a pattern names a joint that is not an arm joint.
    """
    joined: dict[str, tuple[float, float]] = {}
    for table in tables:
        for pattern, (low, high) in table.arm_limits.items():
            for joint in joints.select([pattern]):
                name = joints.names[joint]
                if joint not in joints.by_arm:
                    raise BadValue(f"arm_limits names {name}, which is no joint of arms")
                least, most = joined.get(name, (low, high))
                joined[name] = max(least, low), min(most, high)
    return joined
