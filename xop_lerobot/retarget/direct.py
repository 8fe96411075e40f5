"""The paper's baseline: direct mapping of the operator's head to commands, without prediction."""

from __future__ import annotations

from time import perf_counter

import mujoco
import numpy as np

from xop_lerobot.command import Mode
from xop_lerobot.morphology.effect import Acts
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.retarget.command_model import CommandModel
from xop_lerobot.retarget.plan import Plan, Retargeter
from xop_lerobot.retarget.proposal import KinematicProposal, ProposalWeights
from xop_lerobot.state import Goal, RobotState
from xop_lerobot.transforms import quat_yaw


class DirectRetargeter(Retargeter):
    """Maps the head's height and orientation by kinematics, and its velocity as it is.

    Height and torso come from inverse kinematics of the goal's height and orientation, with the
    base where it stands; the base's velocities are the goal's own, in its heading. Nothing
    closes the loop on the position, so the robot drifts: that is what the baseline shows.

    Args:
        morphology: The robot.
        model: Its planning model.
        control_hz: Plans per second of the robot's clock [Hz].
    """

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
        self._last = self.space.neutral

    def control_period(self, mode: Mode) -> float:
        """Time between two plans [s]."""
        del mode
        return 1 / self.control_hz

    def reset(self, state: RobotState) -> None:
        """Start from the command that `state` executes."""
        self._last = state.command

    def plan(self, state: RobotState, goal: Goal) -> Plan:
        """Compute the command for `goal`; `state` gives the base's heading and place."""
        start = perf_counter()
        velocities = self.command_model.is_velocity()
        command = self._last
        if "head" in goal.poses:
            # Long enough for the lags to die out: the mapping is static.
            command = self.proposal.solve(
                state.qpos,
                {"head": goal.poses["head"]},
                goal.mode,
                dt=2.0,
                start=self._last,
                free=self.command_model.acting(goal.mode) & ~velocities,
            )
        command = np.where(velocities, self._map_velocity(state, goal), command)
        command = np.clip(command, self.space.low, self.space.high)
        self._last = np.where(velocities, self.space.neutral, command)
        solve = perf_counter() - start
        return Plan(command, command[None], goal.mode, timings={"solve": solve})

    def _map_velocity(self, state: RobotState, goal: Goal) -> np.ndarray:
        """The goal's velocity in the heading of the base, on the entries it belongs to. (k,)."""
        velocity = goal.velocities.get("head", np.zeros(6))
        yaw = quat_yaw(state.qpos[3:7])
        forward = np.cos(yaw) * velocity[0] + np.sin(yaw) * velocity[1]
        left = np.cos(yaw) * velocity[1] - np.sin(yaw) * velocity[0]
        if goal.mode is Mode.STATIONARY:
            return self.space.neutral
        values = {Acts.FORWARD: forward, Acts.LEFT: left, Acts.TURN: velocity[5]}
        command = np.array([values.get(e.acts, 0.0) for e in self.command_model.effects])
        return np.where(self.command_model.acting(goal.mode), command, self.space.neutral)
