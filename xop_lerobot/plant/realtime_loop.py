"""Real-time control loop: the policy loop on the wall clock, in a thread of its own."""

from __future__ import annotations

import dataclasses
import logging
import threading
import time

import numpy as np

from xop_lerobot.core.command import Mode, RobotAction
from xop_lerobot.core.state import RobotState
from xop_lerobot.low_level.policy import POLICY_DT, LowLevelPolicy
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.plant.plant import Plant
from xop_lerobot.plant.policy_loop import PolicyLoop

logger = logging.getLogger(__name__)

_WATCHDOG_S = 0.5  # time without a new action after which the robot stops
_MAX_LAG_S = 0.2  # lag behind the wall clock beyond which the lost time is not caught up


class RealtimeLoop:
    """Runs a `PolicyLoop` at 50 Hz against the wall clock.

    `execute` sets the newest action and returns at once; the policy never waits for the caller. If
    no action arrives for half a second, the robot stops in place and holds its posture. If the
    machine is too slow, simulated time falls behind, which `late_ticks` counts.

    Args:
        morphology: The robot.
        plant: Its body; `measure` and `render` must be allowed concurrently with `step`.
        policy: Its low-level policy.
    """

    def __init__(self, morphology: Morphology, plant: Plant, policy: LowLevelPolicy) -> None:
        self._loop = PolicyLoop(morphology, plant, policy)
        self.morphology = self._loop.morphology
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._handed_over = 0.0
        self._resting: np.ndarray | None = None  # target command of the watchdog
        self._failure: BaseException | None = None
        self.late_ticks = 0
        """Number of policy periods that began more than one period late."""

    @property
    def state(self) -> RobotState:
        """Measured state of the robot.

        Raises:
            Exception: The exception that ended the loop's thread, if any.
        """
        with self._lock:
            self._check()
            return self._loop.state

    def reset(
        self, seed: int | None = None, settle_s: float = 1.0, start: RobotAction | None = None
    ) -> None:
        """Reset the plant, let it settle (faster than the wall clock), then start the thread.

        Clears a failure of the loop's thread.
        """
        self._halt()
        self._failure = None
        self._loop.reset(seed, settle_s, start)
        self._stop.clear()
        self._handed_over, self._resting = time.monotonic(), None
        self._thread = threading.Thread(target=self._run, name="xop-policy", daemon=True)
        self._thread.start()

    def execute(self, action: RobotAction, dt: float) -> RobotAction:
        """Limit `action`, set it, and return the action that is executed from now on.

        Raises:
            Exception: The exception that ended the loop's thread, if any.
        """
        with self._lock:
            self._check()
            limited = self._loop.limit(action, dt)
            self._loop.action = limited
            self._handed_over, self._resting = time.monotonic(), None
        return limited

    def close(self) -> None:
        """Stop the thread and close the plant; may be called twice."""
        self._halt()
        self._loop.close()

    def _check(self) -> None:
        """Raise the exception that ended the loop's thread, if any."""
        if self._failure is not None:
            raise self._failure

    def _halt(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _run(self) -> None:
        try:
            self._run_until_stopped()
        except BaseException as failure:  # raised again in the caller by `_check`
            self._failure = failure
            logger.exception("the policy loop has ended")

    def _run_until_stopped(self) -> None:
        due = time.monotonic()
        while not self._stop.is_set():
            with self._lock:
                self._guard()
                self._loop.advance(POLICY_DT)
            due += POLICY_DT
            ahead = due - time.monotonic()
            if ahead > 0:
                self._stop.wait(ahead)
                continue
            self.late_ticks += ahead < -POLICY_DT
            if ahead < -_MAX_LAG_S:
                due = time.monotonic()
            time.sleep(0)  # a loop that is always late must still yield the lock to `execute`

    def _guard(self) -> None:
        """Watchdog: stop the robot if no action has been set for too long.

        The mode becomes stationary only once the velocities are zero. Otherwise a caller that
        resumes meanwhile would take the remaining velocities for a weight shift.
        """
        if time.monotonic() - self._handed_over < _WATCHDOG_S:
            return
        action, space = self._loop.action, self.morphology.command_space
        if self._resting is None:
            self._resting = space.compute_rest(action.command, action.mode)
        wanted = dataclasses.replace(action, command=self._resting)
        action = self._loop.limit(wanted, POLICY_DT)
        moves = space.mobile_only & (np.abs(action.command - self._resting) > 1e-6)
        if not moves.any():
            action = dataclasses.replace(action, mode=Mode.STATIONARY)
        self._loop.action = action
