"""The model predictive controller: KMPPI over MuJoCo with the low-level policy in the loop."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from time import perf_counter

import mujoco
import numpy as np

from xop_lerobot.command import Mode
from xop_lerobot.low_level.policy import POLICY_DT, LowLevelPolicy
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.retarget.command_model import CommandModel
from xop_lerobot.retarget.config import MpcConfig, RetargeterConfig
from xop_lerobot.retarget.costs import (
    CollisionCost,
    ControlCost,
    Cost,
    Evaluation,
    FallCost,
    LateralCost,
    StanceCost,
    SupportArea,
    SupportCost,
    TerminalCost,
    TrackingCost,
)
from xop_lerobot.retarget.costs.collision import Obstacle, make_obstacles
from xop_lerobot.retarget.drift import DriftObserver
from xop_lerobot.retarget.kinematics import SiteKinematics
from xop_lerobot.retarget.kmppi import Kmppi, Samples, compute_effective_samples
from xop_lerobot.retarget.plan import Plan, Retargeter, Status
from xop_lerobot.retarget.proposal import KinematicProposal, make_proposal_weights
from xop_lerobot.retarget.rollout import PolicyRollout, Prediction
from xop_lerobot.state import Goal, RobotState
from xop_lerobot.transforms import make_pose, quat_exp, quat_multiply, rotation_error

_SLOW = 0.3  # speed up to which a base on wheels need not face where it goes [m/s]


class MpcRetargeter(Retargeter):
    r"""Solves Eq. 1: :math:`\min_{a_0 \dots a_{H-1}} \sum_k l(x_k, a_k, G) + V_f(x_H, G)`.

    Each solve shifts the last plan by the time that has passed, adds three fixed candidates (the
    kinematic proposal, the command being executed, the neutral command) to antithetic samples
    around it, rolls all out in MuJoCo with the low-level policy and its memory in the loop, and
    moves the plan to the weighted mean.

    Args:
        morphology: The robot.
        policy: Its low-level policy.
        model: Its planning model in the scene.
        config: Settings; zeros take the robot's own parameters.
        frames: Tracked frames that the commands shall follow.
        obstacles: What to keep clear of; by default what is fixed in `model`.
    """

    def __init__(
        self,
        morphology: Morphology,
        policy: LowLevelPolicy,
        model: mujoco.MjModel,
        config: RetargeterConfig | None = None,
        frames: tuple[str, ...] = ("head",),
        obstacles: tuple[Obstacle, ...] | None = None,
    ) -> None:
        config = config or RetargeterConfig()
        self.morphology, self.frames = morphology, frames
        self.space = morphology.command_space
        self.configs = {mode: _override(morphology.mpc_config(mode), config) for mode in Mode}
        self.rollout = PolicyRollout(model, policy, config.num_threads)
        self.command_model = CommandModel(model, self.space, morphology.effects, morphology.pivot)
        self.sites = {name: morphology.frames[name] for name in frames}
        obstacles = make_obstacles(model) if obstacles is None else obstacles
        hull = morphology.hull_points if obstacles else {}
        self._hull = tuple(hull)
        self._points = tuple(dict.fromkeys((*morphology.contact_points, *hull)))
        self.kinematics = SiteKinematics(
            model,
            (*self.sites.values(), *self._points),
            com_of=morphology.base_body if morphology.support else None,
        )
        self.support = None
        if morphology.support:
            resting = self.kinematics.compute_com(morphology.standing_qpos())
            self.support = SupportArea(morphology.support, tuple(resting[:2]))
        self.proposals = {
            mode: KinematicProposal(
                self.command_model,
                self.kinematics,
                self.sites,
                make_proposal_weights(each.weights),
                self.support,
            )
            for mode, each in self.configs.items()
        }
        standing_height = float(morphology.standing_qpos()[2])
        self.costs: tuple[Cost, ...] = (
            TrackingCost(),
            TerminalCost(),
            StanceCost(morphology.contact_groups, morphology.wheeled),
            CollisionCost(obstacles, hull),
            ControlCost((self.space.high - self.space.low) / 2),
            SupportCost(self.support),
            LateralCost(self.command_model.is_nonholonomic),
            FallCost(morphology.fall_tilt, morphology.fall_height, standing_height),
        )
        self.cost_names = tuple(cost.name for cost in self.costs)
        self._rng = np.random.default_rng(config.seed)
        self._seed = config.seed
        self._planners = {
            mode: Kmppi(self.configs[mode].horizon, self.space.low, self.space.high, each)
            for mode, each in self.configs.items()
        }
        for each in self.configs.values():
            for name in each.noise_std:
                self.space.index(name)  # a misspelt name must not mean no noise
        self._noise = {
            mode: np.array([each.noise_std.get(name, 0.0) for name in self.space.names])
            * self.command_model.acting(mode)
            for mode, each in self.configs.items()
        }
        self.drift = DriftObserver(self.command_model)
        self._last: tuple[float, Mode] | None = None

    def control_period(self, mode: Mode) -> float:
        """Time between two plans in `mode` [s]."""
        return 1 / self.configs[mode].control_hz

    def close(self) -> None:
        """Stop the threads."""
        self.rollout.close()

    def reset(self, state: RobotState) -> None:
        """Start anew from the command that `state` executes, with the seed's first samples."""
        self._rng = np.random.default_rng(self._seed)
        self._last = None
        self.drift.reset()
        for planner in self._planners.values():
            planner.reset(state.command)

    def plan(self, state: RobotState, goal: Goal) -> Plan:
        """Compute the plan from `state` towards `goal`."""
        start = perf_counter()
        mode, config, planner = goal.mode, self.configs[goal.mode], self._planners[goal.mode]
        self._warm_start(state, mode)
        self.drift.update(state.time, state.qpos, state.command, mode is Mode.MOBILE)
        goal = self._hold_near(state, goal, config.reach)
        ahead = np.arange(config.horizon + 1) * POLICY_DT
        goals = self._preview(goal, ahead, config)
        then = self._preview(goal, np.array([config.proposal_s]), config)
        wanted = self._compute_wanted_velocity(state, then, config)
        proposal = self.proposals[mode].solve(
            state.qpos,
            {name: poses[0] for name, poses in then.items()},
            mode,
            config.proposal_s,
            start=planner.commands[0],
            drift=self.drift.drift,
            executed=state.command,
            wanted_velocity=wanted,
        )
        if not np.isfinite(proposal).all():
            proposal = state.command
        candidates = np.stack([proposal, state.command, self.space.neutral])
        acting = self.command_model.acting(mode)
        candidates = np.where(acting, candidates, self.space.neutral)
        noise = self._noise[mode] * self._noise_share(state, goals, config)
        samples = planner.sample(self._rng, noise, candidates)
        sampled = perf_counter()

        prediction = self.rollout.predict(
            state.qpos,
            state.qvel,
            state.memory,
            self._limit_rates(state.command, samples.commands),
            state.arms,
            mode,
        )
        rolled = perf_counter()
        with np.errstate(invalid="ignore"):  # a diverged sample is NaN, and weighs nothing
            terms = self._evaluate(prediction, samples, goals, goal, proposal, wanted, config)
        costs = np.sum(list(terms.values()), axis=0)
        weights = planner.update(samples, costs)
        best = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
        end = perf_counter()

        self._last = (state.time, mode)
        return Plan(
            command=planner.commands[0],
            commands=planner.commands,
            mode=mode,
            qpos=prediction.qpos[best],
            cost={name: float(np.nan_to_num(term[best])) for name, term in terms.items()},
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

    def _warm_start(self, state: RobotState, mode: Mode) -> None:
        """Shift the last plan by the time that has passed, or start from the executed command."""
        planner = self._planners[mode]
        if self._last is None or self._last[1] is not mode:
            acting = self.command_model.acting(mode)
            planner.reset(np.where(acting, state.command, self.space.neutral))
        else:
            planner.shift(max(0.0, state.time - self._last[0]) / POLICY_DT)

    def _hold_near(self, state: RobotState, goal: Goal, reach: float) -> Goal:
        """Move goals that are further than `reach` [m] aside of their frame up to that distance."""
        poses = self.kinematics.compute_poses(state.qpos, tuple(self.sites.values()))
        near = dict(goal.poses)
        for name in self.frames:
            if name in near:
                position = poses[self.sites[name]][:3]
                offset = near[name][:3] - position
                share = min(1.0, reach / max(float(np.linalg.norm(offset[:2])), 1e-9))
                held = position + np.array([share, share, 1.0]) * offset
                near[name] = make_pose(held, near[name][3:])
        return dataclasses.replace(goal, poses=near)

    def _preview(self, goal: Goal, ahead: np.ndarray, config: MpcConfig) -> dict[str, np.ndarray]:
        """Goals `ahead` seconds from now, at constant velocity up to `preview_s`."""
        times = np.minimum(ahead, config.preview_s)[:, None]
        goals = {}
        for name in self.frames:
            if name not in goal.poses:
                continue
            pose, velocity = goal.poses[name], goal.velocities.get(name, np.zeros(6))
            position = pose[:3] + times * velocity[:3]
            quat = quat_multiply(quat_exp(times * velocity[3:]), pose[3:])
            goals[name] = make_pose(position, quat)
        return goals

    def _limit_rates(self, executed: np.ndarray, commands: np.ndarray) -> np.ndarray:
        """What the robot will make of command sequences. Shapes (k,), (K, H, k)."""
        step = self.space.max_rate * POLICY_DT
        limited = np.empty_like(commands)
        for k in range(commands.shape[1]):
            executed = np.clip(commands[:, k], executed - step, executed + step)
            limited[:, k] = executed
        return limited

    def _compute_wanted_velocity(
        self, state: RobotState, then: Mapping[str, np.ndarray], config: MpcConfig
    ) -> np.ndarray:
        """Velocity that takes the first tracked frame to its goal in time, less a slow one.

        At rest the base need not face the last centimetres: they are turned into, not driven.

        Returns:
            Velocity in the world [m/s]. Shape (2,).
        """
        for name, poses in then.items():
            site = self.sites[name]
            here = self.kinematics.compute_positions(state.qpos, (site,))[site]
            velocity = (poses[0, :2] - here[:2]) / config.proposal_s
            speed = float(np.linalg.norm(velocity))
            return velocity * max(0.0, 1 - _SLOW / max(speed, 1e-9))
        return np.zeros(2)

    def _noise_share(
        self, state: RobotState, goals: Mapping[str, np.ndarray], config: MpcConfig
    ) -> float:
        """Share of the full noise: little at the goal, where fine commands are what counts."""
        poses = self.kinematics.compute_poses(state.qpos, tuple(self.sites.values()))
        error = 0.0
        for name, goal in goals.items():
            pose = poses[self.sites[name]]
            turn = np.linalg.norm(rotation_error(goal[-1, 3:], pose[3:]))
            error = max(error, np.linalg.norm(pose[:3] - goal[-1, :3]), 0.5 * turn)
        return float(np.clip(error / config.full_noise_error, config.min_noise, 1.0))

    def _evaluate(
        self,
        prediction: Prediction,
        samples: Samples,
        goals: Mapping[str, np.ndarray],
        goal: Goal,
        reference: np.ndarray,
        wanted: np.ndarray,
        config: MpcConfig,
    ) -> dict[str, np.ndarray]:
        """Cost of every sample by term. Shapes (K,)."""
        sites = {name: self.sites[name] for name in goals}
        extrapolated = self.command_model.extrapolate(
            prediction.qpos[:, -1],
            samples.commands[:, -1],
            config.extrapolation_s,
            goal.mode,
            self.drift.drift,
            executed=prediction.commands[:, -1],
        )
        names, supported = tuple(sites.values()), self.support is not None
        then = self.kinematics.compute_bodies(extrapolated, (*names, *self._hull), com=supported)
        ahead = self.kinematics.compute_bodies(
            prediction.qpos, (*names, *self._points), com=supported
        )
        terminal, poses = then.compute_poses(names), ahead.compute_poses(names)
        last = config.horizon * POLICY_DT + config.extrapolation_s
        evaluation = Evaluation(
            qpos=prediction.qpos,
            qvel=prediction.qvel,
            commands=samples.commands,
            reference=reference,
            poses={name: poses[site] for name, site in sites.items()},
            points=ahead.compute_positions(self._points),
            terminal_points=then.compute_positions(self._hull),
            com=ahead.compute_com() if supported else np.zeros(0),
            terminal_qpos=extrapolated,
            terminal_com=then.compute_com() if supported else np.zeros(0),
            goals=goals,
            terminal_poses={name: terminal[site] for name, site in sites.items()},
            terminal_goals={
                name: poses[0] for name, poses in self._preview(goal, _at(last), config).items()
            },
            wanted_velocity=wanted,
            mode=goal.mode,
            dt=POLICY_DT,
            weights=config.weights,
        )
        return {cost.name: cost.compute(evaluation) for cost in self.costs}


def _at(time: float) -> np.ndarray:
    return np.array([time])


def _override(config: MpcConfig, settings: RetargeterConfig) -> MpcConfig:
    """Apply what the user set; zeros leave the robot's own parameter."""
    wanted = {
        name: getattr(settings, name)
        for name in ("num_samples", "horizon", "control_hz")
        if getattr(settings, name)
    }
    return dataclasses.replace(config, **wanted)
