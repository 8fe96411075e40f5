"""Reference trajectory over the horizon, and the desired heading of a base on wheels.

`Guidance` makes the goal poses of each step; `FacingRule` says which way a base faces that drives
after a moving goal.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import mujoco
import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.state import Goal
from xop_lerobot.core.transforms import compute_heading, quat_from_yaw, quat_multiply, quat_yaw
from xop_lerobot.low_level.policy import POLICY_DT
from xop_lerobot.morphology.effect import Acts
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.morphology.tuning import MpcConfig
from xop_lerobot.retarget.costs.balance import compute_facing
from xop_lerobot.retarget.guidance.route import Footprint, RoutePlanner
from xop_lerobot.retarget.horizon_goals import hold_near, preview
from xop_lerobot.retarget.model.command_model import CommandModel, PlannerState
from xop_lerobot.retarget.posture_guide import HEAD, Served


class FacingRule:
    """Finds the facing for the first target; see `compute_facing`.

    Args:
        morphology: The robot.
        resting: How far ahead of the base each tracked frame is at rest [m].
    """

    def __init__(self, morphology: Morphology, resting: Mapping[str, float]) -> None:
        self._pivot, self._resting = morphology.pivot, dict(resting)
        self._hands = {arm.frame for arm in morphology.arms}

    def compute(
        self,
        state: PlannerState,
        then: Mapping[str, np.ndarray],
        dt: float,
        ahead: Mapping[str, float] | None = None,
    ) -> np.ndarray:
        """Compute where the base shall face. A hand looks nowhere: for it, as it faces now.

        Args:
            state: Where the robot is.
            then: Goal of each tracked frame in `dt`. Shapes (1, 7).
            dt: Time to get there [s].
            ahead: How far ahead of the base frames will be, where not as at rest [m].

        Returns:
            Direction in the world, as long as it counts. Shape (2,).
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
            return compute_facing(heading, velocity, look, speed)
        return np.zeros(2)


def _direction(heading: float) -> np.ndarray:
    """Unit vector of a heading. Shape (2,)."""
    return np.array([np.cos(heading), np.sin(heading)])


_UPRIGHT = 0.9  # cosine of a waist's axis to the vertical, from which on it stands upright


def find_waist_axis(morphology: Morphology, model: mujoco.MjModel) -> float:
    """How far ahead of the base the uppermost vertical joint is, as the robot stands [m]."""
    data = mujoco.MjData(model)
    data.qpos[: len(morphology.standing_qpos())] = morphology.standing_qpos()
    mujoco.mj_kinematics(model, data)
    joints = [model.joint(each.joint).id for each in morphology.effects if each.acts is Acts.JOINT]
    upright = [joint for joint in joints if data.xaxis[joint, 2] > _UPRIGHT]
    return float(data.xanchor[upright[-1], 0]) if upright else 0.0


_LOOK_AHEAD = 1.6  # length of a way that is looked at: about a quarter turn [s]
_STILL = 0.1  # speed of a goal under which it counts as standing still [m/s]


class Guidance:
    """Turns the goal of now into goals over the horizon.

    A goal that stands still is led along the way that a base on wheels takes to it (`Route`).
    One that moves is followed within reach, the base facing where it goes (`FacingRule`): a way
    that ends at the goal would always be late. A robot that can go sideways, or that does not
    drive, has its goals within reach and nothing more.

    Args:
        morphology: The robot.
        model: Its planning model.
        command_model: What is decided; says whether the base drives but cannot go sideways.
        resting: How far ahead of the base each tracked frame is at rest [m].
        footprint: Tells how near the base comes to obstacles.
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
        """Compute the goals at `compute_times`, and where a base on wheels shall face at the end.

        Args:
            state: Where the robot is, with the decision that it executes.
            goal: The goal now.
            config: Parameters of the mode.
            served: The posture for the head's goal, None where there is none.

        Returns:
            Poses, shapes (H + 3, 7), and a direction in the world, as long as it counts: zero
            where none does. Shape (2,).
        """
        times, poses = compute_times(config), state.poses
        ahead = {} if served is None else {HEAD: served.ahead}
        name = next((name for name in poses if name in goal.poses), None)
        drives = name is not None and self._drives(goal.mode)
        if name is not None and drives and _compute_speed(goal, name) < _STILL:
            return self._lead_along_route(state, goal, name, times, config, ahead)
        near = hold_near(goal, poses, config.reach)
        goals = preview(near, tuple(poses), times, config.preview_s)
        if not drives:
            return goals, np.zeros(2)
        then = {each: track[-1:] for each, track in goals.items()}
        return goals, self._facing.compute(state, then, config.proposal_s, ahead)

    def _drives(self, mode: Mode) -> bool:
        """Whether wheels are among what may be moved in `mode`."""
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
        """Goals where the base will have carried the frame `name`; the others go with it."""
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
    """Times at which goals are asked for [s]: the control steps, and two further ones.

    Those are the end of the extrapolation, and what the proposal aims at. Shape (H + 3,).
    """
    end = config.horizon * POLICY_DT
    steps = np.arange(config.horizon + 1) * POLICY_DT
    return np.append(steps, [end + config.extrapolation_s, config.proposal_s])


def _compute_speed(goal: Goal, name: str) -> float:
    """Horizontal speed of a goal [m/s]."""
    velocity = goal.velocities.get(name)
    return 0.0 if velocity is None else math.hypot(velocity[0], velocity[1])
