"""The posture in which a robot would be at a goal, looked for from several starts."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.transforms import (
    compute_heading,
    compute_heading_squares,
    make_pose,
    pose_inverse,
    pose_multiply,
    quat_from_yaw,
    quat_yaw,
    rotation_error,
    sum_squares,
)
from xop_lerobot.retarget.costs.balance import SupportArea
from xop_lerobot.retarget.model.command_model import CommandModel, PlannerState, Start
from xop_lerobot.retarget.model.linearisation import Placement
from xop_lerobot.retarget.model.proposal import KinematicProposal, ProposalWeights, Solution
from xop_lerobot.retarget.static_load import StaticLoad

AT_REST_S = 20.0
"""Time after which a robot has taken a command up, whatever its lags [s]."""
_COUNT = 1000  # postures that are drawn at first
MISSED = 4e-4  # cost from which a goal counts as missed, and others are tried: 2 cm
_BETTER, _SHARE = 4e-4, 0.95  # by which, and to what share, another posture must be cheaper
_PERIOD = 25  # solves after which another start is tried though nothing is missed
_MOVED, _TURNED = 0.01, 0.03  # by which a goal has to move to be looked at anew [m], [rad]
_NEARBY, _OTHER = 4, 12  # iterations from the last posture, and from elsewhere
_STARTS = 7  # starts that are tried in turn; odd: each within the limits, then beyond
_FAR = 0.12  # distance of a posture from which on the way there is looked at, of scale
_ARRIVED = 0.05  # distance at which a detour has come to its end
_NEARER, _PATIENCE = 0.02, 8  # by which a posture has to come nearer within so many solves
_STUCK = 1.6e-3  # cost from which on it has to: 4 cm


class Found(NamedTuple):
    """A posture that has been found.

    Attributes:
        command: The command that holds it. Shape (k,).
        missed: What it misses of the goal, squared and weighted.
        detour: Whether the way there leads away from the goal at first: from where the robot is,
            no small change of its posture brings it nearer.
    """

    command: np.ndarray
    missed: float
    detour: bool


class Repertoire:
    """Postures that a robot can hold: drawn at random, and those that it cannot hold dropped.

    Args:
        model: The robot's model.
        command_model: What a command does.
        standing: Configuration in which it stands at the origin. Shape (nq,).
        site: Site of the head.
        base_body: The robot's root body.
        support: Area over which the centre of mass stays; None for one that balances itself.
        load: What joints bear of the weight above them.

    Attributes:
        commands: The commands that hold them. Shape (n, k).
        poses: Poses of the head in them. Shape (n, 7).
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        command_model: CommandModel,
        standing: np.ndarray,
        site: str,
        base_body: str,
        support: SupportArea | None,
        load: StaticLoad | None,
    ) -> None:
        space, rng = command_model.space, np.random.default_rng(0)
        moves = command_model.acting(Mode.STATIONARY) & ~command_model.is_velocity()
        drawn = rng.uniform(space.low, space.high, (_COUNT, len(space)))
        commands = np.where(moves, drawn, space.neutral)
        qpos = command_model.extrapolate(Start(standing), commands, AT_REST_S, Mode.STATIONARY)
        placement = Placement(model, (site,), com_of=base_body)
        poses, _, com = placement.compute(qpos)
        held = np.ones(_COUNT, dtype=bool)
        if support is not None:
            held &= (support.compute_excess(qpos[:, :7], com[:, :2]) <= 0).all(axis=-1)
        if load is not None:
            held &= (load.compute_excess(qpos) <= 0).all(axis=-1)
        self.commands, self.poses = commands[held], poses[site][held]

    def choose(
        self, base: np.ndarray, goal: np.ndarray, weights: ProposalWeights, count: int
    ) -> np.ndarray:
        """The commands whose postures come nearest to a goal, for a base at `base`.

        Shapes (7,), (7,) -> (n, k).
        """
        poses = pose_multiply(make_level(base), self.poses)
        error = sum_squares((poses[:, :3] - goal[:3]) * weights.position)
        turn, tilt = compute_heading_squares(goal[3:], poses[:, 3:])
        error += weights.orientation[2] ** 2 * turn + weights.orientation[0] ** 2 * tilt
        return self.commands[np.argsort(error)[:count]]


def make_level(base: np.ndarray) -> np.ndarray:
    """Place on the ground and heading of a base. Shape (7,)."""
    return make_pose(np.array([*base[:2], 0.0]), quat_from_yaw(quat_yaw(base[3:])))


class PostureSearch:
    r"""Looks for the command that a robot at its goal would hold, whatever the way there.

    The least squares of `KinematicProposal` without limits of rates, on a robot that has come to
    rest. They have local minima: knees that fold to the front or to the back, a waist that would
    have to go round the other way. So the last solution is followed, and while it misses the
    goal, and now and then anyway, another start is tried at each call: the robot's own posture,
    the neutral one, and those of a `Repertoire` that come nearest to the goal. The better one is
    taken.

    Args:
        problem: The least squares.
        repertoire: Postures to start from.
        used: Entries that make the posture; the others stay neutral. Shape (k,), bool.
        limits: Bounds within which a posture is looked for. Shapes (k,).
        strict: Whether it stays within them even where a goal can be reached beyond them alone.
        looks_at_way: Whether it tells detours.
    """

    def __init__(
        self,
        problem: KinematicProposal,
        repertoire: Repertoire,
        used: np.ndarray,
        limits: tuple[np.ndarray, np.ndarray],
        *,
        strict: bool = False,
        looks_at_way: bool = True,
    ) -> None:
        self.problem, self._repertoire, self._used = problem, repertoire, used
        self.space = problem.command_model.space
        self._limits = self._restrict(limits)
        self._everywhere = self._restrict((self.space.low, self.space.high))
        self._strict, self._looks_at_way = strict, looks_at_way
        self.reset()

    def _restrict(self, bounds: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        low, high = bounds
        return self.space.restrict(low, Mode.STATIONARY), self.space.restrict(high, Mode.STATIONARY)

    def reset(self) -> None:
        """Forget the last solution."""
        self._last: np.ndarray | None = None
        self._turn = self._quiet = self._tries = 0
        self._noted: np.ndarray | None = None
        self._found = Found(np.zeros(0), np.inf, detour=False)
        self._beyond = self._detours = False
        self._left, self._waited = np.inf, 0

    def find(self, name: str, state: PlannerState, goal: np.ndarray) -> Found:
        """Find the posture for a goal.

        Args:
            name: The tracked frame.
            state: Where the robot is, with the command that it executes.
            goal: Its goal. Shape (7,).
        """
        qpos, executed = state.qpos, state.executed
        at_once = state.start.without_ramp()
        free = self._used & self.problem.command_model.acting(Mode.STATIONARY)
        moved = self._note(qpos, goal)
        apart = self._compute_apart(executed)
        is_close = apart <= _FAR or not self._looks_at_way
        if not moved and is_close and not self._detours and self._last is not None:
            # A few solves are enough for a goal that stays, whether it is met or out of reach.
            rests = self._found.missed <= MISSED or self._tries >= 4 * _STARTS
            self._quiet += 1
            if rests and self._quiet < _PERIOD:
                return self._found
        low, high = self._limits
        everywhere = self._everywhere

        def solve(
            start: np.ndarray, iterations: int, bounds: tuple[np.ndarray, np.ndarray]
        ) -> Solution:
            return self.problem.solve(
                at_once,
                {name: goal},
                Mode.STATIONARY,
                AT_REST_S,
                start=start,
                free=free,
                bounds=bounds,
                iterations=iterations,
            )

        start = executed if self._last is None else self._last
        best = solve(start, _NEARBY, everywhere if self._beyond else self._limits)
        if self._beyond and best.missed > MISSED:  # there is no need to be beyond
            self._beyond = False
            best = solve(start, _OTHER, self._limits)
        if best.missed > MISSED or self._quiet >= _PERIOD:
            self._quiet = 0
            self._tries += 1
            beyond = not self._strict and best.missed > MISSED and self._turn % 2 == 1
            start = self._choose_start(qpos, goal, executed)
            other = solve(start, _OTHER, everywhere if beyond else self._limits)
            better = other.cost < _SHARE * best.cost - _BETTER
            if better and (not beyond or other.missed <= MISSED):
                best, self._beyond = other, beyond
        self._last = best.command
        left = self._compute_apart(executed)
        if left <= _FAR or not self._looks_at_way:
            self._detours = self._detours and left > _ARRIVED
        else:
            near = solve(executed, _OTHER, (np.minimum(low, executed), np.maximum(high, executed)))
            elsewhere = _SHARE * near.cost > best.cost + _BETTER
            self._detours |= elsewhere or self._is_stuck(left, solve(executed, 1, everywhere))
            inside = bool(((near.command >= low) & (near.command <= high)).all())
            if not elsewhere and (inside or (near.missed <= MISSED and not self._strict)):
                best, self._beyond = near, not inside
        self._last = best.command
        self._found = Found(best.command, best.missed, self._detours)
        return self._found

    def _compute_apart(self, executed: np.ndarray) -> float:
        """Largest distance of the posture executed from the last one found, of scale."""
        if self._last is None:
            return np.inf
        model = self.problem.command_model
        heeded = self._used & model.acting(Mode.STATIONARY) & ~model.is_velocity()
        apart = np.abs(self._last - executed)[heeded] / self.problem.scale[heeded]
        return float(apart.max(initial=0.0))

    def _note(self, qpos: np.ndarray, goal: np.ndarray) -> bool:
        """Whether a goal has moved, as far as it counts, on the base; if so take note of it."""
        weights, base = self.problem.weights, make_level(qpos[:7])
        if not weights.orientation[2]:
            base = make_pose(base[:3], quat_from_yaw(compute_heading(goal[3:])))
        place = pose_multiply(pose_inverse(base), goal)
        if self._noted is not None:
            away = (place[:3] - self._noted[:3])[np.array(weights.position) > 0]
            turned = np.linalg.norm(rotation_error(place[3:], self._noted[3:]))
            if np.linalg.norm(away) < _MOVED and turned < _TURNED:
                return False
        self._noted, self._tries = place, 0
        return True

    def _is_stuck(self, left: float, now: Solution) -> bool:
        """Whether a robot that misses its goal has not come nearer to the posture for a while."""
        if now.missed <= _STUCK or left < self._left - _NEARER:
            self._left, self._waited = left, 0
        self._waited += 1
        return self._waited > _PATIENCE

    def _choose_start(self, qpos: np.ndarray, goal: np.ndarray, executed: np.ndarray) -> np.ndarray:
        """The start whose turn it is. Shape (k,)."""
        turn = self._turn % _STARTS
        self._turn += 1
        if turn == 0:
            return executed
        if turn == 1:
            return self.space.neutral
        count, second = _STARTS - 2, self._turn // _STARTS % 2
        starts = self._repertoire.choose(qpos[:7], goal, self.problem.weights, 2 * count)
        if not len(starts):  # no posture that was drawn holds
            return self.space.neutral
        return starts[(second * count + turn - 2) % len(starts)]
