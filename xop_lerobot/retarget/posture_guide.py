"""Holds the head's goal within what the robot can serve, and knows the posture for it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.state import Goal
from xop_lerobot.core.transforms import (
    compute_heading,
    heading_error,
    make_pose,
    quat_conjugate,
    quat_exp,
    quat_from_yaw,
    quat_multiply,
    quat_rotate,
    quat_yaw,
)
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.morphology.tuning import MpcConfig
from xop_lerobot.retarget.costs.balance import SupportArea
from xop_lerobot.retarget.model.command_model import (
    CommandModel,
    PlannerState,
    Start,
    find_joints_along,
)
from xop_lerobot.retarget.model.linearisation import Placement
from xop_lerobot.retarget.model.posture import AT_REST_S, MISSED, Found, PostureSearch, Repertoire
from xop_lerobot.retarget.model.proposal import KinematicProposal, make_proposal_weights
from xop_lerobot.retarget.static_load import StaticLoad

HEAD = "head"
_EFFORT, _LEVEL_EFFORT = 0.002, 0.01  # of a posture, which has all the time to get there
_NEAR, _SAME = 0.01, 0.03  # by which a goal may be missed before it is moved [m], [rad]
_EXTEND = 0.02  # by which the reach of a robot that stands changes in a solve [m]
_FARTHEST = 1.0  # its largest [m]
_STILL = 0.1  # speed of a goal under which it counts as standing still [m/s]
_OFF, _PATIENCE = 0.06, 25  # error of the height [m], and solves, from which a robot is stuck
_CREEP = 0.02  # speed that counts as none [m/s], [rad/s]
_BEYOND = 0.6  # turn past half a turn at which the other way round is taken [rad]


class Served(NamedTuple):
    """How a robot would be at the head's goal.

    Attributes:
        natural: The command that holds the posture. Shape (n,).
        balance: Where its centre of mass is on the base; None for a robot without support area.
            Shape (2,).
        ahead: How far ahead of the base the head is then [m].
        shift: What the posture misses of the goal, world axes [m]. Shape (3,).
        turn: The same of its orientation: a tilt about X and Y, then a turn [rad]. Shape (3,).
        detour: Whether the robot has to go another way than nearer and nearer.
        brakes: Whether that is to stop first, in the posture it has.
    """

    natural: np.ndarray
    balance: np.ndarray | None
    ahead: float
    shift: np.ndarray
    turn: np.ndarray
    detour: bool
    brakes: bool = False

    def move(self, track: np.ndarray) -> np.ndarray:
        """Move goals to where they can be served. (n, 7) -> (n, 7)."""
        if not self.shift.any() and not self.turn.any():
            return track
        tilt = quat_exp(np.array([self.turn[0], self.turn[1], 0.0]))
        turn = quat_multiply(quat_from_yaw(float(self.turn[2])), tilt)
        return make_pose(track[:, :3] + self.shift, quat_multiply(turn, track[:, 3:]))


class PostureGuide:
    """Tells in which posture the robot would be at the head's goal, and how much it misses.

    In stationary mode that is a posture for the whole pose, on the feet or the base that stand.
    First the goal is held near the place where the head rests, unless the robot can be where it
    is, and its heading within what the waist turns: what cannot be served would only contort the
    robot. What still brakes after a change of mode keeps its posture until it stands: a torso
    that leans after its goal, or back, meanwhile needs more torque than it has. A robot that
    drives is in the right posture when height and nod are right: the rest is the wheels'. A
    walking robot, which takes no posture, gets none.

    Args:
        morphology: The robot.
        model: Its planning model.
        command_model: What a decision does.
        support: Area over which the centre of mass stays; None for a robot that balances itself.
        load: What joints bear of the weight above them; None where a policy moves them.
    """

    def __init__(
        self,
        morphology: Morphology,
        model: mujoco.MjModel,
        command_model: CommandModel,
        support: SupportArea | None,
        load: StaticLoad | None,
    ) -> None:
        self._morphology, self._model, self._command_model = morphology, model, command_model
        self._support = support
        self._load = load
        self._site = morphology.frames[HEAD]
        base = morphology.base_body
        self._placement = Placement(model, (self._site,), com_of=base)
        standing = morphology.standing_qpos()
        self._repertoire = Repertoire(
            model, command_model, standing, self._site, base, support, self._load
        )
        roll, _, self._vertical = (
            find_joints_along(morphology, model, command_model, axis) for axis in range(3)
        )
        self._aside = roll | self._vertical
        self._resting = self._place(Start(standing), command_model.space.neutral)[0][:2]
        space = command_model.space
        low, high = space.low.copy(), space.high.copy()
        for name, (least, most) in morphology.posture_limits.items():
            i = space.index(name)
            low[i], high[i] = max(low[i], least), min(high[i], most)
        self._limits = (low, high)
        self._searches: dict[Mode, PostureSearch] = {}
        self._level: PostureSearch | None = None
        self._free: PostureSearch | None = None
        self.reset()

    def configure(self, configs: Mapping[Mode, MpcConfig], sites: Mapping[str, str]) -> None:
        """Take other parameters or targets; there are postures for a head alone."""
        self._searches, self._level, self._free = {}, None, None
        self._start()
        if HEAD not in sites:
            return
        still = configs[Mode.STATIONARY]
        # A chain of many joints has several postures for a goal; a waist on legs has one.
        chain = self._morphology.servos is not None
        self._searches[Mode.STATIONARY] = self._make_search(still, level=False, way=chain)
        self._free = self._make_search(still, level=False)
        self._level = self._make_search(still, level=True)
        if self._command_model.is_nonholonomic:
            self._searches[Mode.MOBILE] = self._make_search(
                configs[Mode.MOBILE], level=True, upright=True, way=chain
            )

    def _make_search(
        self, config: MpcConfig, *, level: bool, upright: bool = False, way: bool = False
    ) -> PostureSearch:
        """Make a search.

        Args:
            config: Whose weights it takes.
            level: Whether it is for height and tilt alone.
            upright: Whether it does without a lean aside.
            way: Whether it looks at the way to the posture.
        """
        weights = make_proposal_weights(config.weights)
        used = np.ones(len(self._vertical), dtype=bool)
        weights = dataclasses.replace(weights, effort=_EFFORT, change=0.0, lean=0.0)
        if level:
            tilt = weights.orientation[0]
            weights = dataclasses.replace(
                weights,
                position=(0.0, 0.0, weights.position[2]),
                orientation=(tilt, tilt, 0.0),
                effort=_LEVEL_EFFORT,
            )
            used &= ~(self._aside if upright else self._vertical)
        problem = KinematicProposal(
            self._model,
            self._command_model,
            {HEAD: self._site},
            weights,
            self._support,
            self._morphology.base_body,
            self._load,
        )
        return PostureSearch(
            problem, self._repertoire, used, self._limits, strict=level, looks_at_way=way
        )

    def reset(self) -> None:
        """Start anew."""
        for search in (*self._searches.values(), self._level, self._free):
            if search is not None:
                search.reset()
        self._start()

    def _start(self) -> None:
        self._beside, self._reach, self._waited = 0.0, self._morphology.standing_reach, 0

    def hold(self, goal: Goal, state: PlannerState, preview_s: float) -> Goal:
        """Hold the goal of a robot that stands near the place where its head rests.

        Args:
            goal: The goal.
            state: Where the robot is.
            preview_s: Time over which it is assumed to keep its velocity [s].
        """
        if (
            self._level is None
            or self._free is None
            or goal.mode is not Mode.STATIONARY
            or HEAD not in goal.poses
        ):
            return goal
        pose = goal.poses[HEAD].copy()
        qpos = state.qpos
        heading = float(quat_yaw(qpos[3:7]))
        ahead = np.array([math.cos(heading), math.sin(heading)])
        axes = np.stack([ahead, [-ahead[1], ahead[0]]])
        place = axes @ (pose[:2] - qpos[:2])
        beyond = self._compute_turn_beyond(pose[3:], heading)
        velocity = goal.velocities.get(HEAD, np.zeros(6))
        end = place + preview_s * (axes @ velocity[:2])  # where it is led to
        far = max(math.dist(each, self._resting) for each in (place, end))
        is_far = far > self._morphology.standing_reach
        reachable = False
        if beyond or is_far:
            reachable = self._free.find(HEAD, state, pose).missed <= MISSED
        if beyond and not reachable:  # a tilted head may look further aside than the waist turns
            pose[3:] = quat_multiply(quat_from_yaw(-beyond), pose[3:])
            reachable = self._free.find(HEAD, state, pose).missed <= MISSED
        self._adapt_reach(reachable and is_far, moving=_is_moving(goal))
        if is_far:
            # Who bows or squats has the head elsewhere; up to there it is no matter of reach.
            found = self._level.find(HEAD, state, pose)
            bowed, _ = self._place(state.start, found.command)
            bowed = axes @ (bowed[:2] - qpos[:2])
            place, end = (
                _hold_near_line(each, self._resting, bowed, self._reach) for each in (place, end)
            )
            pose[:2] = qpos[:2] + place @ axes
            velocity = np.array([*((end - place) @ axes / max(preview_s, 1e-6)), *velocity[2:]])
        velocities = {**goal.velocities, HEAD: velocity}
        return dataclasses.replace(goal, poses={**goal.poses, HEAD: pose}, velocities=velocities)

    def _is_braking(self, executed: np.ndarray) -> bool:
        """Whether more is executed than what sways a robot that stands."""
        sway = self._command_model.compute_twist(self._command_model.space.sway)
        twist = self._command_model.compute_twist(executed)
        return bool((np.abs(twist) > sway + _CREEP).any())

    def _is_stuck(self, goal: Goal, qpos: np.ndarray) -> bool:
        """Whether a robot that drives stays above or below a goal that stands, from then on."""
        if _is_moving(goal):
            self._waited = 0
        elif self._waited < _PATIENCE:
            poses, _, _ = self._placement.compute(qpos[None])
            off = abs(float(poses[self._site][0][2] - goal.poses[HEAD][2]))
            self._waited = self._waited + 1 if off > _OFF else 0
        return self._waited >= _PATIENCE

    def _adapt_reach(self, reachable: bool, *, moving: bool) -> None:
        """Let the goal go further off where the robot can be there, and take it back where not."""
        least = self._morphology.standing_reach
        change = (0.0 if moving else _EXTEND) if reachable else -_EXTEND
        self._reach = min(max(self._reach + change, least), _FARTHEST)

    def _compute_turn_beyond(self, quat: np.ndarray, base: float) -> float:
        """How far a goal looks beyond what the waist turns, on the side where it was [rad]."""
        beside = float(compute_heading(quat)) - base
        beside = self._beside + math.remainder(beside - self._beside, math.tau)
        if abs(beside) > math.pi + _BEYOND:
            beside = math.remainder(beside, math.tau)
        self._beside = beside
        space = self._command_model.space
        waist = self._vertical & self._command_model.acting(Mode.STATIONARY)
        return beside - min(max(beside, space.low[waist].sum()), space.high[waist].sum())

    def find(self, goal: Goal, pose: np.ndarray, state: PlannerState) -> Served | None:
        """Find the posture for the head at `pose`; None where the mode knows none.

        Args:
            goal: The goal.
            pose: That of the head that counts. Shape (7,).
            state: Where the robot is.
        """
        search = self._searches.get(goal.mode)
        if search is None:
            return None
        if goal.mode is Mode.STATIONARY and self._is_braking(state.executed):
            stop = np.where(self._command_model.is_velocity(), 0.0, state.executed)
            still = Found(stop, 0.0, detour=True)
            there, _ = self._place(state.start, stop)
            served = self._describe(still, goal.mode, there, state)
            return served._replace(brakes=True)
        if goal.mode is Mode.MOBILE:
            pose = _remove_roll(pose)
        found = search.find(HEAD, state, pose)
        if not np.isfinite(found.command).all():
            search.reset()
            return None
        # On the way, to be in the posture for the goal of now takes more torque than to follow it.
        if goal.mode is Mode.MOBILE and not self._is_stuck(goal, state.qpos):
            return None
        return self._describe(found, goal.mode, pose, state)

    def _describe(self, found: Found, mode: Mode, pose: np.ndarray, state: PlannerState) -> Served:
        qpos = state.qpos
        there, com = self._place(state.start, found.command)
        heading = float(quat_yaw(qpos[3:7]))
        cosine, sine = math.cos(heading), math.sin(heading)
        to_base = np.array([[cosine, sine], [-sine, cosine]])
        shift, turn = there[:3] - pose[:3], heading_error(there[3:], pose[3:])
        if mode is Mode.MOBILE:  # the rest is not the posture's
            shift[:2], turn[2] = 0.0, 0.0
        return Served(
            natural=found.command,
            balance=to_base @ (com[:2] - qpos[:2]) if self._support is not None else None,
            ahead=float(to_base[0] @ (there[:2] - qpos[:2])),
            shift=_forgive(shift, _NEAR),
            turn=_forgive(turn, _SAME),
            detour=found.detour,
        )

    def _place(self, start: Start, command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pose of the head (7,) and centre of mass (3,) of a robot at rest under a command."""
        future = self._command_model.extrapolate(
            start.without_ramp(), command, AT_REST_S, Mode.STATIONARY
        )
        poses, _, com = self._placement.compute(future[None])
        return poses[self._site][0], com[0]


def _is_moving(goal: Goal) -> bool:
    """Whether the goal of the head is on its way somewhere."""
    velocity = goal.velocities.get(HEAD)
    return velocity is not None and math.hypot(velocity[0], velocity[1]) > _STILL


def _remove_roll(pose: np.ndarray) -> np.ndarray:
    """A pose with its heading and its nod alone. Shape (7,)."""
    heading = quat_from_yaw(float(compute_heading(pose[3:])))
    x, _, z = quat_rotate(quat_multiply(quat_conjugate(heading), pose[3:]), np.eye(3)[0])
    nod = quat_exp(np.array([0.0, math.atan2(-z, x), 0.0]))
    return make_pose(pose[:3], quat_multiply(heading, nod))


def _forgive(error: np.ndarray, tolerance: float) -> np.ndarray:
    """What of an error is beyond a tolerance. Shape (3,)."""
    return error * max(0.0, 1 - tolerance / max(float(np.linalg.norm(error)), 1e-12))


def _hold_near_line(
    point: np.ndarray, start: np.ndarray, end: np.ndarray, reach: float
) -> np.ndarray:
    """Move a point to within `reach` of the line from `start` to `end`. Shapes (2,)."""
    along = end - start
    share = float(along @ (point - start)) / max(float(along @ along), 1e-12)
    foot = start + min(max(share, 0.0), 1.0) * along
    offset = point - foot
    return foot + offset * min(1.0, reach / max(float(np.linalg.norm(offset)), 1e-12))
