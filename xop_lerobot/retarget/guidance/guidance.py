"""Reference trajectory over the horizon, and the desired heading of a base on wheels.

`Guidance` makes the goal poses of each step; `FacingRule` says which way a base faces that drives
after a moving goal, `TwistRoom` how far the waist can turn before an arm touches what is below it.
"""

from __future__ import annotations

import math
from collections import deque
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
        room: float = math.inf,
        ahead: Mapping[str, float] | None = None,
    ) -> np.ndarray:
        """Compute where the base shall face. A hand looks nowhere: for it, as it faces now.

        Args:
            state: Where the robot is.
            then: Goal of each tracked frame in `dt`. Shapes (1, 7).
            dt: Time to get there [s].
            room: How far the arms let the waist twist [rad].
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
            return compute_facing(heading, velocity, look, speed, room)
        return np.zeros(2)


def _direction(heading: float) -> np.ndarray:
    """Unit vector of a heading. Shape (2,)."""
    return np.array([np.cos(heading), np.sin(heading)])


_STEP, _FIRST = 0.1, 0.8  # angles that are tried, on either side [rad]
_SPARE = 0.2  # what is left free between the last free angle and the waist [rad]
_DEEP = 0.01  # by which arms are in the way, and no longer graze [m]
_SAME = 0.03  # a posture within which the last answer holds [rad]
_LASTING = 1.5  # time for which arms have to be in the way [s]
_NEAR = 0.2  # so near to its limit a waist is told of no more room [rad]
_UPRIGHT = 0.9  # cosine of a waist's axis to the vertical, from which on it stands upright


def find_waist(morphology: Morphology, model: mujoco.MjModel, data: mujoco.MjData) -> int | None:
    """The uppermost joint that turns about the vertical, of a robot whose bodies are placed."""
    joints = [model.joint(each.joint).id for each in morphology.effects if each.acts is Acts.JOINT]
    upright = [joint for joint in joints if data.xaxis[joint, 2] > _UPRIGHT]
    return upright[-1] if upright else None


class TwistRoom:
    """Looks how far the waist may twist as the arms are now.

    Arms that hang at rest leave a waist all its range. Elbows that are tucked in, to hold
    something before the chest, meet hips and belly after a quarter turn: they are pushed aside,
    and what they hold is lost.

    Args:
        morphology: The robot; without a joint that turns its waist it has all the room.

    Attributes:
        axis: How far ahead of the base is what the waist turns about, at rest [m].
    """

    def __init__(self, morphology: Morphology) -> None:
        self._model = morphology.build_spec("full").compile()
        self._data = mujoco.MjData(self._model)
        self._data.qpos[:] = morphology.standing_qpos()
        mujoco.mj_kinematics(self._model, self._data)
        self._address = self._waist = -1
        self.axis = 0.0
        joint = find_waist(morphology, self._model, self._data)
        if joint is not None:
            waist = self._model.joint(joint)
            self.axis = float(self._data.xanchor[joint, 0])
            self._address, self._waist = int(waist.qposadr[0]), int(waist.bodyid[0])
            self._range = float(np.abs(waist.range).min())
            self._above = _find_subtree(self._model, self._waist)
        self.reset()

    def reset(self) -> None:
        """Start anew."""
        self._last, self._room = np.full(self._model.nq, np.inf), np.inf
        self._rooms: deque[tuple[float, float]] = deque()
        self._told = np.inf

    def compute(self, qpos: np.ndarray, time: float) -> float:
        """Largest twist to either side that leaves the arms free, 0.5 at the least [rad].

        Arms that swing past are not in the way: what counts is the most of the last seconds. And
        an arm that is being pushed aside makes no room.

        Args:
            qpos: Configuration now. Shape (nq,).
            time: Time of it [s].
        """
        if self._waist < 0:
            return np.inf
        posture = np.array(qpos)
        posture[:7] = posture[self._address] = 0.0
        if np.abs(posture - self._last).max() > _SAME:
            self._last, self._room = posture, self._search(np.array(qpos))
        self._rooms.append((time, self._room))
        while self._rooms[0][0] < time - _LASTING:
            self._rooms.popleft()
        most = max(room for _, room in self._rooms)
        if most < self._told or abs(qpos[self._address]) < self._told - _NEAR:
            self._told = most
        return self._told

    def _search(self, qpos: np.ndarray) -> float:
        for angle in np.arange(_FIRST, self._range, _STEP):
            for side in (1.0, -1.0):
                qpos[self._address] = side * angle
                if self._touches(qpos):
                    return float(angle) - _STEP - _SPARE
        return self._range

    def _touches(self, qpos: np.ndarray) -> bool:
        """Whether anything above the waist touches anything below."""
        model, data = self._model, self._data
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        deep = data.contact.dist < -_DEEP
        above = self._above[model.geom_bodyid[data.contact.geom[deep]]]
        return bool((above[:, 0] != above[:, 1]).any())


def _find_subtree(model: mujoco.MjModel, root: int) -> np.ndarray:
    """Which bodies hang on `root`, itself among them. Shape (bodies,), bool."""
    above = np.zeros(model.nbody, dtype=bool)
    above[root] = True
    for body in range(root + 1, model.nbody):
        above[body] = above[model.body_parentid[body]]
    return above


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
        self._room: TwistRoom | None = None
        self._routes: RoutePlanner | None = None
        if command_model.is_nonholonomic:
            self._room = TwistRoom(morphology)
            self._routes = RoutePlanner(morphology, resting, footprint, self._room.axis)

    def reset(self) -> None:
        """Start anew."""
        if self._room is not None:
            self._room.reset()

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
        room = math.inf
        if drives and self._room is not None:
            room = self._room.compute(state.qpos, state.time)
        if name is not None and drives and _compute_speed(goal, name) < _STILL:
            return self._lead_along_route(state, goal, name, times, config, room, ahead)
        near = hold_near(goal, poses, config.reach)
        goals = preview(near, tuple(poses), times, config.preview_s)
        if not drives:
            return goals, np.zeros(2)
        then = {each: track[-1:] for each, track in goals.items()}
        return goals, self._facing.compute(state, then, config.proposal_s, room, ahead)

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
        room: float,
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
