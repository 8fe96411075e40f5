"""Reference trajectory over the horizon: goal poses of each step and desired base heading.

`Guidance` is the entry point; `FacingRule` gives the heading of a base that follows a moving goal.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import mujoco
import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.state import HEAD, Goal
from xop_lerobot.core.transforms import compute_heading, quat_from_yaw, quat_multiply, quat_yaw
from xop_lerobot.low_level.policy import POLICY_DT
from xop_lerobot.morphology.effect import Acts
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.morphology.tuning import MpcConfig
from xop_lerobot.retarget.costs.balance import compute_facing
from xop_lerobot.retarget.guidance.route import Footprint, RoutePlanner
from xop_lerobot.retarget.horizon_goals import hold_near, is_moving, preview
from xop_lerobot.retarget.model.command_model import CommandModel, PlannerState
from xop_lerobot.retarget.posture_guide import Served


class FacingRule:
    """Desired base heading for the first target; see `compute_facing`.

    Args:
        morphology: The robot.
        resting: Forward distance of each tracked frame from the base at rest [m].
    """

    def __init__(self, morphology: Morphology, resting: Mapping[str, float]) -> None:
        self._pivot, self._resting = morphology.pivot, dict(resting)
        self._max_twist = morphology.driving.arrival_twist if morphology.driving else math.pi
        self._hands = {arm.frame for arm in morphology.arms}

    def compute(
        self,
        state: PlannerState,
        then: Mapping[str, np.ndarray],
        dt: float,
        ahead: Mapping[str, float] | None = None,
    ) -> np.ndarray:
        """Compute the desired base heading.

        Hand targets have no gaze direction, so the present heading is kept for them.

        Args:
            state: The planner's state.
            then: Goal of each tracked frame in `dt`. Shapes (1, 7).
            dt: Time to reach the goals [s].
            ahead: Forward distances of frames from the base at their goals, where they differ
                from those at rest [m].

        Returns:
            Direction in the world, whose length is its weight. Shape (2,).
        """
        qpos, pivot = state.qpos, self._pivot
        heading = float(quat_yaw(qpos[3:7]))
        for name, goals in then.items():
            missing = goals[0, :2] - state.poses[name][:2]
            velocity, look = missing / dt, heading
            if name not in self._hands:
                look = float(compute_heading(goals[0, 3:]))
                resting = (ahead or {}).get(name, self._resting[name])
                end = goals[0, :2] + (pivot - resting) * _direction(look)
                velocity = (end - qpos[:2] - pivot * _direction(heading)) / dt
            speed = float(np.hypot(*missing)) / dt
            return compute_facing(heading, velocity, look, speed, self._max_twist)
        return np.zeros(2)


def _direction(heading: float) -> np.ndarray:
    """Unit vector of a heading. Shape (2,)."""
    return np.array([np.cos(heading), np.sin(heading)])


_UPRIGHT = 0.9  # cosine to the vertical from which a joint axis counts as vertical


def find_waist_axis(morphology: Morphology, model: mujoco.MjModel) -> float:
    """Forward distance of the waist from the base of a standing robot [m].

    That is the uppermost vertical joint that carries the arms: a neck turns the head alone.
    """
    data = mujoco.MjData(model)
    data.qpos[: len(morphology.standing_qpos())] = morphology.standing_qpos()
    mujoco.mj_kinematics(model, data)
    carriers, body = set(), int(model.joint(morphology.arms[0].joints[0]).bodyid[0])
    while body:
        carriers.add(body)
        body = int(model.body_parentid[body])
    joints = [model.joint(each.joint).id for each in morphology.effects if each.acts is Acts.JOINT]
    upright = [
        joint
        for joint in joints
        if data.xaxis[joint, 2] > _UPRIGHT and int(model.jnt_bodyid[joint]) in carriers
    ]
    return float(data.xanchor[upright[-1], 0]) if upright else 0.0


_LOOK_AHEAD = 1.6  # least duration of a simulated path: about a quarter turn [s]


class Guidance:
    """Extends the present goal to a reference trajectory over the horizon.

    For a nonholonomic base, a stationary goal is reached along a simulated path (`RoutePlanner`),
    whose poses are the reference. A moving goal is followed directly, with the base heading of
    `FacingRule`: a path that ends at the goal would always be late. For all other robots, and if
    the base is not driven, the goal is only limited in distance and extrapolated.

    Args:
        morphology: The robot.
        model: Its planning model.
        command_model: Command model; tells whether the base is nonholonomic.
        resting: Forward distance of each tracked frame from the base at rest [m].
        footprint: Clearance of the base from obstacles.
    """

    def __init__(
        self,
        morphology: Morphology,
        model: mujoco.MjModel,
        command_model: CommandModel,
        resting: Mapping[str, float],
        footprint: Footprint | None = None,
    ) -> None:
        self._command_model = command_model
        self._facing = FacingRule(morphology, resting)
        self._routes: RoutePlanner | None = None
        if command_model.is_nonholonomic:
            axis = find_waist_axis(morphology, model)
            self._routes = RoutePlanner(morphology, resting, footprint, axis)

    def lead(
        self,
        state: PlannerState,
        goal: Goal,
        config: MpcConfig,
        served: Served | None = None,
    ) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Compute the goals at `compute_times`, and the desired base heading at their end.

        Args:
            state: The planner's state, with the executed decision.
            goal: Present goal.
            config: Parameters of the mode.
            served: Posture for the head's goal; None if there is none.

        Returns:
            Poses, shapes (H + 3, 7), and the heading as a direction in the world whose length is
            its weight; zero for none. Shape (2,).
        """
        times, poses = compute_times(config), state.poses
        ahead = {} if served is None else {HEAD: served.ahead}
        name = next((name for name in poses if name in goal.poses), None)
        drives = name is not None and "route" in config.aids and self._drives(goal.mode)
        if name is not None and drives and not is_moving(goal, name):
            return self._lead_along_route(state, goal, name, times, config, ahead)
        near = hold_near(goal, poses, config.reach)
        goals = preview(near, tuple(poses), times, config.preview_s)
        if not drives:
            return goals, np.zeros(2)
        then = {each: track[-1:] for each, track in goals.items()}
        return goals, self._facing.compute(state, then, config.proposal_s, ahead)

    def _drives(self, mode: Mode) -> bool:
        """Whether the free entries drive a nonholonomic base in `mode`."""
        free = self._command_model.acting(mode).astype(float)
        return (
            self._command_model.is_nonholonomic and self._command_model.compute_twist(free)[0] > 0
        )

    def _lead_along_route(
        self,
        state: PlannerState,
        goal: Goal,
        name: str,
        times: np.ndarray,
        config: MpcConfig,
        ahead: Mapping[str, float],
    ) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Goals along the base's path to the goal of the frame `name`; others shift with it."""
        assert self._routes is not None
        poses = state.poses
        twist = self._command_model.compute_twist(state.executed)
        route = self._routes.plan(
            state.qpos,
            (float(twist[0]), float(twist[2])),
            name,
            poses[name],
            goal.poses[name],
            duration=max(_LOOK_AHEAD, float(times[-2:].max())),
            turn_rate=float(goal.velocities[name][5]) if name in goal.velocities else 0.0,
            ahead=ahead.get(name),
        )
        offsets, turns = route.offsets_at(times), quat_from_yaw(route.turns_at(times))
        goals = preview(goal, tuple(poses), times, config.preview_s)
        led = {}
        for each, track in goals.items():
            led[each] = np.array(track)
            led[each][:, :2] += offsets
            if each == name:
                led[each][:, 3:] = quat_multiply(turns, track[:, 3:])
        return led, route.facing_at(float(times[-2]))


def compute_times(config: MpcConfig) -> np.ndarray:
    """Times of the reference trajectory [s]: the control steps and two more. Shape (H + 3,).

    The last two are the end of the extrapolation and the target time of the proposal.
    """
    end = config.horizon * POLICY_DT
    steps = np.arange(config.horizon + 1) * POLICY_DT
    return np.append(steps, [end + config.extrapolation_s, config.proposal_s])
