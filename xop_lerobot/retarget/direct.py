"""The paper's direct-mapping baseline: head pose and velocity to commands, without prediction."""

from __future__ import annotations

from time import perf_counter

import mujoco
import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.state import Goal, RobotState
from xop_lerobot.core.transforms import (
    compute_heading,
    make_pose,
    quat_from_yaw,
    quat_multiply,
    quat_yaw,
    wrap_angle,
)
from xop_lerobot.morphology.effect import Acts
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.retarget.model.command_model import CommandModel, Start, find_joints_along
from xop_lerobot.retarget.model.proposal import KinematicProposal, ProposalWeights
from xop_lerobot.retarget.plan import Plan, Retargeter


class DirectRetargeter(Retargeter):
    """Maps height and orientation of the head by kinematics, and its velocity unchanged.

    Height and torso joints solve the inverse kinematics of the goal's height and orientation for
    the present base pose. The base velocities are those of the operator's head, along and across
    the head's heading: an operator who walks forward makes the robot walk forward, whatever their
    headings in the world. Nothing closes the loop on position or heading, so the robot drifts, as
    the baseline is meant to show. A heading that the waist does not control, or cannot reach, is
    left to the yaw rate; otherwise waist roll and pitch would be bent to reduce the remaining
    error.

    Args:
        morphology: The robot.
        model: Its planning model.
        control_hz: Plans per second of the robot's clock [Hz].
    """

    holds_place = False

    def __init__(
        self, morphology: Morphology, model: mujoco.MjModel, control_hz: float = 25.0
    ) -> None:
        self.space = morphology.command_space
        self.control_hz = control_hz
        self.command_model = CommandModel(model, self.space, morphology.effects, morphology.pivot)
        site = morphology.frames["head"]
        self.proposal = KinematicProposal(
            model, self.command_model, {"head": site}, ProposalWeights(position=(0.0, 0.0, 1.0))
        )
        self._turns_waist = find_joints_along(morphology, model, self.command_model, axis=2)
        self._last = self.space.neutral
        self._drifted = 0.0  # goal heading out of the waist's range when last in mobile mode [rad]

    def control_period(self, mode: Mode) -> float:
        """Time between two plans [s]."""
        del mode
        return 1 / self.control_hz

    def reset(self, state: RobotState) -> None:
        """Start from the command that `state` executes."""
        self._last, self._drifted = state.command, 0.0

    def plan(self, state: RobotState, goal: Goal) -> Plan:
        """Compute the command for `goal`; of `state` only the base pose is used."""
        start = perf_counter()
        velocities = self.command_model.is_velocity()
        command = self._last
        if "head" in goal.poses:
            # The mapping is static: 2 s is long enough for the lags of the command model to decay.
            command = self.proposal.solve(
                Start(state.qpos),
                {"head": self._turn_to_base(state, goal)},
                goal.mode,
                dt=2.0,
                start=self._last,
                free=self.command_model.acting(goal.mode) & ~velocities,
            ).command
        command = np.where(velocities, self._map_velocity(state, goal), command)
        command = self.space.leave_dead_zones(command, goal.mode)
        command = np.clip(command, *self.space.bounds(goal.mode))
        self._last = np.where(velocities, self.space.neutral, command)
        solve = perf_counter() - start
        return Plan(command, command[None], goal.mode, timings={"solve": solve})

    def _turn_to_base(self, state: RobotState, goal: Goal) -> np.ndarray:
        """The head's goal with its heading turned into the range of the waist. Shape (7,)."""
        pose, base = goal.poses["head"], float(quat_yaw(state.qpos[3:7]))
        beside = float(wrap_angle(compute_heading(pose[3:]) - base))
        waist = self._turns_waist & self.command_model.acting(goal.mode)
        low, high = self.space.low[waist].sum(), self.space.high[waist].sum()
        if goal.mode is Mode.MOBILE:  # the yaw rate has to follow what exceeds the waist's range
            self._drifted = beside - float(np.clip(beside, low, high))
        beside = float(np.clip(wrap_angle(beside - self._drifted), low, high))
        wanted = base + beside
        back = wanted - float(compute_heading(pose[3:]))
        return make_pose(pose[:3], quat_multiply(quat_from_yaw(back), pose[3:]))

    def _map_velocity(self, state: RobotState, goal: Goal) -> np.ndarray:
        """Velocity of the head in its own heading, as base velocities of the command. (k,)."""
        velocity = goal.velocities.get("head", np.zeros(6))
        if goal.mode is Mode.STATIONARY or "head" not in goal.poses:
            return self.space.neutral
        yaw = compute_heading(goal.poses["head"][3:])
        forward = np.cos(yaw) * velocity[0] + np.sin(yaw) * velocity[1]
        left = np.cos(yaw) * velocity[1] - np.sin(yaw) * velocity[0]
        values = {Acts.FORWARD: forward, Acts.LEFT: left, Acts.TURN: velocity[5]}
        command = np.array([values.get(e.acts, 0.0) for e in self.command_model.effects])
        return np.where(self.command_model.acting(goal.mode), command, self.space.neutral)
