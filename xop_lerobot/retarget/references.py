"""Reference trajectory of a plan: reachable goal poses over the horizon, and base heading."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.state import HEAD, Goal
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.morphology.tuning import MpcConfig
from xop_lerobot.retarget.costs.balance import SupportArea
from xop_lerobot.retarget.guidance.guidance import Guidance, compute_times
from xop_lerobot.retarget.guidance.route import Footprint
from xop_lerobot.retarget.horizon_goals import hold_level, preview
from xop_lerobot.retarget.model.command_model import CommandModel, PlannerState
from xop_lerobot.retarget.model.linearisation import Readings
from xop_lerobot.retarget.obstacles import Obstacle
from xop_lerobot.retarget.posture_guide import PostureGuide, Served
from xop_lerobot.retarget.static_load import StaticLoad


class Reference(NamedTuple):
    """Reference trajectory of a plan.

    Attributes:
        goals: Goal pose of each tracked frame at `compute_times`. Shapes (H + 3, 7).
        facing: Desired heading of a wheeled base at the end, as in `Evaluation`. Shape (2,).
        served: Posture for the head's goal; None if the mode uses none.
        upright: Tracked frames of hands that are kept level.
    """

    goals: Mapping[str, np.ndarray]
    facing: np.ndarray
    served: Served | None = None
    upright: tuple[str, ...] = ()

    @property
    def balance(self) -> np.ndarray | None:
        """Desired rest position of the centre of mass on the base; None as standing. (2,)."""
        return None if self.served is None else self.served.balance

    def compute_noise_share(self, poses: Mapping[str, np.ndarray], config: MpcConfig) -> float:
        """Fraction of the full sampling noise, in proportion to the largest goal error.

        Small at the goal, where fine commands matter; zero for a braking robot, which only stops
        in its present posture.

        Args:
            poses: Present pose of each tracked frame. Shapes (7,).
            config: Parameters of the mode.
        """
        if self.served is not None and self.served.brakes:
            return 0.0
        error = 0.0
        for name, track in self.goals.items():
            pose, goal = poses[name], track[config.horizon]
            cosine = min(abs(float(goal[3:] @ pose[3:])), 1.0)  # of half the angle between them
            error = max(error, math.dist(pose[:3], goal[:3]), math.acos(cosine))
        return min(max(error / config.full_noise_error, config.min_noise), 1.0)


class References:
    """Makes the `Reference` of a plan from the operator's goal.

    Goals of hands with the upright constraint are levelled, the head's goal is limited to what
    the robot can reach (`PostureGuide`), and all goals are extended over the horizon (`Guidance`).

    Args:
        morphology: The robot.
        model: Its planning model.
        command_model: First-order model of the effect of a decision.
        support: Support area for the centre of mass; None for a robot that balances itself.
        load: Static loads of the joints; None if a policy moves them.
        obstacles: Obstacles that a wheeled base drives around.

    Attributes:
        readings: Forward kinematics of the tracked frames.
        postures: Finds the posture for a goal of the head.
        guidance: Extends goals over the horizon.
        sites: Site of each tracked frame that is followed.
        upright: Tracked frames of hands that are kept level.
    """

    def __init__(
        self,
        morphology: Morphology,
        model: mujoco.MjModel,
        command_model: CommandModel,
        support: SupportArea | None,
        load: StaticLoad | None,
        obstacles: tuple[Obstacle, ...],
    ) -> None:
        self._command_model = command_model
        self.readings = Readings(morphology, model, {})
        standing = self.readings.compute_poses(morphology.standing_qpos(), morphology.frames)
        resting = {name: float(pose[0]) for name, pose in standing.items()}
        self._footprint = Footprint(morphology, model, obstacles)
        self.postures = PostureGuide(morphology, model, command_model, support, load)
        self.guidance = Guidance(morphology, model, command_model, resting, self._footprint)
        self.sites: dict[str, str] = {}
        self.upright: tuple[str, ...] = ()

    def configure(
        self, configs: Mapping[Mode, MpcConfig], sites: Mapping[str, str], upright: tuple[str, ...]
    ) -> None:
        """Set the parameters, the tracked frames with their sites, and the hands to keep level."""
        self.sites, self.upright = dict(sites), upright
        self.postures.configure(configs, self.sites)

    def set_obstacles(self, obstacles: tuple[Obstacle, ...]) -> None:
        """Replace the obstacles to drive around."""
        self._footprint.set_obstacles(obstacles)

    def reset(self) -> None:
        """Forget previous goals and postures."""
        self.postures.reset()

    def compute_poses(self, qpos: np.ndarray) -> dict[str, np.ndarray]:
        """Poses of the tracked frames in one configuration. Shapes (7,)."""
        return self.readings.compute_poses(qpos, self.sites)

    def lead(self, state: PlannerState, goal: Goal, config: MpcConfig) -> Reference:
        """Compute the reference from `state` to `goal`."""
        goal, served = self.serve(state, hold_level(goal, self.upright), config)
        goals, facing = self.guidance.lead(state, goal, config, served)
        if served is not None:
            goals = {**goals, HEAD: served.move(goals[HEAD])}
        return Reference(goals, facing, served, self.upright)

    def serve(
        self, state: PlannerState, goal: Goal, config: MpcConfig
    ) -> tuple[Goal, Served | None]:
        """Limit the goal to what the robot can reach, and find its posture, if `config` says so."""
        used = "postures" in config.aids
        if not used or HEAD not in self.sites or HEAD not in goal.poses:
            return goal, None
        goal = self.postures.hold(goal, state, config.preview_s)
        then = preview(goal, (HEAD,), np.array([config.proposal_s]), config.preview_s)[HEAD][0]
        return goal, self.postures.find(goal, then, state)

    def detour(
        self,
        reference: Reference,
        state: PlannerState,
        proposal: np.ndarray,
        mode: Mode,
        config: MpcConfig,
    ) -> Reference:
        """Replace the goals if the posture must first move away from the goal.

        Then they are the poses along the proposal: tracking the goal itself would pull the robot
        back. Otherwise returns `reference` unchanged.
        """
        served = reference.served
        if served is None or not served.detour:
            return reference
        mode = Mode.MOBILE if served.brakes else mode  # a base that brakes still moves
        places = [
            self._command_model.extrapolate(state.start, proposal, float(ahead), mode)
            for ahead in compute_times(config)
        ]
        sites = {name: self.sites[name] for name in reference.goals}
        return reference._replace(goals=self.readings.place(np.array(places), sites).poses)
