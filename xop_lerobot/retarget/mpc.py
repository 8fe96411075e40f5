"""Model predictive controller: KMPPI over MuJoCo rollouts with the low-level policy in the loop.

`MpcRetargeter` solves Eq. 1 once per call of `plan`. The parts of a solve are in `references.py`
(reference trajectory), `candidates.py` (analytic proposal, verdict), `kmppi.py` (sampling and
update) and `problem.py` (dynamics and cost).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from threading import RLock
from time import perf_counter

import mujoco
import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import UnknownName
from xop_lerobot.core.state import Goal, RobotState
from xop_lerobot.low_level.policy import POLICY_DT, LowLevelPolicy
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.morphology.tuning import MpcConfig
from xop_lerobot.retarget.candidates import Candidates, Verdict, judge
from xop_lerobot.retarget.config import CONSTRAINTS, RetargeterConfig, split_names
from xop_lerobot.retarget.decision import DecisionSpace
from xop_lerobot.retarget.kmppi import compute_effective_samples
from xop_lerobot.retarget.model.command_model import CommandModel, PlannerState
from xop_lerobot.retarget.model.observers import DriftObserver, OffsetObserver
from xop_lerobot.retarget.obstacles import Obstacle
from xop_lerobot.retarget.optimizer import SamplingOptimizer, build_optimizer
from xop_lerobot.retarget.plan import Plan, Retargeter, Status
from xop_lerobot.retarget.problem import Problem, Scores
from xop_lerobot.retarget.references import References
from xop_lerobot.retarget.rollout import Prediction


@dataclass(frozen=True)
class _Planner:
    """Optimizer of one mode; it holds the current plan.

    Attributes:
        optimizer: The sampling optimizer.
        noise_std: Standard deviation of the sampling noise per decision entry. Shape (n,).
    """

    optimizer: SamplingOptimizer
    noise_std: np.ndarray


class MpcRetargeter(Retargeter):
    r"""Solves Eq. 1: :math:`\min_{a_0 \dots a_{H-1}} \sum_k l(x_k, a_k, G) + V_f(x_H, G)`.

    Each solve shifts the last plan by the elapsed time, adds fixed candidates (kinematic proposal,
    executed command, stop) to noisy samples around it, rolls all of them out in MuJoCo with the
    low-level policy and its memory in the loop, and moves the plan to their weighted mean.
    `configure` and `set_obstacles` may be called from any thread; they take effect at the next
    solve.

    Args:
        morphology: The robot.
        policy: Its low-level policy.
        model: Its planning model in the scene.
        config: Settings; zeros take the robot's own parameters.
        targets: Tracked frames to follow; None takes those of `config`.
        obstacles: Obstacles to avoid; by default the geoms that are fixed in `model`.
    """

    def __init__(
        self,
        morphology: Morphology,
        policy: LowLevelPolicy,
        model: mujoco.MjModel,
        config: RetargeterConfig | None = None,
        targets: tuple[str, ...] | None = None,
        obstacles: Iterable[Obstacle] | None = None,
    ) -> None:
        config = config or RetargeterConfig()
        self.morphology = morphology
        self.decision = DecisionSpace(morphology, model)
        self.space = self.decision.space
        self.command_model = CommandModel(
            model, self.space, self.decision.effects, morphology.pivot, morphology.rest
        )
        self.drift = DriftObserver(self.command_model, lag_s=morphology.velocity_lag_s)
        # A torque-limited servo can rest far from its command, and the other joints must then
        # compensate; a policy far from its command is usually still moving, so its bound is small.
        largest = morphology.largest_offset
        self.offset = OffsetObserver(self.command_model, largest=largest)
        self.problem = Problem(
            morphology,
            policy,
            model,
            self.decision,
            self.command_model,
            config.num_threads,
            obstacles,
        )
        self.rollout = self.problem.rollout
        self.references = References(
            morphology,
            model,
            self.command_model,
            self.problem.support,
            self.problem.load,
            self.problem.obstacles,
        )
        self.candidates = Candidates(
            morphology,
            self.rollout.model,
            self.decision,
            self.command_model,
            self.problem.support,
            self.problem.load,
        )
        self.cost_names = tuple(cost.name for cost in self.problem.costs)
        self._seed, self._rng = config.seed, np.random.default_rng(config.seed)
        self._lock = RLock()
        self._last: tuple[float, Mode] | None = None
        self.configs: dict[Mode, MpcConfig] = {}
        self._planners: dict[Mode, _Planner] = {}
        if targets is None:
            targets = split_names(config.targets) or ("head",)
        self.configure(
            {mode: config.override(morphology.mpc_config(mode)) for mode in Mode},
            targets,
            split_names(config.body),
            frozenset(split_names(config.constraints)),
        )

    def configure(
        self,
        configs: Mapping[Mode, MpcConfig] | None = None,
        targets: tuple[str, ...] | None = None,
        body: tuple[str, ...] | None = None,
        constraints: frozenset[str] | None = None,
    ) -> None:
        """Change settings from the next solve on; None keeps a setting. All or nothing.

        The current plan is kept as the starting point, so the command does not jump.

        Args:
            configs: Parameters of the modes that change.
            targets: Tracked frames to follow.
            body: Commands and arm joints that may move for them; empty for all commands.
            constraints: Active constraints, such as ``"upright"``.

        Raises:
            UnknownName: If a target, entry or constraint is unknown; lists the known ones.
        """
        with self._lock:
            frames = self.morphology.frames
            for name in targets or ():
                if name not in frames:
                    raise UnknownName("tracked frame", name, frames)
            for name in constraints or ():
                if name not in CONSTRAINTS:
                    raise UnknownName("constraint", name, CONSTRAINTS)
            mask = self.command_model.body if body is None else self.decision.make_mask(body)
            new = {**self.configs, **(configs or {})}
            planners = {mode: self._make_planner(mode, each) for mode, each in new.items()}

            self.configs, self._planners = new, planners  # from here on nothing fails
            if targets is not None:
                self.frames = targets
            if constraints is not None:
                self.constraints = constraints
            if body is not None and not np.array_equal(mask, self.command_model.body):
                self.command_model.body, self._last = mask, None
            self.command_model.sways = "sway" in new[Mode.STATIONARY].aids
            sites = {name: frames[name] for name in self.frames}
            hands = {arm.frame for arm in self.morphology.arms}
            upright = tuple(hands & set(sites)) if "upright" in self.constraints else ()
            self.references.configure(new, sites, upright)
            self.candidates.configure(new, sites, bool(upright))

    def _make_planner(self, mode: Mode, config: MpcConfig) -> _Planner:
        """Make a planner for `config` that starts from the present plan."""
        noise = np.zeros(len(self.space))
        for name, value in config.noise_std.items():
            noise[self.space.index(name)] = value  # raises for a misspelt name
        old = self._planners.get(mode)
        # The optimizer does not depend on the cost weights: keep it, with its plan as it is.
        if old is not None and replace(self.configs[mode], weights=config.weights) == config:
            return _Planner(old.optimizer, noise)
        optimizer = build_optimizer(config.horizon, self.space.low, self.space.high, config)
        if old is not None:
            optimizer.reset(old.optimizer.commands[0])
        return _Planner(optimizer, noise)

    def set_obstacles(self, obstacles: tuple[Obstacle, ...]) -> None:
        """Replace the obstacles to avoid, from the next solve on."""
        with self._lock:
            self.problem.set_obstacles(obstacles)
            self.references.set_obstacles(obstacles)

    def control_period(self, mode: Mode) -> float:
        """Time between two plans in `mode` [s]."""
        return 1 / self.configs[mode].control_hz

    def close(self) -> None:
        """Stop the threads of the rollouts."""
        self.rollout.close()

    def reset(self, state: RobotState) -> None:
        """Restart from the command that `state` executes, with a freshly seeded generator."""
        with self._lock:
            self._rng = np.random.default_rng(self._seed)
            self._last = None
            executed = self.decision.join(state.command, state.arms)
            self.candidates.reset()
            self.references.reset()
            self.drift.reset()
            self.offset.reset(executed)
            for planner in self._planners.values():
                planner.optimizer.reset(executed)

    def plan(self, state: RobotState, goal: Goal) -> Plan:
        """Compute the plan from `state` towards `goal`."""
        with self._lock:
            return self._solve(state, goal)

    def _solve(self, state: RobotState, goal: Goal) -> Plan:
        begin = perf_counter()
        mode, config, planner = goal.mode, self.configs[goal.mode], self._planners[goal.mode]
        optimizer = planner.optimizer
        now = self._observe(state, mode, config)
        self._warm_start(now, mode)

        # Reference trajectory, and the analytic solution for it.
        reference = self.references.lead(now, goal, config)
        proposal = self.candidates.propose(now, reference, mode, config, optimizer.commands[0])
        proposal = self._hold(proposal, now, mode, proposal)
        reference = self.references.detour(reference, now, proposal, mode, config)

        # Samples: the shifted plan, the fixed candidates, and noise around the plan.
        candidates = self.candidates.collect(state, goal, now, proposal, config)
        share = reference.compute_noise_share(now.poses, config)
        noise = planner.noise_std * self.command_model.acting(mode) * share
        samples = optimizer.sample(self._rng, noise, self._hold(candidates, now, mode, proposal))
        commands = self.problem.restrict(self._hold(samples.commands, now, mode, proposal), mode)
        sampled = perf_counter()

        # Dynamics (Eqs. 1b, 1c) and cost (Eq. 1a) of the samples.
        prediction = self.problem.predict(state, now, commands, mode)
        rolled = perf_counter()
        scores = self.problem.score(
            self.problem.evaluate(prediction, commands, now, reference, proposal, mode, config)
        )
        weights = optimizer.update(samples, scores.costs)  # adds the samples' own penalty

        # Execute the weighted mean unless it is likely to fall or collide.
        stop = _find_stop(config, len(commands))
        verdict = judge(weights, scores.costs, scores.falls, scores.touches, stop)
        if "intervention" not in config.aids:
            verdict = verdict.keep_plan()
        self._apply(verdict, optimizer, samples.commands, now)
        planned = self._hold(optimizer.commands, now, mode, proposal)
        planned = self.problem.restrict(planned, mode)
        end = perf_counter()
        timings = {
            "solve": end - begin,
            "proposal": sampled - begin,
            "rollout": rolled - sampled,
            "policy": prediction.policy_s,
            "physics": prediction.physics_s,
            "cost": end - rolled,
        }
        self._last = (state.time, mode)
        return self._make_plan(planned, prediction, scores, weights, verdict, mode, timings)

    def _observe(self, state: RobotState, mode: Mode, config: MpcConfig) -> PlannerState:
        """Update the observers; returns the state that all parts of the solve start from."""
        executed = self.decision.join(state.command, state.arms)
        drifts = mode is Mode.MOBILE and "drift" in config.aids
        self.drift.update(state.time, state.qpos, executed, drifts)
        learns = "offset" in config.aids
        self.offset.update(state.time, state.qpos, executed, learns=learns)
        return PlannerState(
            qpos=state.qpos,
            executed=executed,
            drift=self.drift.drift,
            offset=self.offset.offset,
            settled=self.offset.settled,
            poses=self.references.compute_poses(state.qpos),
            time=state.time,
        )

    def _warm_start(self, now: PlannerState, mode: Mode) -> None:
        """Shift the last plan by the elapsed time; after a change of mode hold the command."""
        optimizer = self._planners[mode].optimizer
        if self._last is None or self._last[1] is not mode:
            optimizer.reset(self._hold(now.executed, now, mode))
        else:
            optimizer.shift(max(0.0, now.time - self._last[0]) / POLICY_DT)

    def _hold(
        self,
        decisions: np.ndarray,
        now: PlannerState,
        mode: Mode,
        proposal: np.ndarray | None = None,
    ) -> np.ndarray:
        """Set entries that are not decision variables to their held value. (..., n)."""
        return self.command_model.hold(decisions, now.executed, mode, proposal)

    def _apply(
        self,
        verdict: Verdict,
        optimizer: SamplingOptimizer,
        commands: np.ndarray,
        now: PlannerState,
    ) -> None:
        """Apply an intervention to the plan; `commands` are those of the samples, (K, H, n)."""
        if verdict.sample is not None:
            optimizer.reset(commands[verdict.sample, 0])
        elif verdict.scale < 1.0:
            base = optimizer.commands[0] if verdict.scale > 0 else now.executed
            slowed = np.where(self.command_model.is_velocity(), verdict.scale * base, base)
            optimizer.reset(slowed)

    def _make_plan(
        self,
        planned: np.ndarray,
        prediction: Prediction,
        scores: Scores,
        weights: np.ndarray,
        verdict: Verdict,
        mode: Mode,
        timings: Mapping[str, float],
    ) -> Plan:
        """Make the `Plan` of decisions (H, n), with the prediction of the cheapest sample."""
        finite = np.isfinite(scores.costs)
        best = int(np.argmin(np.where(finite, scores.costs, np.inf)))
        names, count = self.space.names, self.decision.num_commands
        arms = [i for i in np.flatnonzero(self.command_model.acting(mode)) if i >= count]
        return Plan(
            command=planned[0, :count],
            commands=planned[:, :count],
            mode=mode,
            qpos=prediction.qpos[best],
            arms={names[i]: planned[:, i] for i in arms},
            cost={name: _finite(term[best]) for name, term in scores.terms.items()},
            health={"intervention": float(verdict.intervention), "risk": verdict.risk},
            status=Status.OK if finite.any() else Status.DIVERGED,
            effective_samples=compute_effective_samples(weights),
            timings=timings,
        )


def _find_stop(config: MpcConfig, num_samples: int) -> int | None:
    """Index of the `stop` candidate among the samples; None without one."""
    if "stop" not in config.candidates:
        return None
    stop = config.sample_plan + config.candidates.index("stop")
    return stop if stop < num_samples else None


def _finite(value: float) -> float:
    return float(value) if math.isfinite(value) else 0.0
