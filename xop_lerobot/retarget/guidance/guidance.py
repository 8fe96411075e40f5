"""What the controller is led along: the goals over the horizon, and where wheels shall face."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.state import Goal
from xop_lerobot.core.transforms import quat_from_yaw, quat_multiply
from xop_lerobot.low_level.policy import POLICY_DT
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.morphology.tuning import MpcConfig
from xop_lerobot.retarget.guidance.facing import FacingRule
from xop_lerobot.retarget.guidance.footprint import Footprint
from xop_lerobot.retarget.guidance.route import RoutePlanner
from xop_lerobot.retarget.guidance.twist_room import TwistRoom
from xop_lerobot.retarget.horizon_goals import hold_near, preview
from xop_lerobot.retarget.model.command_model import CommandModel
from xop_lerobot.retarget.posture_guide import HEAD, Served

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
        command_model: What is decided; says whether the base drives but cannot go sideways.
        resting: How far ahead of the base each tracked frame is at rest [m].
        footprint: Tells how near the base comes to obstacles.
    """

    def __init__(
        self,
        morphology: Morphology,
        command_model: CommandModel,
        resting: Mapping[str, float],
        footprint: Footprint | None = None,
    ) -> None:
        self._command_model = command_model
        self._facing = FacingRule(morphology, resting)
        self._room = TwistRoom(morphology) if command_model.is_nonholonomic else None
        self._routes = RoutePlanner(morphology, resting, footprint)

    def reset(self) -> None:
        """Start anew."""
        if self._room is not None:
            self._room.reset()

    def lead(
        self,
        qpos: np.ndarray,
        executed: np.ndarray,
        poses: Mapping[str, np.ndarray],
        goal: Goal,
        config: MpcConfig,
        time: float,
        served: Served | None = None,
    ) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Compute the goals at `compute_times`, and where a base on wheels shall face at the end.

        Args:
            qpos: Configuration now. Shape (nq,).
            executed: Decision being executed. Shape (n,).
            poses: Pose of each tracked frame now. Shapes (7,).
            goal: The goal now.
            config: Parameters of the mode.
            time: Time of `qpos` [s].
            served: The posture for the head's goal, None where there is none.

        Returns:
            Poses, shapes (H + 3, 7), and a direction in the world, as long as it counts: zero
            where none does. Shape (2,).
        """
        times = compute_times(config)
        ahead = {} if served is None else {HEAD: served.ahead}
        name = next((name for name in poses if name in goal.poses), None)
        drives = name is not None and self._drives(goal.mode)
        room = self._room.compute(qpos, time) if drives and self._room is not None else math.inf
        if name is not None and drives and _compute_speed(goal, name) < _STILL:
            twist = self._command_model.compute_twist(executed)
            return self._lead_along_route(
                qpos, twist, poses, goal, name, times, config, room, ahead
            )
        near = hold_near(goal, poses, config.reach)
        goals = preview(near, tuple(poses), times, config.preview_s)
        if not drives:
            return goals, np.zeros(2)
        then = {each: track[-1:] for each, track in goals.items()}
        return goals, self._facing.compute(qpos, poses, then, config.proposal_s, room, ahead)

    def _drives(self, mode: Mode) -> bool:
        """Whether wheels are among what may be moved in `mode`."""
        free = self._command_model.acting(mode).astype(float)
        return (
            self._command_model.is_nonholonomic and self._command_model.compute_twist(free)[0] > 0
        )

    def _lead_along_route(
        self,
        qpos: np.ndarray,
        twist: np.ndarray,
        poses: Mapping[str, np.ndarray],
        goal: Goal,
        name: str,
        times: np.ndarray,
        config: MpcConfig,
        room: float,
        ahead: Mapping[str, float],
    ) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Goals where the base will have carried the frame `name`; the others go with it."""
        route = self._routes.plan(
            qpos,
            (float(twist[0]), float(twist[2])),
            name,
            poses[name],
            goal.poses[name],
            duration=max(_LOOK_AHEAD, float(times[-2:].max())),
            turn_rate=float(goal.velocities[name][5]) if name in goal.velocities else 0.0,
            room=room,
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
