"""Delay: where the robot, and its goal, will be when a plan takes effect."""

from __future__ import annotations

import dataclasses
from collections import deque

import numpy as np

from xop_lerobot.core.state import Goal, RobotState, freeze
from xop_lerobot.low_level.policy import POLICY_DT
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.retarget.horizon_goals import preview
from xop_lerobot.retarget.plan_track import PlanTrack, overlay_arms
from xop_lerobot.retarget.rollout import PolicyRollout

_GOAL_S = 0.3  # longest time over which a goal is assumed to keep its velocity [s]


class LatencyMeter:
    """Median time from the measurement to the first tick that can use its plan.

    Args:
        window: Number of plans that count.
        longest: Latency beyond which the prediction does not follow [s].
    """

    def __init__(self, window: int = 15, longest: float = 0.3) -> None:
        self._latencies: deque[float] = deque(maxlen=window)
        self.longest = longest

    def add(self, latency: float) -> None:
        """Take one more [s]."""
        self._latencies.append(latency)

    def reset(self) -> None:
        """Forget all."""
        self._latencies.clear()

    @property
    def median(self) -> float:
        """The median [s]; 0 before the first."""
        return float(np.median(self._latencies)) if self._latencies else 0.0

    @property
    def steps(self) -> int:
        """The median in control steps of 20 ms, at most `longest`."""
        return round(min(self.median, self.longest) / POLICY_DT)


class StatePredictor:
    """Rolls a state forward under the commands that will be executed meanwhile.

    One rollout, with the low-level policy and its memory in the loop, as the planner's own.

    Args:
        morphology: The robot.
        rollout: The planner's rollouts; used by the thread that plans.
    """

    def __init__(self, morphology: Morphology, rollout: PolicyRollout) -> None:
        self.morphology, self.rollout = morphology, rollout

    def predict(self, state: RobotState, track: PlanTrack, steps: int) -> RobotState:
        """Predict the state `steps` control steps later.

        Args:
            state: The robot now.
            track: Plans that are played out meanwhile; without one the robot holds.
            steps: How far [20 ms].

        Returns:
            The state then; `state` itself for no steps, or if the prediction diverges.
        """
        if steps < 1:
            return state
        space, names = self.morphology.command_space, self.morphology.arm_names
        commands = np.empty((1, steps, len(space)))
        arms = np.tile(state.arms, (1, steps, 1))
        command, mode = state.command, state.mode
        for step in range(steps):
            time = state.time + step * POLICY_DT
            plan = track.at(time)
            wanted = command
            if plan is not None:
                wanted, mode = plan.get_command(time, space), plan.plan.mode
                overlay_arms(arms[0, step], names, plan.get_arms(time))
            command = space.limit(wanted, command, POLICY_DT, mode)
            commands[0, step] = command
        executed = (state.command, state.arms, state.mode) if self.morphology.ramps else None
        prediction = self.rollout.predict(
            state.qpos, state.qvel, state.memory, commands, arms, mode, executed
        )
        qpos, qvel = prediction.qpos[0, -1], prediction.qvel[0, -1]
        if not (np.isfinite(qpos).all() and np.isfinite(qvel).all()):
            return state
        return dataclasses.replace(
            state,
            time=state.time + steps * POLICY_DT,
            qpos=freeze(qpos),
            qvel=freeze(qvel),
            memory=freeze(prediction.memory[0]),
            command=freeze(command),
            arms=freeze(arms[0, -1]),
            mode=mode,
        )


def predict_goal(goal: Goal, delay: float) -> Goal:
    """Where the goal will be after `delay` [s], if it keeps its velocity."""
    if delay <= 0:
        return goal
    ahead = preview(goal, tuple(goal.poses), np.array([delay]), _GOAL_S)
    return dataclasses.replace(goal, poses={name: poses[0] for name, poses in ahead.items()})
