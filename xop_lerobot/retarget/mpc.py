"""The model predictive controller: KMPPI over MuJoCo with the low-level policy in the loop."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
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
from xop_lerobot.retarget.costs import CollisionCost, FallCost, SupportArea, make_costs
from xop_lerobot.retarget.costs.cost import Cost, Evaluation
from xop_lerobot.retarget.decision import DecisionSpace
from xop_lerobot.retarget.guidance.guidance import Guidance, compute_times
from xop_lerobot.retarget.guidance.route import Footprint
from xop_lerobot.retarget.horizon_goals import hold_level, preview
from xop_lerobot.retarget.kmppi import compute_effective_samples
from xop_lerobot.retarget.model.command_model import CommandModel
from xop_lerobot.retarget.model.linearisation import Readings, find_sites_on
from xop_lerobot.retarget.model.observers import DriftObserver, OffsetObserver
from xop_lerobot.retarget.obstacles import Obstacle, make_obstacles
from xop_lerobot.retarget.optimizer import SamplingOptimizer, build_optimizer
from xop_lerobot.retarget.plan import Plan, Retargeter, Status
from xop_lerobot.retarget.posture_guide import HEAD, PostureGuide, Served
from xop_lerobot.retarget.rollout import PolicyRollout, Prediction


class MpcRetargeter(Retargeter):
    r"""Solves Eq. 1: :math:`\min_{a_0 \dots a_{H-1}} \sum_k l(x_k, a_k, G) + V_f(x_H, G)`.

    Each solve shifts the last plan by the time that has passed, adds fixed candidates (the
    kinematic proposal, the command being executed, a stop) to samples around it, rolls all out
    in MuJoCo with the low-level policy and its memory in the loop, and moves the plan to the
    weighted mean. `configure` changes settings between two solves, from any thread.

    Args:
        morphology: The robot.
        policy: Its low-level policy.
        model: Its planning model in the scene.
        config: Settings; zeros take the robot's own parameters.
        targets: Tracked frames to follow; None takes those of `config`.
        obstacles: What to keep clear of; by default what is fixed in `model`.
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
        self.rollout = PolicyRollout(model, policy, config.num_threads)
        self.command_model = CommandModel(
            model, self.space, self.decision.effects, morphology.pivot, morphology.rest
        )
        self.drift = DriftObserver(self.command_model, lag_s=morphology.velocity_lag_s)
        # A servo at its limit may be far from its command, and the rest of the torso has to know;
        # a policy that is far from it is on its way.
        largest = 1.0 if morphology.wheeled else 0.2
        self.offset = OffsetObserver(self.command_model, largest=largest)
        hull = morphology.hull_points
        self._collision = CollisionCost(
            make_obstacles(model) if obstacles is None else obstacles,
            hull,
            hands=morphology.hull_hands,
            base=find_sites_on(model, morphology.base_body, hull),
        )
        self._model = model
        self.readings = Readings(morphology, model, hull if self._collision.obstacles else {})
        self.support = None
        if morphology.support:
            resting = self.readings.compute_com(morphology.standing_qpos())
            self.support = SupportArea(morphology.support, tuple(resting[:2]))
        standing = self.readings.compute_poses(morphology.standing_qpos(), morphology.frames)
        resting = {name: float(pose[0]) for name, pose in standing.items()}
        self._footprint = Footprint(morphology, model, self._collision.obstacles.obstacles)
        self._guidance = Guidance(morphology, self.command_model, resting, self._footprint)
        self._postures = PostureGuide(morphology, model, self.command_model, self.support)
        self.candidates = Candidates(
            morphology,
            self.rollout.model,
            self.decision,
            self.command_model,
            self.offset,
            self.support,
            self._postures.load,
        )
        height = float(morphology.standing_qpos()[2])
        self._fall = FallCost(
            morphology.fall_tilt,
            morphology.fall_height,
            height,
            self.command_model.find_lowest_height(),
            self.command_model.compute_rest_tilt,
        )
        self.costs: tuple[Cost, ...] = make_costs(
            morphology,
            self.command_model,
            self.support,
            self._collision,
            self._fall,
            self._postures.load,
        )
        self.cost_names = tuple(cost.name for cost in self.costs)
        self._rng = np.random.default_rng(config.seed)
        self._seed = config.seed
        self._lock = RLock()
        self._last: tuple[float, Mode] | None = None
        self.configs: dict[Mode, MpcConfig] = {}
        self._planners: dict[Mode, SamplingOptimizer] = {}
        self._noise: dict[Mode, np.ndarray] = {}
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
        """Change settings from the next solve on; None leaves them. All or nothing.

        The plan goes on: other weights or samples move it, and the rate limits hold.

        Args:
            configs: Parameters of the modes that change.
            targets: Tracked frames to follow.
            body: Commands and arm joints that may be moved for them; empty: all commands.
            constraints: Constraints that hold, such as ``"upright"``.

        Raises:
            UnknownName: If a target, an entry or a constraint is not known; lists those that are.
        """
        with self._lock:
            new = {**self.configs, **(configs or {})}
            frames = self.morphology.frames
            for name in targets or ():
                if name not in frames:
                    raise UnknownName("tracked frame", name, frames)
            for name in constraints or ():
                if name not in CONSTRAINTS:
                    raise UnknownName("constraint", name, CONSTRAINTS)
            mask = self.command_model.body if body is None else self.decision.make_mask(body)
            noise = {mode: self._make_noise(each) for mode, each in new.items()}
            planners = {mode: self._renew(mode, each) for mode, each in new.items()}

            self.configs, self._noise, self._planners = new, noise, planners
            if targets is not None:
                self.frames = targets
                self.sites = {name: frames[name] for name in targets}
            if body is not None and not np.array_equal(mask, self.command_model.body):
                self.command_model.body, self._last = mask, None
            if constraints is not None:
                self.constraints = constraints
            self._postures.configure(new, self.sites)
            self.candidates.configure(new, self.sites, bool(self._find_upright()))

    def _make_noise(self, config: MpcConfig) -> np.ndarray:
        """Standard deviation of every entry; a misspelt name must not mean no noise. (n,)."""
        noise = np.zeros(len(self.space))
        for name, value in config.noise_std.items():
            noise[self.space.index(name)] = value
        return noise

    def _renew(self, mode: Mode, config: MpcConfig) -> SamplingOptimizer:
        """The optimizer for a configuration: the present one, or one that holds its command."""
        old = self.configs.get(mode)
        if old is not None and replace(old, weights=config.weights) == config:
            return self._planners[mode]
        planner = build_optimizer(config.horizon, self.space.low, self.space.high, config)
        if old is not None:
            planner.reset(self._planners[mode].commands[0])
        return planner

    def set_obstacles(self, obstacles: tuple[Obstacle, ...]) -> None:
        """Keep clear of these and no others from the next solve on."""
        with self._lock:
            self._collision.set_obstacles(obstacles)
            self._footprint.set_obstacles(obstacles)
            # Without obstacles the hull is not read, which saves time.
            hull = self.morphology.hull_points if obstacles else {}
            self.readings = Readings(self.morphology, self._model, hull)

    def control_period(self, mode: Mode) -> float:
        """Time between two plans in `mode` [s]."""
        return 1 / self.configs[mode].control_hz

    def close(self) -> None:
        """Stop the threads."""
        self.rollout.close()

    def reset(self, state: RobotState) -> None:
        """Start anew from the command that `state` executes, with the seed's first samples."""
        with self._lock:
            self._rng = np.random.default_rng(self._seed)
            self._last = None
            self.candidates.reset()
            self._guidance.reset()
            self._postures.reset()
            self.drift.reset()
            self.offset.reset(self.decision.join(state.command, state.arms))
            for planner in self._planners.values():
                planner.reset(self.decision.join(state.command, state.arms))

    def plan(self, state: RobotState, goal: Goal) -> Plan:
        """Compute the plan from `state` towards `goal`."""
        with self._lock:
            return self._solve(state, goal)

    def _solve(self, state: RobotState, goal: Goal) -> Plan:
        start = perf_counter()
        mode, config, planner = goal.mode, self.configs[goal.mode], self._planners[goal.mode]
        executed = self.decision.join(state.command, state.arms)
        acting = self.command_model.acting(mode)
        held = self._compute_held(executed, mode)
        self._warm_start(np.where(acting, executed, held), state.time, mode)
        observes = config.observe_drift
        self.drift.update(state.time, state.qpos, executed, observes and mode is Mode.MOBILE)
        self.offset.update(state.time, state.qpos, executed, learns=observes)
        drift = self.drift.drift
        poses = self.readings.compute_poses(state.qpos, self.sites)
        goal = hold_level(goal, self._find_upright())
        goal, served = self._serve(state.qpos, executed, goal, config)
        goals, facing = self._guidance.lead(
            state.qpos, executed, poses, goal, config, state.time, served
        )
        if served is not None:
            goals = {**goals, HEAD: served.move(goals[HEAD])}
        then = {name: track[-1:] for name, track in goals.items()}
        proposal = self.candidates.propose(
            state,
            then,
            mode,
            config,
            start=planner.commands[0],
            executed=executed,
            drift=drift,
            facing=facing,
            served=served,
        )
        proposal = np.where(acting, proposal, held)
        if served is not None and served.detour:
            moving = Mode.MOBILE if served.brakes else mode  # a base that brakes still moves
            goals = self._lead_along(proposal, state.qpos, goals, moving, config, executed, drift)
        candidates = self.candidates.collect(state, goal, executed, proposal, config)
        candidates = np.where(acting, candidates, held)
        noise = self._noise[mode] * acting * _compute_noise_share(poses, goals, config, served)
        samples = planner.sample(self._rng, noise, candidates)
        commands = self._restrict(np.where(acting, samples.commands, held), mode)
        sampled = perf_counter()

        limited = self.command_model.limit_rates(executed, commands, mode, POLICY_DT)
        prediction = self._predict(state, limited, mode)
        rolled = perf_counter()
        with np.errstate(invalid="ignore"):  # a diverged sample is NaN, and weighs nothing
            evaluation = self._evaluate(
                prediction,
                commands,
                mode,
                goals,
                executed,
                proposal,
                facing,
                drift,
                config,
                None if served is None else served.balance,
            )
            terms = {cost.name: cost.compute(evaluation) for cost in self.costs}
        costs = np.sum(list(terms.values()), axis=0)
        weights = planner.update(samples, costs)  # which adds the samples' own penalty
        stop = None  # the index of the sample that stops: candidates follow the plan
        if "stop" in config.candidates:
            stop = config.sample_plan + config.candidates.index("stop")
            stop = stop if stop < len(costs) else None
        falls = self._fall.find_falls(evaluation) | ~np.isfinite(costs)
        touches = self._collision.find_touches(evaluation)
        verdict = judge(weights, costs, falls, touches, stop)
        planned = self._apply(verdict, planner, samples.commands, executed)
        planned = self._restrict(np.where(acting, planned, held), mode)
        best = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
        end = perf_counter()

        self._last = (state.time, mode)
        count = self.decision.num_commands
        names = self.space.names
        return Plan(
            command=planned[0, :count],
            commands=planned[:, :count],
            mode=mode,
            qpos=prediction.qpos[best],
            velocities=prediction.qvel[best, :, :3],
            arms={names[i]: planned[:, i] for i in np.flatnonzero(acting) if i >= count},
            cost={name: _finite(term[best]) for name, term in terms.items()},
            health={"intervention": float(verdict.intervention), "risk": verdict.risk},
            status=Status.OK if np.isfinite(costs).any() else Status.DIVERGED,
            effective_samples=compute_effective_samples(weights),
            timings={
                "solve": end - start,
                "proposal": sampled - start,
                "rollout": rolled - sampled,
                "policy": prediction.policy_s,
                "physics": prediction.physics_s,
                "cost": end - rolled,
            },
        )

    def _serve(
        self, qpos: np.ndarray, executed: np.ndarray, goal: Goal, config: MpcConfig
    ) -> tuple[Goal, Served | None]:
        """The goal where the robot can serve it, and the posture for it."""
        if HEAD not in self.sites or HEAD not in goal.poses:
            return goal, None
        offset, settled = self.offset.offset, self.offset.settled
        goal = self._postures.hold(goal, qpos, executed, offset, settled, config.preview_s)
        then = preview(goal, (HEAD,), np.array([config.proposal_s]), config.preview_s)[HEAD][0]
        return goal, self._postures.find(goal, then, qpos, executed, offset, settled)

    def _lead_along(
        self,
        command: np.ndarray,
        qpos: np.ndarray,
        goals: Mapping[str, np.ndarray],
        mode: Mode,
        config: MpcConfig,
        executed: np.ndarray,
        drift: np.ndarray,
    ) -> dict[str, np.ndarray]:
        """Goals where a command takes the tracked frames. Shapes (H + 3, 7)."""
        places = [
            self.command_model.extrapolate(
                qpos,
                command,
                float(ahead),
                mode,
                drift,
                executed=executed,
                offset=self.offset.offset,
                settled=self.offset.settled,
            )
            for ahead in compute_times(config)
        ]
        sites = {name: self.sites[name] for name in goals}
        return dict(self.readings.place(np.array(places), sites).poses)

    def _find_upright(self) -> tuple[str, ...]:
        """Targets that are hands to be kept level."""
        hands = {arm.frame for arm in self.morphology.arms}
        return tuple(hands & set(self.sites)) if "upright" in self.constraints else ()

    def _compute_held(self, executed: np.ndarray, mode: Mode) -> np.ndarray:
        """What entries do that are not decided: nothing; the rest of the body stays. (n,)."""
        stays = ~self.command_model.body & ~self.command_model.is_velocity()
        return np.where(stays, executed, self.space.neutral)

    def _warm_start(self, executed: np.ndarray, time: float, mode: Mode) -> None:
        """Shift the last plan by the time that has passed, or start from the executed command."""
        planner = self._planners[mode]
        if self._last is None or self._last[1] is not mode:
            planner.reset(executed)
        else:
            planner.shift(max(0.0, time - self._last[0]) / POLICY_DT)

    def _restrict(self, commands: np.ndarray, mode: Mode) -> np.ndarray:
        """What of commands the mode, the bounds and the policy's dead zones leave. (..., k)."""
        return self.space.restrict(self.space.leave_dead_zones(commands, mode), mode)

    def _predict(self, state: RobotState, decisions: np.ndarray, mode: Mode) -> Prediction:
        """Roll decisions out. Shape (K, H, n)."""
        commands, arms = self.decision.split(decisions, state.arms, self.command_model.body)
        executed = (state.command, state.arms, state.mode) if self.morphology.ramps else None
        prediction = self.rollout.predict(
            state.qpos, state.qvel, state.memory, commands, arms, mode, executed
        )
        return prediction._replace(commands=decisions)

    def _evaluate(
        self,
        prediction: Prediction,
        commands: np.ndarray,
        mode: Mode,
        goals: Mapping[str, np.ndarray],
        executed: np.ndarray,
        proposal: np.ndarray,
        facing: np.ndarray,
        drift: np.ndarray,
        config: MpcConfig,
        balance: np.ndarray | None,
    ) -> Evaluation:
        """All that the cost terms are computed from."""
        references = {
            "proposal": proposal,
            "neutral": self.space.neutral,
            "zero": np.zeros(len(executed)),
        }
        decided = self.command_model.acting(mode)
        reference = np.where(decided, references[config.control_reference], commands[0, 0])
        extrapolated = self.command_model.extrapolate(
            prediction.qpos[:, -1],
            commands[:, -1],
            config.extrapolation_s,
            mode,
            drift,
            executed=prediction.commands[:, -1],
            offset=self.offset.offset,
            settled=self.command_model.settle(
                self.offset.settled, commands[:, -1], config.horizon * POLICY_DT
            ),
        )
        sites = {name: site for name, site in self.sites.items() if name in goals}
        end = config.horizon + 1
        now = self.readings.read(prediction.sensordata, sites)
        then = self.readings.place(extrapolated, sites)
        return Evaluation(
            qpos=prediction.qpos,
            qvel=prediction.qvel,
            commands=commands,
            executed=executed,
            reference=reference,
            poses=now.poses,
            points=now.points,
            velocities=now.velocities,
            com=now.com,
            terminal_qpos=extrapolated,
            terminal_poses=then.poses,
            terminal_points=then.points,
            terminal_com=then.com,
            goals={name: poses[:end] for name, poses in goals.items()},
            terminal_goals={name: poses[end] for name, poses in goals.items()},
            facing=facing,
            mode=mode,
            dt=POLICY_DT,
            weights=config.weights,
            upright=tuple(name for name in self._find_upright() if name in sites),
            drives=bool((decided & self.command_model.is_velocity()).any()),
            balance=balance,
        )

    def _apply(
        self,
        verdict: Verdict,
        planner: SamplingOptimizer,
        commands: np.ndarray,
        executed: np.ndarray,
    ) -> np.ndarray:
        """The plan after the verdict on it. Shape (H, n)."""
        if verdict.sample is not None:
            planner.reset(commands[verdict.sample, 0])
        elif verdict.scale < 1.0:
            base = planner.commands[0] if verdict.scale > 0 else executed
            slowed = np.where(self.command_model.is_velocity(), verdict.scale * base, base)
            planner.reset(slowed)
        return planner.commands


def _finite(value: float) -> float:
    return float(value) if math.isfinite(value) else 0.0


def _compute_noise_share(
    poses: Mapping[str, np.ndarray],
    goals: Mapping[str, np.ndarray],
    config: MpcConfig,
    served: Served | None,
) -> float:
    """Share of the full noise: little at the goal, where fine commands are what counts.

    None for a robot that brakes: it does nothing but stop, in the posture it has.

    Args:
        poses: Tracked frames now. Shapes (7,).
        goals: Their goals at `compute_times`. Shapes (H + 3, 7).
        config: Parameters of the mode.
        served: The posture for the head's goal, None where there is none.
    """
    if served is not None and served.brakes:
        return 0.0
    error = 0.0
    for name, track in goals.items():
        pose, goal = poses[name], track[config.horizon]
        cosine = min(abs(float(goal[3:] @ pose[3:])), 1.0)  # of half the angle
        error = max(error, math.dist(pose[:3], goal[:3]), math.acos(cosine))
    return min(max(error / config.full_noise_error, config.min_noise), 1.0)
