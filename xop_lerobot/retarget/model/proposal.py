"""Kinematic proposal: the command with which an ideal robot would reach its goals in a given time.

`KinematicProposal` is a box-constrained, damped nonlinear least-squares solver over the
`CommandModel`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import daqp
import mujoco
import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.state import HEAD
from xop_lerobot.core.transforms import quat_rotate, quat_yaw
from xop_lerobot.morphology.tuning import CostWeights
from xop_lerobot.retarget.costs.balance import SupportArea, compute_lateral
from xop_lerobot.retarget.model.command_model import CommandModel, Start
from xop_lerobot.retarget.model.heading import linearise_heading
from xop_lerobot.retarget.model.linearisation import Linearisation, find_site
from xop_lerobot.retarget.static_load import StaticLoad

_DAMPING = 1e-3  # initial Levenberg-Marquardt damping, for entries in half ranges
_CONVERGED = 1e-3  # largest entry of a step that ends the iteration [half ranges]
_DAQP_OPTIMAL = 1  # DAQP's exit flag for an optimal solution


class Solution(NamedTuple):
    """A command and its cost.

    Attributes:
        command: The command. Shape (k,).
        cost: Total sum of squares.
        missed: Sum of squares of the residuals without effort and change.
    """

    command: np.ndarray
    cost: float
    missed: float


@dataclass(frozen=True)
class ProposalWeights:
    """Weights of the proposal's residuals; the cost is their sum of squares.

    Attributes:
        position: Position error along x, y, z [1/m].
        orientation: Tilt about X and Y, then heading, as in `heading_error` [1/rad].
        effort: Distance of the command from the natural one, in half ranges [1].
        change: Distance of the command from the executed one, in half ranges [1].
        support: Distance of the centre of mass beyond the support area [1/m].
        lean: Distance of the centre of mass from its rest position on the base [1/m].
        load: Static torques beyond their allowed share of the motor limits [1].
        lateral: Heading error of a wheeled base [1/rad].
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
    """Residual weights that match the weights of the cost, relative to that of the position.

    Args:
        weights: Weights of the cost.
        upright: Whether hands are kept level. Their goals are level then, so the weight of the
            constraint adds to that of the tilt.
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
    r"""Nonlinear least squares for the command that brings the tracked frames to their goals.

    .. math::

        \min_a \sum_f \|e_f(\phi_\tau(q, a))\|_W^2 + \|\rho (a - a_0)/s\|^2
        + \|\delta (a - a_{exec})/s\|^2

    φ is the `CommandModel`, e the pose error of each tracked frame, :math:`a_0` the natural
    command (neutral by default), s half the range of each entry and ρ its effort; δ, the weight of
    a change, damps large motions of little effect near singularities. Solved by a few
    Levenberg-Marquardt steps within the bounds, each a small quadratic program for DAQP. The
    Jacobian is :math:`J_{site}(\phi)\,\partial\phi/\partial a`, by MuJoCo.

    Args:
        model: The robot's model.
        command_model: First-order model of the effect of a command.
        sites: Site of each tracked frame.
        weights: Weights of the residuals.
        support: Support area for the centre of mass; None for a robot that balances itself.
        base_body: The robot's root body, for the centre of mass.
        load: Static loads of the joints; None if they are not limited.
        iterations: Largest number of linearisations.
        limits_gaze: Whether a neck turns no further than the head's goal: without that, chest and
            neck twist against each other. The neck alone may have to turn back from the chest.
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
        limits_gaze: bool = True,
    ) -> None:
        self.command_model, self.sites = command_model, dict(sites)
        self.weights = weights or ProposalWeights()
        self._position = np.array(self.weights.position)
        self._orientation = np.array(self.weights.orientation)
        self.support, self.load, self.iterations = support, load, iterations
        self._limits_gaze = limits_gaze
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
        """Compute the proposed command and its cost.

        Args:
            begin: Initial state.
            goals: Desired pose of each tracked frame after `dt`. Shapes (7,).
            mode: Mode of the robot; entries without effect in it stay neutral.
            dt: Time to reach the goals [s].
            start: Initial guess; `natural` by default. Shape (k,).
            facing: Desired heading of a wheeled base, as in `Evaluation`. Shape (2,).
            free: Mask of the entries that may move, the others stay at `natural`; by default all
                that act. Shape (k,), bool.
            natural: Command of zero effort; neutral by default. Shape (k,).
            balance: Desired position of the centre of mass on the base, from which lean counts; by
                default that of the standing robot. Shape (2,).
            bounds: Lower and upper bounds; those of the mode by default. Shapes (k,).
            iterations: Largest number of linearisations; that of the constructor by default.

        Returns:
            Command within the bounds, and its cost; zero cost without goals.
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
        if self._limits_gaze and HEAD in goals:
            bounds = self.command_model.limit_gaze((low, high), goals[HEAD], begin.qpos[:7], mode)
            low, high = bounds
        if executed is not None:  # commands beyond the rate limits have no further effect
            reach = space.compute_max_rate(mode, executed) * dt
            low, high = np.maximum(low, executed - reach), np.minimum(high, executed + reach)
        low, high = low[index], high[index]
        high = np.maximum(low, high)  # the executed command may lie outside the bounds
        command[index] = np.clip(command[index], low, high)
        scale, effort = self.scale[index], self.weights.effort * self._effort[index]
        change = self.weights.change if executed is not None else 0.0
        last = command[index] if executed is None else executed[index]
        no_rows = np.zeros((0, len(index)))  # DAQP: bounds only, no general constraints
        sense = np.zeros(len(index), dtype=np.int32)  # all of them inequalities

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
            # Levenberg-Marquardt: less damping after an improvement, much more after a failed
            # step, which is retried from the best point with its old linearisation.
            if cost < least:
                best, least, missed, damping = command, cost, squares, damping / 4
                scaled = jacobian[:, index] * scale
                matrix = scaled.T @ scaled + np.diag(np.square(effort) + change**2)
                gradient = scaled.T @ residual + np.square(effort) * share + change * moved
            elif not np.isfinite(least):
                return Solution(command, cost, squares)  # NaN at the initial guess
            else:
                damping *= 16
            damped = matrix + damping * np.eye(len(index))
            upper, lower = (high - best[index]) / scale, (low - best[index]) / scale
            step, _, status, _ = daqp.solve(damped, gradient, no_rows, upper, lower, sense)
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
        """Compute the weighted residuals after `dt` of a command, and their derivative by it.

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
        """Append the residuals of the centre of mass: beyond the support area, and lean."""
        assert self.support is not None
        com, by_joints = self._linearisation.compute_com(self._base)
        yaw = float(quat_yaw(future[3:7]))
        to_base = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
        # In the base's frame only the joints (columns from 6 on) move the centre of mass.
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
        """Append the heading error of the base."""
        lateral = float(compute_lateral(future[:7], facing))
        # Vertical component of the base's angular velocity in the world: rate of its heading.
        turn = quat_rotate(future[3:7], motion[3:6].T)[:, 2]
        residuals.append(np.array([self.weights.lateral * lateral]))
        jacobians.append(-self.weights.lateral * math.hypot(*facing) * turn[None])


def pace(executed: np.ndarray, wanted: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Scale the step between two commands so that no entry moves by more than its `reach`.

    All entries then arrive together, and the hand keeps its orientation on the way; with every
    entry at its own rate it would tilt while the torso below it is still moving. Shapes (n,).
    """
    distance = np.abs(wanted - executed)
    share = float(np.min(reach / np.maximum(distance, 1e-12), initial=1.0))
    return executed + min(share, 1.0) * (wanted - executed)
