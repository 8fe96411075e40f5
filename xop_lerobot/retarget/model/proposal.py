"""The kinematic proposal: the command that would reach the goal if the robot were ideal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import daqp
import mujoco
import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.transforms import quat_rotate, quat_yaw
from xop_lerobot.morphology.tuning import CostWeights
from xop_lerobot.retarget.costs.balance import SupportArea, compute_lateral
from xop_lerobot.retarget.model.command_model import CommandModel, Start
from xop_lerobot.retarget.model.heading import linearise_heading
from xop_lerobot.retarget.model.linearisation import Linearisation, find_site
from xop_lerobot.retarget.static_load import StaticLoad

_DAMPING = 1e-3  # of the first step, in shares of a command's scale
_CONVERGED = 1e-3  # a step that small ends the iteration, in shares of a command's scale
_DAQP_OPTIMAL = 1


class Solution(NamedTuple):
    """A command, and what it costs.

    Attributes:
        command: The command. Shape (k,).
        cost: The sum of squares.
        missed: That of the errors, without efforts.
    """

    command: np.ndarray
    cost: float
    missed: float


@dataclass(frozen=True)
class ProposalWeights:
    """Weights of the proposal's least squares.

    Attributes:
        position: Of the position error along x, y, z [1/m].
        orientation: Of the tilt about X and Y and of the heading, as in `heading_error` [1/rad].
        effort: Of the command's distance from the natural one, over its scale [1].
        change: Of its distance from the executed command, over its scale [1].
        support: Of the centre of mass beyond the support area [1/m].
        lean: Of the centre of mass from where it rests on the base [1/m].
        load: Of static torques beyond their share of what a motor can [1].
        lateral: Of the heading of a base on wheels beside where it shall face [1/rad].
    """

    position: tuple[float, float, float] = (1.0, 1.0, 1.0)
    orientation: tuple[float, float, float] = (0.4, 0.4, 0.4)
    effort: float = 0.02
    change: float = 0.0
    support: float = 30.0
    lean: float = 0.0
    lateral: float = 0.0
    load: float = 10.0


def make_proposal_weights(weights: CostWeights, *, upright: bool = False) -> ProposalWeights:
    """Weights of the least squares that match those of the cost.

    Args:
        weights: Weights of the cost.
        upright: Whether hands are kept level. Their goals are level then, and the weight of the
            constraint adds to that of their tilt.
    """
    turn = math.sqrt(weights.orientation / weights.position)
    tilted = weights.orientation * weights.tilt_share + (weights.upright if upright else 0.0)
    tilt = math.sqrt(tilted / weights.position)
    lean = math.sqrt(weights.lean / weights.position)
    lateral = math.sqrt(weights.lateral / weights.position)
    change = math.sqrt(weights.change / weights.position)
    return ProposalWeights(
        orientation=(tilt, tilt, turn), change=change, lean=lean, lateral=lateral
    )


class KinematicProposal:
    r"""Solves the least squares of the command that brings the tracked frames to their goals.

    .. math::

        \min_a \sum_f \|e_f(\phi_\tau(q, a))\|_W^2 + \|\rho (a - a_0)/s\|^2
        + \|\delta (a - a_{exec})/s\|^2

    φ is the `CommandModel`, e the pose error of each tracked frame, :math:`a_0` a natural
    command, neutral by default, s half the range of each entry and ρ its effort; δ, the weight of
    a change, damps what near a singularity would take large motions for little. A few
    Levenberg-Marquardt steps within the bounds, each a small quadratic program solved by DAQP;
    the Jacobian is :math:`J_{site}(\phi)\,\partial\phi/\partial a`, by MuJoCo.

    Args:
        model: The robot's model.
        command_model: What a command does.
        sites: Site of each tracked frame.
        weights: Weights of the errors.
        support: Area over which the centre of mass stays, None for a robot that balances itself.
        base_body: The robot's root body, whose centre of mass `support` is about.
        load: What joints bear of the weight above them, None where that does not count.
        iterations: Largest number of linearisations.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        command_model: CommandModel,
        sites: Mapping[str, str],
        weights: ProposalWeights | None = None,
        support: SupportArea | None = None,
        base_body: str = "",
        load: StaticLoad | None = None,
        iterations: int = 6,
    ) -> None:
        self.command_model, self.sites = command_model, dict(sites)
        self.weights = weights or ProposalWeights()
        self._position = np.array(self.weights.position)
        self._orientation = np.array(self.weights.orientation)
        self.support, self.load, self.iterations = support, load, iterations
        self._linearisation = Linearisation(model)
        self._site_ids = {name: find_site(model, site) for name, site in self.sites.items()}
        self._base = model.body(base_body).id if support is not None else 0
        space = command_model.space
        self.scale = (space.high - space.low) / 2
        self._effort = np.array([e.effort for e in command_model.effects])

    def solve(
        self,
        begin: Start,
        goals: Mapping[str, np.ndarray],
        mode: Mode,
        dt: float,
        *,
        start: np.ndarray | None = None,
        facing: np.ndarray | None = None,
        free: np.ndarray | None = None,
        natural: np.ndarray | None = None,
        balance: np.ndarray | None = None,
        bounds: tuple[np.ndarray, np.ndarray] | None = None,
        iterations: int | None = None,
    ) -> Solution:
        """Compute the proposed command, and what it costs.

        Args:
            begin: Where the robot is.
            goals: Pose wanted after `dt` for each tracked frame. Shapes (7,).
            mode: Mode of the robot; entries without effect in it stay neutral.
            dt: Time to get there [s].
            start: Where to start the iteration; neutral by default. Shape (k,).
            facing: Where a base on wheels shall face, as in `Evaluation`. Shape (2,).
            free: Which entries may move; all that act by default. The others stay at `natural`.
                Shape (k,), bool.
            natural: Command from which efforts count; neutral by default. Shape (k,).
            balance: Where the centre of mass shall rest on the base, from which a lean counts;
                where it does as the robot stands by default. Shape (2,).
            bounds: Lower and upper bounds; those of the command by default. Shapes (k,).
            iterations: Largest number of linearisations; that of the class by default.

        Returns:
            Command within the bounds, and its costs; no costs without goals.
        """
        executed = begin.executed
        space = self.command_model.space
        free = self.command_model.acting(mode) if free is None else free
        index = np.flatnonzero(free)
        natural = space.neutral if natural is None else natural
        command = np.where(free, natural if start is None else start, natural)
        if not len(index) or not goals:
            return Solution(command, 0.0, 0.0)
        low, high = bounds or space.bounds(mode)
        if executed is not None:  # beyond what can be reached in time nothing would change
            reach = space.compute_max_rate(mode, executed) * dt
            low, high = np.maximum(low, executed - reach), np.minimum(high, executed + reach)
        low, high = low[index], high[index]
        high = np.maximum(low, high)  # an executed command may be out of the bounds
        command[index] = np.clip(command[index], low, high)
        scale, effort = self.scale[index], self.weights.effort * self._effort[index]
        change = self.weights.change if executed is not None else 0.0
        last = command[index] if executed is None else executed[index]
        none, sense = np.zeros((0, len(index))), np.zeros(len(index), dtype=np.int32)

        best, least, missed, damping = command, np.inf, np.inf, _DAMPING
        matrix = gradient = np.zeros(0)
        for _ in range(iterations or self.iterations):
            residual, jacobian = self.linearise(
                begin, command, goals, mode, dt, facing=facing, balance=balance
            )
            share = (command[index] - natural[index]) / scale
            moved = change * (command[index] - last) / scale
            squares = float(residual @ residual)
            cost = squares + float(np.square(effort * share).sum() + moved @ moved)
            if cost < least:  # a better point: linearise there, trust the step more
                best, least, missed, damping = command, cost, squares, damping / 4
                scaled = jacobian[:, index] * scale
                matrix = scaled.T @ scaled + np.diag(np.square(effort) + change**2)
                gradient = scaled.T @ residual + np.square(effort) * share + change * moved
            elif not np.isfinite(least):
                return Solution(command, cost, squares)  # not a number: nothing to improve on
            else:
                damping *= 16
            damped = matrix + damping * np.eye(len(index))
            upper, lower = (high - best[index]) / scale, (low - best[index]) / scale
            step, _, status, _ = daqp.solve(damped, gradient, none, upper, lower, sense)
            if status != _DAQP_OPTIMAL or np.abs(step).max() < _CONVERGED:
                break
            command = best.copy()
            command[index] = np.clip(best[index] + scale * step, low, high)
        return Solution(best, least, missed)

    def linearise(
        self,
        begin: Start,
        command: np.ndarray,
        goals: Mapping[str, np.ndarray],
        mode: Mode,
        dt: float,
        *,
        facing: np.ndarray | None = None,
        balance: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute the weighted errors after `dt` of a command and their derivative by it.

        Args: as for `solve`.

        Returns:
            Residuals, shape (m,), and their Jacobian, shape (m, k).
        """
        model, weights = self.command_model, self.weights
        future, motion = model.linearise(begin, command, dt, mode)
        self._linearisation.update(future)
        residuals, jacobians = [], []
        for name, goal in goals.items():
            position, quat, linear, angular = self._linearisation.compute_site(self._site_ids[name])
            gain = self._position
            residuals.append((position - goal[:3]) * gain)
            jacobians.append(gain[:, None] * (linear @ motion))
            error, by_rotation = linearise_heading(goal[3:], quat)
            gain = self._orientation
            residuals.append(-error * gain)
            jacobians.append(gain[:, None] * (by_rotation @ (angular @ motion)))
        if self.support is not None:
            self._add_support(future, motion, balance, residuals, jacobians)
        if self.load is not None and self.weights.load:
            excess, by_joints = self._linearisation.compute_load(self.load)
            residuals.append(self.weights.load * excess)
            jacobians.append(self.weights.load * (by_joints @ motion))
        if model.is_nonholonomic and facing is not None and weights.lateral:
            self._add_lateral(future, motion, facing, residuals, jacobians)
        return np.concatenate(residuals), np.concatenate(jacobians)

    def _add_support(
        self,
        future: np.ndarray,
        motion: np.ndarray,
        balance: np.ndarray | None,
        residuals: list[np.ndarray],
        jacobians: list[np.ndarray],
    ) -> None:
        """Centre of mass beyond the support area, and from where it rests on the base."""
        assert self.support is not None
        com, by_joints = self._linearisation.compute_com(self._base)
        yaw = float(quat_yaw(future[3:7]))
        to_base = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
        # The base takes its mass with it: in the base's frame only joints move the centre.
        place = to_base @ (by_joints[:2, 6:] @ motion[6:])
        excess, by_place = self.support.linearise_excess(future[:7], com[:2])
        residuals.append(self.weights.support * excess)
        jacobians.append(self.weights.support * (by_place @ place))
        if self.weights.lean:
            lean, by_place = self.support.linearise_lean(future[:7], com[:2], balance)
            residuals.append(self.weights.lean * lean)
            jacobians.append(self.weights.lean * (by_place @ place))

    def _add_lateral(
        self,
        future: np.ndarray,
        motion: np.ndarray,
        facing: np.ndarray,
        residuals: list[np.ndarray],
        jacobians: list[np.ndarray],
    ) -> None:
        """Heading of the base beside where it shall face."""
        lateral = float(compute_lateral(future[:7], facing))
        # A turn about the vertical by one radian turns the heading by one.
        turn = quat_rotate(future[3:7], motion[3:6].T)[:, 2]
        residuals.append(np.array([self.weights.lateral * lateral]))
        jacobians.append(-self.weights.lateral * math.hypot(*facing) * turn[None])


def pace(executed: np.ndarray, wanted: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Go from one command towards another as far as no entry moves by more than its `reach`.

    All entries then arrive together, and a chain keeps its shape on the way: with each at its
    own rate, a hand tilts while the torso below it is still moving. Shapes (n,).
    """
    distance = np.abs(wanted - executed)
    share = float(np.min(reach / np.maximum(distance, 1e-12), initial=1.0))
    return executed + min(share, 1.0) * (wanted - executed)
