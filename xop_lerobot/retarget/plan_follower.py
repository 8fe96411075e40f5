"""Plans when it is due, in lock-step or in the background, and plays plans out."""

from __future__ import annotations

from typing import Any

import numpy as np

from xop_lerobot.core.state import Goal, RobotState
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.retarget.background import BackgroundPlanner
from xop_lerobot.retarget.delay import LatencyMeter, StatePredictor
from xop_lerobot.retarget.mpc import MpcRetargeter
from xop_lerobot.retarget.obstacles import Obstacle
from xop_lerobot.retarget.plan import Retargeter
from xop_lerobot.retarget.plan_track import StampedPlan


class PlanFollower:
    """Knows the plan that counts.

    In lock-step a plan counts from the instant of its state. On the wall clock it comes late:
    each solve starts from the state predicted to when its plan is expected to take effect, by
    the median of what the last plans took, and until then the last plan is played out.

    Args:
        retargeter: What plans.
        morphology: The robot.
        dt: Control period [s].
        realtime: Whether the robot's clock is the wall clock.
    """

    def __init__(
        self, retargeter: Retargeter, morphology: Morphology, dt: float, *, realtime: bool
    ) -> None:
        self.retargeter, self.dt = retargeter, dt
        self.background: BackgroundPlanner | None = None
        if realtime:
            predictor = None
            if isinstance(retargeter, MpcRetargeter):
                predictor = StatePredictor(morphology, retargeter.rollout)
            self.background = BackgroundPlanner(retargeter, predictor)
        self.latency = LatencyMeter()
        self.forget()

    def forget(self) -> None:
        """Have no plan any more."""
        self.current: StampedPlan | None = None
        self._asked_time = self._seen_time = float("-inf")

    def reset(self, state: RobotState) -> None:
        """Start anew from what `state` executes, as at an engagement."""
        (self.background or self.retargeter).reset(state)
        self.forget()

    def configure(self, **settings: Any) -> None:
        """Give the retargeter other settings from its next solve on."""
        (self.background or self.retargeter).configure(**settings)

    def set_obstacles(self, obstacles: tuple[Obstacle, ...]) -> None:
        """Give the retargeter other obstacles from its next solve on."""
        (self.background or self.retargeter).set_obstacles(obstacles)

    def update(self, state: RobotState, goal: Goal) -> None:
        """Plan where it is due; on the wall clock, ask for it and take the newest there is."""
        late = self.current is None or self.current.plan.mode is not goal.mode
        period = self.retargeter.control_period(goal.mode)
        # Half a tick early is closer than half a tick late.
        due = late or state.time - self._asked_time >= period - self.dt / 2
        if self.background is None:
            if due:
                plan = self.retargeter.plan(state, goal)
                self.current = StampedPlan(plan, state.time, state.time, period)
                self._asked_time = state.time
            return
        self._measure_latency(self.background, state.time)
        if due:
            self.background.submit(state, goal, self.latency.steps)
            self._asked_time = state.time
        self.current = self.background.at(state.time)

    def predict_velocity(self, time: float, since: float) -> np.ndarray | None:
        """Velocity of the base at `time` by the newest plan, for the state synchronisation.

        Args:
            time: The robot's clock [s].
            since: When the state was measured that the plan must have started from [s]. An older
                plan tells nothing that the state of `since` does not know already.

        Returns:
            Linear velocity, world axes [m/s], shape (3,); None where no plan tells.
        """
        if self.current is None:
            return None
        newest = self.current if self.background is None else self.background.latest
        if newest is None or newest.measured != since:
            return None
        return newest.predict_velocity(time)

    def _measure_latency(self, background: BackgroundPlanner, time: float) -> None:
        newest = background.latest
        if newest is not None and newest.measured != self._seen_time:
            self._seen_time = newest.measured
            self.latency.add(time - newest.measured)

    def close(self) -> None:
        """Stop the threads; may be called twice."""
        if self.background is not None:
            self.background.close()
        self.retargeter.close()
