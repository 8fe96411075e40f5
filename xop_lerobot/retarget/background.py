"""A retargeter in a thread of its own: the newest plan, never a wait for it."""

from __future__ import annotations

import logging
import threading
from typing import Any, NamedTuple

from xop_lerobot.core.state import Goal, RobotState
from xop_lerobot.retarget.delay import StatePredictor, predict_goal
from xop_lerobot.retarget.obstacles import Obstacle
from xop_lerobot.retarget.plan import Retargeter
from xop_lerobot.retarget.plan_track import PlanTrack, StampedPlan

logger = logging.getLogger(__name__)


class _Job(NamedTuple):
    state: RobotState
    goal: Goal
    ahead: int
    epoch: int


class BackgroundPlanner:
    """Solves in a thread for the newest state and goal that were submitted.

    A slow solve drops the states that came meanwhile: the next one starts from the newest,
    predicted to when its plan will take effect. What a solve raises is raised in the caller, by
    `submit`, `latest` and `at`, until the next `reset`.

    Args:
        retargeter: What solves; used by the thread alone from now on.
        predictor: Predicts the state a plan starts from; None starts from the measured one.
        threaded: False solves in `run_once` alone, for tests.
    """

    def __init__(
        self,
        retargeter: Retargeter,
        predictor: StatePredictor | None = None,
        *,
        threaded: bool = True,
    ) -> None:
        self._retargeter, self._predictor = retargeter, predictor
        self._ready = threading.Condition()
        self._job: _Job | None = None
        self._settings: dict[str, Any] | None = None
        self._obstacles: tuple[Obstacle, ...] | None = None
        self._track = PlanTrack()
        self._reset_to: RobotState | None = None
        self._epoch = self._solved_epoch = 0
        self._running = True
        self._failure: Exception | None = None
        self._thread: threading.Thread | None = None
        if threaded:
            self._thread = threading.Thread(target=self._run, name="xop-planner", daemon=True)
            self._thread.start()

    def submit(self, state: RobotState, goal: Goal, ahead: int = 0) -> None:
        """Ask for a plan from `state` to `goal`; replaces what has not been begun.

        Args:
            state: The robot now.
            goal: The goal now.
            ahead: Control steps after which the plan will take effect [20 ms].

        Raises:
            Exception: Whatever the last solve failed with.
        """
        with self._ready:
            self._check()
            self._job = _Job(state, goal, ahead, self._epoch)
            self._ready.notify()

    @property
    def latest(self) -> StampedPlan | None:
        """The newest plan since the last `reset`, None before the first.

        Raises:
            Exception: Whatever the last solve failed with.
        """
        with self._ready:
            self._check()
            return self._track.newest

    def at(self, time: float) -> StampedPlan | None:
        """The plan that counts at `time` [s] of the robot's clock, None before the first.

        Raises:
            Exception: Whatever the last solve failed with.
        """
        with self._ready:
            self._check()
            return self._track.at(time)

    def configure(self, **settings: Any) -> None:
        """Give the retargeter other settings (`MpcRetargeter.configure`) before its next solve."""
        with self._ready:
            self._settings = (self._settings or {}) | settings

    def set_obstacles(self, obstacles: tuple[Obstacle, ...]) -> None:
        """Give the retargeter other obstacles (`Retargeter.set_obstacles`) before its next solve.

        They are handed over in the solving thread, never in the middle of a solve.
        """
        with self._ready:
            self._obstacles = obstacles

    def reset(self, state: RobotState) -> None:
        """Forget all plans, also the one being solved, and failures; start anew from `state`."""
        with self._ready:
            self._epoch += 1
            self._job = self._failure = None
            self._track.clear()
            self._reset_to = state

    def close(self) -> None:
        """End the thread; may be called twice."""
        with self._ready:
            self._running = False
            self._ready.notify()
        if self._thread is not None:
            self._thread.join()

    def _check(self) -> None:
        """Raise what the last solve failed with; the caller holds the lock."""
        if self._failure is not None:
            raise self._failure

    def _run(self) -> None:
        while True:
            with self._ready:
                self._ready.wait_for(lambda: self._job is not None or not self._running)
                if not self._running:
                    return
            self.run_once()

    def run_once(self) -> None:
        """Solve what was asked for last, if anything; the thread does nothing else."""
        with self._ready:
            job, self._job = self._job, None
            reset_to, settings = self._reset_to, self._settings
            self._settings = None
            obstacles, self._obstacles = self._obstacles, None
            track = self._track.copy()
        if job is None:
            return
        try:
            if settings is not None:
                self._retargeter.configure(**settings)
            if obstacles is not None:
                self._retargeter.set_obstacles(obstacles)
            if job.epoch != self._solved_epoch and reset_to is not None:
                self._retargeter.reset(reset_to)
                self._solved_epoch = job.epoch
            plan = self._solve(job, track)
        except Exception as failure:
            logger.exception("the planner has failed")
            with self._ready:
                if job.epoch == self._epoch:
                    self._failure, self._job = failure, None
            return
        with self._ready:
            if job.epoch == self._epoch:
                self._track.add(plan)

    def _solve(self, job: _Job, track: PlanTrack) -> StampedPlan:
        """Plan from where the robot will be when the plan takes effect."""
        state, goal = job.state, job.goal
        if self._predictor is not None:
            state = self._predictor.predict(state, track, job.ahead)
            goal = predict_goal(goal, state.time - job.state.time)
        plan = self._retargeter.plan(state, goal)
        period = self._retargeter.control_period(goal.mode)
        return StampedPlan(plan, state.time, job.state.time, period)
