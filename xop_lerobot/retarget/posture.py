"""The posture in which a robot would be at a goal, looked for from several starts."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from xop_lerobot.command import Mode
from xop_lerobot.retarget.command_model import CommandModel
from xop_lerobot.retarget.costs.support import SupportArea
from xop_lerobot.retarget.linearisation import Placement
from xop_lerobot.retarget.proposal import KinematicProposal, ProposalWeights, Solution
from xop_lerobot.retarget.static_load import StaticLoad
from xop_lerobot.transforms import (
    compute_heading_squares,
    make_pose,
    pose_multiply,
    quat_from_yaw,
    quat_yaw,
    sum_squares,
)

AT_REST_S = 20.0
"""Time after which a robot has taken a command up, whatever its lags [s]."""
_COUNT = 400  # postures that are drawn at first
_MISSED = 4e-4  # cost from which a goal counts as missed, and others are tried: 2 cm
_BETTER, _SHARE = 4e-4, 0.8  # by which, and to what share, another posture must be cheaper
_PERIOD = 25  # solves after which another start is tried though nothing is missed
_NEARBY, _OTHER = 6, 12  # iterations from the last posture, and from elsewhere
_STARTS = 6  # starts that are tried in turn
_FAR = 0.12  # distance of a posture from which on the way there is looked at, of scale


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
        qpos = command_model.extrapolate(standing, commands, AT_REST_S, Mode.STATIONARY)
        placement = Placement(model, (site,), com_of=base_body)
        poses, _, com = placement.compute(qpos)
        held = np.ones(_COUNT, dtype=bool)
        if support is not None:
            held &= (support.compute_excess(qpos[:, :7], com[:, :2]) <= 0).all(axis=-1)
        if load is not None:
            held &= (load.compute_excess(qpos) <= 0).all(axis=-1)
        self._commands, self._poses = commands[held], poses[site][held]

    def choose(
        self, base: np.ndarray, goal: np.ndarray, weights: ProposalWeights, count: int
    ) -> np.ndarray:
        """The commands whose postures come nearest to a goal, for a base at `base`.

        Shapes (7,), (7,) -> (n, k).
        """
        place = make_pose([*base[:2], 0.0], quat_from_yaw(quat_yaw(base[3:])))
        poses = pose_multiply(place, self._poses)
        error = sum_squares((poses[:, :3] - goal[:3]) * weights.position)
        turn, tilt = compute_heading_squares(goal[3:], poses[:, 3:])
        error += weights.orientation[2] ** 2 * turn + weights.orientation[0] ** 2 * tilt
        return self._commands[np.argsort(error)[:count]]


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
    """

    def __init__(
        self,
        problem: KinematicProposal,
        repertoire: Repertoire,
        used: np.ndarray,
        limits: tuple[np.ndarray, np.ndarray],
        *,
        strict: bool = False,
    ) -> None:
        self.problem, self._repertoire, self._used = problem, repertoire, used
        self._limits, self._strict = limits, strict
        self._heeded = used & ~problem.command_model.is_velocity()
        self.reset()

    def reset(self) -> None:
        """Forget the last solution."""
        self._last: np.ndarray | None = None
        self._turn = self._quiet = 0
        self._beyond = False

    def find(
        self,
        name: str,
        qpos: np.ndarray,
        goal: np.ndarray,
        executed: np.ndarray,
        offset: np.ndarray,
        settled: np.ndarray,
    ) -> Found:
        """Find the posture for a goal.

        Args:
            name: The tracked frame.
            qpos: Configuration now. Shape (nq,).
            goal: Its goal. Shape (7,).
            executed: Command executed now. Shape (k,).
            offset: As for `CommandModel.extrapolate`. Shape (k,).
            settled: As for `CommandModel.extrapolate`. Shape (k,).
        """

        def solve(start: np.ndarray, iterations: int, *, beyond: bool) -> Solution:
            return self.problem.solve_from(
                qpos,
                {name: goal},
                Mode.STATIONARY,
                AT_REST_S,
                start=start,
                free=self._used & self.problem.command_model.acting(Mode.STATIONARY),
                offset=offset,
                settled=settled,
                bounds=None if beyond else self._limits,
                iterations=iterations,
            )

        start = executed if self._last is None else self._last
        best = solve(start, _NEARBY, beyond=self._beyond)
        if self._beyond and best.missed > _MISSED:  # there is no need to be beyond
            self._beyond = False
            best = solve(start, _OTHER, beyond=False)
        self._quiet += 1
        if best.missed > _MISSED or self._quiet >= _PERIOD:
            self._quiet = 0
            beyond = not self._strict and best.missed > _MISSED and self._turn % 2 == 1
            other = solve(self._choose_start(qpos, goal, executed), _OTHER, beyond=beyond)
            better = other.cost < _SHARE * best.cost - _BETTER
            if better and (not beyond or other.missed <= _MISSED):
                best, self._beyond = other, beyond
        detour = False
        apart = np.abs(best.command - executed)[self._heeded] / self.problem.scale[self._heeded]
        if apart.max(initial=0.0) > _FAR:
            near = solve(executed, _OTHER, beyond=self._beyond)
            detour = _SHARE * near.cost > best.cost + _BETTER
            if not detour:
                best = near
        self._last = best.command
        return Found(best.command, best.missed, detour)

    def _choose_start(self, qpos: np.ndarray, goal: np.ndarray, executed: np.ndarray) -> np.ndarray:
        """The start whose turn it is. Shape (k,)."""
        turn, self._turn = self._turn, (self._turn + 1) % _STARTS
        if turn == 0:
            return executed
        if turn == 1:
            return self.problem.command_model.space.neutral
        count = _STARTS - 2
        starts = self._repertoire.choose(qpos[:7], goal, self.problem.weights, count)
        return starts[(turn - 2) % len(starts)]
