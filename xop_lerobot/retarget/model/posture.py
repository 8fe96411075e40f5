"""Multi-start search for the posture of a robot at a goal.

`PostureSearch` solves the least squares of `KinematicProposal` without rate limits from several
initial guesses, among them random postures of a `Repertoire`.
"""

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
"""Time after which a robot has settled on a command, whatever its lags [s]."""
_COUNT = 1000  # random postures that are drawn
MISSED = 4e-4  # cost above which a goal counts as missed and other starts are tried: (2 cm)²
# Margin and factor by which another posture must be cheaper, so that the search does not oscillate.
_BETTER, _SHARE = 4e-4, 0.95
_PERIOD = 25  # solves after which another start is tried although the goal is met
_MOVED, _TURNED = 0.01, 0.03  # change of a goal that restarts the search [m], [rad]
_NEARBY, _OTHER = 4, 12  # iterations from the last posture, and from another start
_STARTS = 7  # starts tried in turn; odd, so that each is tried within and beyond the limits
_FAR = 0.12  # distance to the posture above which detours are detected [half ranges]
_ARRIVED = 0.05  # distance at which a detour ends [half ranges]
_NEARER, _PATIENCE = 0.02, 8  # progress [half ranges] expected within a number of solves
_STUCK = 1.6e-3  # cost above which that progress is expected: (4 cm)²


class Found(NamedTuple):
    """Result of a posture search.

    Attributes:
        command: The command that holds the posture. Shape (k,).
        missed: Weighted squared error from the goal.
        detour: Whether the path to it leads away from the goal at first: no small change of the
            present posture brings the robot closer.
    """

    command: np.ndarray
    missed: float
    detour: bool


class Repertoire:
    """Random postures that the robot can hold statically.

    Args:
        model: The robot's model.
        command_model: First-order model of the effect of a command.
        standing: Configuration in which it stands at the origin. Shape (nq,).
        site: Site of the head.
        base_body: The robot's root body.
        support: Support area for the centre of mass; None for a robot that balances itself.
        load: Static loads of the joints.

    Attributes:
        commands: Commands of the postures. Shape (n, k).
        poses: Head poses in the postures. Shape (n, 7).
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
        """Commands of the `count` postures closest to a goal, for a base at `base`.

        Shapes (7,), (7,) -> (n, k).
        """
        poses = pose_multiply(_project_on_ground(base), self.poses)
        error = sum_squares((poses[:, :3] - goal[:3]) * weights.position)
        turn, tilt = compute_heading_squares(goal[3:], poses[:, 3:])
        error += weights.orientation[2] ** 2 * turn + weights.orientation[0] ** 2 * tilt
        return self.commands[np.argsort(error)[:count]]


def _project_on_ground(base: np.ndarray) -> np.ndarray:
    """Pose of a base with height and tilt set to zero. Shape (7,)."""
    return make_pose(np.array([*base[:2], 0.0]), quat_from_yaw(quat_yaw(base[3:])))


class PostureSearch:
    r"""Finds the command that a robot at its goal would hold, regardless of the path there.

    It solves the least squares of `KinematicProposal` without rate limits, for a robot at rest.
    They have local minima: knees that bend forward or backward, a waist turned the other way
    round. So each call starts from the last solution; while that misses the goal, and from time to
    time anyway, one more start is tried: the executed posture, the neutral one, or one of those in
    a `Repertoire` that are closest to the goal. The better solution is kept.

    Args:
        problem: The least-squares problem.
        repertoire: Random postures to start from.
        used: Entries that make the posture; the others stay neutral. Shape (k,), bool.
        limits: Preferred bounds of a posture. Shapes (k,).
        strict: Whether the bounds hold even if only a posture beyond them reaches the goal.
        detects_detours: Whether it detects detours.
    """

    def __init__(
        self,
        problem: KinematicProposal,
        repertoire: Repertoire,
        used: np.ndarray,
        limits: tuple[np.ndarray, np.ndarray],
        *,
        strict: bool = False,
        detects_detours: bool = True,
    ) -> None:
        self.problem, self._repertoire, self._used = problem, repertoire, used
        self.space = problem.command_model.space
        self._limits = self._restrict(limits)
        self._everywhere = self._restrict((self.space.low, self.space.high))
        self._strict, self._detects_detours = strict, detects_detours
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
            state: The planner's state, with the executed command.
            goal: Its goal. Shape (7,).
        """
        qpos, executed = state.qpos, state.executed
        at_once = state.start.without_ramp()
        free = self._used & self.problem.command_model.acting(Mode.STATIONARY)
        moved = self._note(qpos, goal)
        apart = self._compute_apart(executed)
        is_close = apart <= _FAR or not self._detects_detours
        if not moved and is_close and not self._detours and self._last is not None:
            # A constant goal needs no more solves once it is met or known to be out of reach.
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
        if self._beyond and best.missed > MISSED:  # beyond the limits without reaching the goal
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
        if left <= _FAR or not self._detects_detours:
            self._detours = self._detours and left > _ARRIVED
        else:
            # Local solution from the executed posture: if it is worse, or the robot makes no
            # progress towards the posture found, moving there is a detour.
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
        """Largest distance of the executed posture from the last one found [half ranges]."""
        if self._last is None:
            return np.inf
        model = self.problem.command_model
        relevant = self._used & model.acting(Mode.STATIONARY) & ~model.is_velocity()
        apart = np.abs(self._last - executed)[relevant] / self.problem.scale[relevant]
        return float(apart.max(initial=0.0))

    def _note(self, qpos: np.ndarray, goal: np.ndarray) -> bool:
        """Whether the weighted part of a goal has moved relative to the base; records it if so."""
        weights, base = self.problem.weights, _project_on_ground(qpos[:7])
        if not weights.orientation[2]:  # the heading has no weight: ignore turns of the base
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
        """Whether a robot that misses its goal makes no progress towards the posture."""
        if now.missed <= _STUCK or left < self._left - _NEARER:
            self._left, self._waited = left, 0
        self._waited += 1
        return self._waited > _PATIENCE

    def _choose_start(self, qpos: np.ndarray, goal: np.ndarray, executed: np.ndarray) -> np.ndarray:
        """The next initial guess. Shape (k,)."""
        turn = self._turn % _STARTS
        self._turn += 1
        if turn == 0:
            return executed
        if turn == 1:
            return self.space.neutral
        # Alternate between the closest postures and the next closest ones.
        count, second = _STARTS - 2, self._turn // _STARTS % 2
        starts = self._repertoire.choose(qpos[:7], goal, self.problem.weights, 2 * count)
        if not len(starts):  # none of the random postures can be held
            return self.space.neutral
        return starts[(second * count + turn - 2) % len(starts)]
