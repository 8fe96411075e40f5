"""Prior of the state synchronisation: the motion that the executed action will bring about."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from xop_lerobot.core.command import RobotAction
from xop_lerobot.core.state import RobotState
from xop_lerobot.low_level.policy import POLICY_DT, LowLevelPolicy
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.retarget.rollout import PolicyRollout


class VelocityPrior:
    """Predicts the base velocity of the next tick by one rollout of the executed action.

    The rollout starts from the synchronised state and the policy's memory, and the action is the
    one that the robot executes, with its arms: what none of a plan's samples is.

    Args:
        morphology: The robot.
        policy: Its low-level policy.
        model: Its planning model.
        dt: Control period [s].
    """

    def __init__(
        self,
        morphology: Morphology,
        policy: LowLevelPolicy,
        model: mujoco.MjModel,
        dt: float,
    ) -> None:
        self._ramps = morphology.ramps
        self._rollout = PolicyRollout(model, policy, num_threads=1)
        self._steps = math.ceil(dt / POLICY_DT - 1e-9)
        self.forget()

    def forget(self) -> None:
        """Discard the prediction: the robot may have been moved."""
        self._start = -math.inf
        self._velocities = np.full((1, 3), np.nan)

    def note(self, state: RobotState, action: RobotAction) -> None:
        """Predict what follows when `action` is executed from the synchronised `state` on."""
        shares = np.ones((self._steps, 1))
        if self._ramps and state.mode is action.mode:  # the robot interpolates within the period
            shares = np.arange(1, self._steps + 1)[:, None] / self._steps
        commands = state.command + shares * (action.command - state.command)
        arms = state.arms + shares * (action.arms - state.arms)
        executed = (state.command, state.arms, state.mode) if self._ramps else None
        predicted = self._rollout.predict(
            state.qpos, state.qvel, state.memory, commands[None], arms[None], action.mode, executed
        )
        self._start, self._velocities = state.time, predicted.qvel[0, :, :3]

    def predict(self, time: float, since: float) -> np.ndarray | None:
        """Linear velocity of the base at `time`, world axes.

        Args:
            time: The robot's clock [s].
            since: Time of the state that the prediction must be based on [s]. An older one holds
                no information that this state does not have already.

        Returns:
            Velocity [m/s], shape (3,), interpolated between control steps; None outside the
            predicted period.
        """
        step = (time - since) / POLICY_DT
        last = len(self._velocities) - 1
        # A clock may be off by half a step.
        if self._start != since or not -0.5 <= step <= last + 0.5:
            return None
        steps = np.arange(last + 1)
        velocity = np.array([np.interp(step, steps, axis) for axis in self._velocities.T])
        return velocity if np.isfinite(velocity).all() else None

    def close(self) -> None:
        """Stop the threads of the rollout; may be called twice."""
        self._rollout.close()
