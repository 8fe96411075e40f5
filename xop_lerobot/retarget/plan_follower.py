"""Schedule solves of a retargeter, in lock-step or in a background thread, and play their plans.

`PlanFollower` is what the control loop calls once a tick. On the wall clock it solves in a
`BackgroundPlanner`, which never blocks the tick, and compensates the solver's delay: each solve
starts from the state (`StatePredictor`) and goal (`predict_goal`) expected when its plan takes
effect.
"""

from __future__ import annotations

import dataclasses
import logging
import threading
from collections import deque
from typing import Any, NamedTuple

import numpy as np

from xop_lerobot.core.state import Goal, RobotState, freeze
from xop_lerobot.low_level.policy import POLICY_DT
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.retarget.horizon_goals import preview
from xop_lerobot.retarget.mpc import MpcRetargeter
from xop_lerobot.retarget.obstacles import Obstacle
from xop_lerobot.retarget.plan import PlanTrack, Retargeter, StampedPlan, overlay_arms
from xop_lerobot.retarget.rollout import PolicyRollout

logger = logging.getLogger(__name__)


class _Job(NamedTuple):
    state: RobotState
    goal: Goal
    ahead: int
    epoch: int


class BackgroundPlanner:
    """Solves in a thread of its own, always for the newest submitted state and goal.

    States that arrive during a slow solve are dropped. An exception in a solve is raised again in
    the caller by `submit`, `latest` and `at`, until the next `reset`.

    Args:
        retargeter: The retargeter; from now on only the thread may use it.
        predictor: Predicts the state a plan starts from; None starts from the measured one.
        threaded: Whether to start the thread; without it, tests call `run_once`.
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
        """Request a plan from `state` to `goal`; replaces a pending request.

        Args:
            state: Present state of the robot.
            goal: Present goal.
            ahead: Control steps after which the plan will take effect [20 ms].

        Raises:
            Exception: The exception of the last solve, if it failed.
        """
        with self._ready:
            self._check()
            self._job = _Job(state, goal, ahead, self._epoch)
            self._ready.notify()

    @property
    def latest(self) -> StampedPlan | None:
        """The newest plan since the last `reset`, None before the first.

        Raises:
            Exception: The exception of the last solve, if it failed.
        """
        with self._ready:
            self._check()
            return self._track.newest

    def at(self, time: float) -> StampedPlan | None:
        """The plan in force at `time` [s] of the robot's clock, None before the first.

        Raises:
            Exception: The exception of the last solve, if it failed.
        """
        with self._ready:
            self._check()
            return self._track.at(time)

    def configure(self, **settings: Any) -> None:
        """Change settings (`MpcRetargeter.configure`) before the next solve."""
        with self._ready:
            self._settings = (self._settings or {}) | settings

    def set_obstacles(self, obstacles: tuple[Obstacle, ...]) -> None:
        """Replace the obstacles (`Retargeter.set_obstacles`) before the next solve.

        The solving thread applies them, so never in the middle of a solve.
        """
        with self._ready:
            self._obstacles = obstacles

    def reset(self, state: RobotState) -> None:
        """Discard all plans, also the one being solved, and failures; restart from `state`."""
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
        """Raise the exception of the last solve, if it failed; the caller holds the lock."""
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
        """Solve the pending request, if any. The thread calls nothing else."""
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
            # A reset since the last solve: apply it in this thread, the retargeter's only user.
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
            if job.epoch == self._epoch:  # else a reset came meanwhile and the plan is void
                self._track.add(plan)

    def _solve(self, job: _Job, track: PlanTrack) -> StampedPlan:
        """Plan from the state predicted for the time when the plan takes effect."""
        state, goal = job.state, job.goal
        if self._predictor is not None:
            state = self._predictor.predict(state, track, job.ahead)
            goal = predict_goal(goal, state.time - job.state.time)
        plan = self._retargeter.plan(state, goal)
        period = self._retargeter.control_period(goal.mode)
        return StampedPlan(plan, state.time, job.state.time, period)


_GOAL_S = 0.3  # longest time for which a goal is assumed to keep its velocity [s]


class LatencyMeter:
    """Median time from a measurement to the first tick that can use its plan.

    Args:
        window: Number of plans in the median.
        longest: Upper bound of the latency that is compensated [s].
    """

    def __init__(self, window: int = 15, longest: float = 0.3) -> None:
        self._latencies: deque[float] = deque(maxlen=window)
        self.longest = longest

    def add(self, latency: float) -> None:
        """Add one latency [s]."""
        self._latencies.append(latency)

    def reset(self) -> None:
        """Discard all latencies."""
        self._latencies.clear()

    @property
    def median(self) -> float:
        """The median [s]; 0 before the first plan."""
        return float(np.median(self._latencies)) if self._latencies else 0.0

    @property
    def steps(self) -> int:
        """The median in control steps of 20 ms, at most `longest`."""
        return round(min(self.median, self.longest) / POLICY_DT)


class StatePredictor:
    """Predicts a state under the commands that will be executed until then.

    One rollout, like the planner's own, with the low-level policy and its memory in the loop.

    Args:
        morphology: The robot.
        rollout: The planner's rollouts; only the planning thread may use them.
    """

    def __init__(self, morphology: Morphology, rollout: PolicyRollout) -> None:
        self.morphology, self.rollout = morphology, rollout

    def predict(self, state: RobotState, track: PlanTrack, steps: int) -> RobotState:
        """Predict the state `steps` control steps later.

        Args:
            state: Present state of the robot.
            track: Plans that are executed meanwhile; without one the robot holds its command.
            steps: Control steps to predict [20 ms].

        Returns:
            The predicted state; `state` itself for no steps or if the prediction diverges.
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
    """The goal after `delay` [s] at constant velocity."""
    if delay <= 0:
        return goal
    ahead = preview(goal, tuple(goal.poses), np.array([delay]), _GOAL_S)
    return dataclasses.replace(goal, poses={name: poses[0] for name, poses in ahead.items()})


class PlanFollower:
    """Keeps the plan in force up to date.

    In lock-step a plan takes effect at the time of its state. On the wall clock it arrives late:
    each solve starts from the state predicted for the time when its plan is expected to take
    effect (median latency of the last plans), and the previous plan is executed until then.

    Args:
        retargeter: The retargeter.
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
        """Discard the current plan."""
        self.current: StampedPlan | None = None
        self._asked_time = self._seen_time = float("-inf")

    def reset(self, state: RobotState) -> None:
        """Restart from the command that `state` executes, as on engagement."""
        (self.background or self.retargeter).reset(state)
        self.forget()

    def configure(self, **settings: Any) -> None:
        """Change settings of the retargeter from its next solve on."""
        (self.background or self.retargeter).configure(**settings)

    def set_obstacles(self, obstacles: tuple[Obstacle, ...]) -> None:
        """Replace the obstacles of the retargeter from its next solve on."""
        (self.background or self.retargeter).set_obstacles(obstacles)

    def update(self, state: RobotState, goal: Goal) -> None:
        """Solve if a plan is due; on the wall clock, request it and take the newest there is."""
        late = self.current is None or self.current.plan.mode is not goal.mode
        period = self.retargeter.control_period(goal.mode)
        # Ticks rarely hit the period exactly: take the nearest one, also if it is a bit early.
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
