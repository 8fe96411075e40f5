"""A retargeter in a thread of its own: the newest plan, never a wait for it."""

from __future__ import annotations

import logging
import threading
from typing import NamedTuple

from xop_lerobot.retarget.plan import Plan, Retargeter
from xop_lerobot.state import Goal, RobotState

logger = logging.getLogger(__name__)


class StampedPlan(NamedTuple):
    """A plan and the robot's time of the state it starts from.

    Attributes:
        plan: The plan.
        time: Time of its state [s].
    """

    plan: Plan
    time: float


class BackgroundPlanner:
    """Solves in a thread for the newest state and goal that were submitted.

    A slow solve drops the states that came meanwhile: the next one starts from the newest. What
    a solve raises is raised in the caller, by `submit` and `latest`, until the next `reset`.

    Args:
        retargeter: What solves; used by the thread alone from now on.
    """

    def __init__(self, retargeter: Retargeter) -> None:
        self._retargeter = retargeter
        self._ready = threading.Condition()
        self._job: tuple[RobotState, Goal, int] | None = None
        self._latest: StampedPlan | None = None
        self._reset_to: RobotState | None = None
        self._epoch = 0
        self._running = True
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="xop-planner", daemon=True)
        self._thread.start()

    def submit(self, state: RobotState, goal: Goal) -> None:
        """Ask for a plan from `state` to `goal`; replaces what has not been begun.

        Raises:
            Exception: Whatever the last solve failed with.
        """
        with self._ready:
            self._check()
            self._job = (state, goal, self._epoch)
            self._ready.notify()

    @property
    def latest(self) -> StampedPlan | None:
        """The newest plan since the last `reset`, None before the first.

        Raises:
            Exception: Whatever the last solve failed with.
        """
        with self._ready:
            self._check()
            return self._latest

    def reset(self, state: RobotState) -> None:
        """Forget all plans, also the one being solved, and failures; start anew from `state`."""
        with self._ready:
            self._epoch += 1
            self._job = self._latest = self._failure = None
            self._reset_to = state

    def close(self) -> None:
        """End the thread; may be called twice."""
        with self._ready:
            self._running = False
            self._ready.notify()
        self._thread.join()

    def _check(self) -> None:
        """Raise what the last solve failed with; the caller holds the lock."""
        if self._failure is not None:
            raise self._failure

    def _run(self) -> None:
        epoch = 0
        while True:
            with self._ready:
                self._ready.wait_for(lambda: self._job is not None or not self._running)
                if not self._running:
                    return
                assert self._job is not None
                state, goal, wanted = self._job
                reset_to, self._job = self._reset_to, None
            try:
                if wanted != epoch and reset_to is not None:
                    self._retargeter.reset(reset_to)
                    epoch = wanted
                plan = self._retargeter.plan(state, goal)
            except Exception as failure:
                logger.exception("the planner has failed")
                with self._ready:
                    if wanted == self._epoch:
                        self._failure, self._job = failure, None
                continue
            with self._ready:
                if wanted == self._epoch:
                    self._latest = StampedPlan(plan, state.time)
