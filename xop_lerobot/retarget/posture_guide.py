"""Limits the head's goal to what the robot can reach, and finds the posture for it.

`PostureGuide.hold` limits the goal of a robot in stationary mode, `PostureGuide.find` returns the
posture (`Served`) at it. Only robots that stand or drive use it; a walking robot gets no posture.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.state import HEAD, Goal
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
from xop_lerobot.retarget.horizon_goals import is_moving
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

# Effort weights of a posture; below the proposal's 0.02, since there is no deadline to reach it.
_EFFORT, _LEVEL_EFFORT = 0.002, 0.01
_NEAR, _SAME = 0.01, 0.03  # error of the posture up to which the goal is not corrected [m], [rad]
_EXTEND = 0.02  # change of the reach of a standing robot per solve [m]
_FARTHEST = 1.0  # its upper bound [m]
_OFF, _PATIENCE = 0.06, 25  # height error [m] and number of solves that make a robot stuck
_CREEP = 0.02  # tolerance on velocities that count as zero [m/s], [rad/s]
_BEYOND = 0.6  # hysteresis: angle past half a turn at which the waist changes sides [rad]


class Served(NamedTuple):
    """Posture of a robot at the head's goal.

    Attributes:
        natural: The command that holds the posture. Shape (n,).
        balance: Position of its centre of mass in the base's frame; None for a robot without
            support area. Shape (2,).
        ahead: Forward distance of the head from the base in it [m].
        shift: Position of the head in the posture less the goal, world axes, beyond a tolerance
            [m]. Shape (3,).
        turn: The same for the orientation: tilt about X and Y, then heading [rad]. Shape (3,).
        detour: Whether the way to the posture leads away from the goal at first.
        brakes: Whether the robot has to stop first, in its present posture.
    """

    natural: np.ndarray
    balance: np.ndarray | None
    ahead: float
    shift: np.ndarray
    turn: np.ndarray
    detour: bool
    brakes: bool = False

    def move(self, track: np.ndarray) -> np.ndarray:
        """Move goals by the error of the posture, to where they can be reached. (n, 7)."""
        if not self.shift.any() and not self.turn.any():
            return track
        tilt = quat_exp(np.array([self.turn[0], self.turn[1], 0.0]))
        turn = quat_multiply(quat_from_yaw(float(self.turn[2])), tilt)
        return make_pose(track[:, :3] + self.shift, quat_multiply(turn, track[:, 3:]))


class PostureGuide:
    """Finds the posture at the head's goal, and the error that remains in it.

    In stationary mode the posture is for the whole pose, with feet or base fixed. First the goal
    is limited: to a distance from the head's rest position unless the robot can reach it, and to
    the heading range of the waist; an unreachable goal would only contort the robot. A robot that
    still brakes after a change of mode keeps its posture until it stands, since leaning meanwhile
    needs more torque than the torso has. In mobile mode, on wheels, the posture is for height and
    pitch only; the rest is up to the wheels. A walking robot has no posture.

    Args:
        morphology: The robot.
        model: Its planning model.
        command_model: First-order model of the effect of a decision.
        support: Support area for the centre of mass; None for a robot that balances itself.
        load: Static loads of the joints; None if a policy moves them.
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
        """Set the parameters and targets; postures exist only for the head."""
        self._searches, self._level, self._free = {}, None, None
        self._start()
        if HEAD not in sites:
            return
        still = configs[Mode.STATIONARY]
        # A redundant chain has several postures for a goal; a waist on legs has only one.
        chain = self._morphology.servos is not None
        self._searches[Mode.STATIONARY] = self._make_search(still, level=False, detours=chain)
        self._free = self._make_search(still, level=False)
        self._level = self._make_search(still, level=True)
        if self._command_model.is_nonholonomic:
            self._searches[Mode.MOBILE] = self._make_search(
                configs[Mode.MOBILE], level=True, upright=True, detours=chain
            )

    def _make_search(
        self, config: MpcConfig, *, level: bool, upright: bool = False, detours: bool = False
    ) -> PostureSearch:
        """Make a search.

        Args:
            config: Parameters whose weights it uses.
            level: Whether it is for height and tilt only.
            upright: Whether roll joints stay neutral.
            detours: Whether it detects detours (`Found.detour`).
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
            problem, self._repertoire, used, self._limits, strict=level, detects_detours=detours
        )

    def reset(self) -> None:
        """Forget previous goals and postures."""
        for search in (*self._searches.values(), self._level, self._free):
            if search is not None:
                search.reset()
        self._start()

    def _start(self) -> None:
        self._beside, self._reach, self._waited = 0.0, self._morphology.standing_reach, 0

    def hold(self, goal: Goal, state: PlannerState, preview_s: float) -> Goal:
        """Limit the goal in stationary mode to what the robot can reach.

        Args:
            goal: The goal.
            state: The planner's state.
            preview_s: Time for which the goal is assumed to keep its velocity [s].
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
        end = place + preview_s * (axes @ velocity[:2])  # goal at the end of the preview
        far = max(math.dist(each, self._resting) for each in (place, end))
        is_far = far > self._morphology.standing_reach
        reachable = False
        if beyond or is_far:
            reachable = self._free.find(HEAD, state, pose).missed <= MISSED
        if beyond and not reachable:  # a tilted head may exceed the waist's range and be reachable
            pose[3:] = quat_multiply(quat_from_yaw(-beyond), pose[3:])
            reachable = self._free.find(HEAD, state, pose).missed <= MISSED
        self._adapt_reach(reachable and is_far, moving=is_moving(goal, HEAD))
        if is_far:
            # A robot that bows or squats moves its head forward. So the reach counts from the line
            # between the head at rest and the head in the posture for the goal's height and tilt.
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
        """Whether the executed velocities exceed those of a weight shift in place."""
        sway = self._command_model.compute_twist(self._command_model.space.sway)
        twist = self._command_model.compute_twist(executed)
        return bool((np.abs(twist) > sway + _CREEP).any())

    def _is_stuck(self, goal: Goal, qpos: np.ndarray) -> bool:
        """Whether a driving robot misses the height of a stationary goal for `_PATIENCE` solves.

        Latched until the goal moves.
        """
        if is_moving(goal, HEAD):
            self._waited = 0
        elif self._waited < _PATIENCE:
            poses, _, _ = self._placement.compute(qpos[None])
            off = abs(float(poses[self._site][0][2] - goal.poses[HEAD][2]))
            self._waited = self._waited + 1 if off > _OFF else 0
        return self._waited >= _PATIENCE

    def _adapt_reach(self, reachable: bool, *, moving: bool) -> None:
        """Extend the reach while the goal is reachable, and shrink it back otherwise."""
        least = self._morphology.standing_reach
        change = (0.0 if moving else _EXTEND) if reachable else -_EXTEND
        self._reach = min(max(self._reach + change, least), _FARTHEST)

    def _compute_turn_beyond(self, quat: np.ndarray, base: float) -> float:
        """Angle by which a goal's heading exceeds the waist's range, on its previous side [rad]."""
        beside = float(compute_heading(quat)) - base
        beside = self._beside + math.remainder(beside - self._beside, math.tau)
        if abs(beside) > math.pi + _BEYOND:
            beside = math.remainder(beside, math.tau)
        self._beside = beside
        space = self._command_model.space
        waist = self._vertical & self._command_model.acting(Mode.STATIONARY)
        return beside - min(max(beside, space.low[waist].sum()), space.high[waist].sum())

    def find(self, goal: Goal, pose: np.ndarray, state: PlannerState) -> Served | None:
        """Find the posture for the head at `pose`; None if the mode uses none at the moment.

        Args:
            goal: The goal.
            pose: Predicted goal pose of the head. Shape (7,).
            state: The planner's state.
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
        # On the way, holding the posture of the present goal takes more torque than following it.
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
        if mode is Mode.MOBILE:  # horizontal position and heading are up to the wheels
            shift[:2], turn[2] = 0.0, 0.0
        return Served(
            natural=found.command,
            balance=to_base @ (com[:2] - qpos[:2]) if self._support is not None else None,
            ahead=float(to_base[0] @ (there[:2] - qpos[:2])),
            shift=_subtract_tolerance(shift, _NEAR),
            turn=_subtract_tolerance(turn, _SAME),
            detour=found.detour,
        )

    def _place(self, start: Start, command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pose of the head (7,) and centre of mass (3,) once the robot has settled on a command."""
        future = self._command_model.extrapolate(
            start.without_ramp(), command, AT_REST_S, Mode.STATIONARY
        )
        poses, _, com = self._placement.compute(future[None])
        return poses[self._site][0], com[0]


def _remove_roll(pose: np.ndarray) -> np.ndarray:
    """Keep only heading and pitch of a pose. Shape (7,)."""
    heading = quat_from_yaw(float(compute_heading(pose[3:])))
    x, _, z = quat_rotate(quat_multiply(quat_conjugate(heading), pose[3:]), np.eye(3)[0])
    pitch = quat_exp(np.array([0.0, math.atan2(-z, x), 0.0]))
    return make_pose(pose[:3], quat_multiply(heading, pitch))


def _subtract_tolerance(error: np.ndarray, tolerance: float) -> np.ndarray:
    """Part of an error that exceeds a tolerance. Shape (3,)."""
    return error * max(0.0, 1 - tolerance / max(float(np.linalg.norm(error)), 1e-12))


def _hold_near_line(
    point: np.ndarray, start: np.ndarray, end: np.ndarray, reach: float
) -> np.ndarray:
    """Move a point to within `reach` of the segment from `start` to `end`. Shapes (2,)."""
    along = end - start
    share = float(along @ (point - start)) / max(float(along @ along), 1e-12)
    foot = start + min(max(share, 0.0), 1.0) * along
    offset = point - foot
    return foot + offset * min(1.0, reach / max(float(np.linalg.norm(offset)), 1e-12))
