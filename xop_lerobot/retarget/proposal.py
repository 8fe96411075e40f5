"""The kinematic proposal: the command that would reach the goal if the robot were ideal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from xop_lerobot.command import Mode
from xop_lerobot.retarget.command_model import CommandModel
from xop_lerobot.retarget.config import CostWeights
from xop_lerobot.retarget.costs.lateral import compute_lateral
from xop_lerobot.retarget.costs.support import SupportArea
from xop_lerobot.retarget.kinematics import SiteKinematics
from xop_lerobot.transforms import heading_error

_DAMPING = 1e-3  # of the first step, in shares of a command's scale
_STEP = 1e-4  # finite-difference step, in shares of a command's scale


@dataclass(frozen=True)
class ProposalWeights:
    """Weights of the proposal's least squares.

    Attributes:
        position: Of the position error along x, y, z [1/m].
        orientation: Of roll, pitch and heading, as in `heading_error` [1/rad].
        effort: Of the command's distance from neutral, over its scale [1].
        support: Of the centre of mass beyond the support area [1/m].
        lean: Of the centre of mass from where it rests on the base [1/m].
        lateral: Of the wanted velocity across the heading of a base on wheels [s/m].
    """

    position: tuple[float, float, float] = (1.0, 1.0, 1.0)
    orientation: tuple[float, float, float] = (0.4, 0.4, 0.4)
    effort: float = 0.02
    support: float = 30.0
    lean: float = 0.0
    lateral: float = 0.0


def make_proposal_weights(weights: CostWeights) -> ProposalWeights:
    """Weights of the least squares that match those of the tracking cost."""
    turn = math.sqrt(weights.orientation / weights.position)
    tilt = turn * math.sqrt(weights.tilt_share)
    lean = math.sqrt(weights.lean / weights.position)
    lateral = math.sqrt(weights.lateral / weights.position)
    return ProposalWeights(orientation=(tilt, tilt, turn), lean=lean, lateral=lateral)


class KinematicProposal:
    r"""Solves :math:`\min_a \sum_f \|e_f(\phi_\tau(q, a))\|_W^2 + \|\rho (a - a_0)/s\|^2`.

    φ is the `CommandModel`, e the pose error of each tracked frame, :math:`a_0` the neutral
    command, s half the range of each entry and ρ its effort. A few
    Levenberg-Marquardt steps within the bounds; the Jacobian by finite differences, all columns
    in one batch.

    Args:
        command_model: What a command does.
        kinematics: Kinematics of the tracked frames' sites.
        sites: Site of each tracked frame.
        weights: Weights of the errors.
        support: Area over which the centre of mass stays, None for a robot that balances itself.
        iterations: Number of linearisations.
    """

    def __init__(
        self,
        command_model: CommandModel,
        kinematics: SiteKinematics,
        sites: Mapping[str, str],
        weights: ProposalWeights | None = None,
        support: SupportArea | None = None,
        iterations: int = 6,
    ) -> None:
        self.command_model, self.kinematics, self.sites = command_model, kinematics, dict(sites)
        self.weights = weights or ProposalWeights()
        self.support, self.iterations = support, iterations
        space = command_model.space
        self.scale = (space.high - space.low) / 2
        self._effort = self.weights.effort * np.array([e.effort for e in command_model.effects])

    def solve(
        self,
        qpos: np.ndarray,
        goals: Mapping[str, np.ndarray],
        mode: Mode,
        dt: float,
        *,
        start: np.ndarray | None = None,
        drift: np.ndarray | None = None,
        executed: np.ndarray | None = None,
        wanted_velocity: np.ndarray | None = None,
        free: np.ndarray | None = None,
    ) -> np.ndarray:
        """Compute the proposed command.

        Args:
            qpos: Configuration now. Shape (nq,).
            goals: Pose wanted after `dt` for each tracked frame. Shapes (7,).
            mode: Mode of the robot; entries without effect in it stay neutral.
            dt: Time to get there [s].
            start: Where to start the iteration; neutral by default. Shape (k,).
            drift: Base velocity beyond the commanded one. Shape (3,).
            executed: Command executed now, from which the robot ramps. Shape (k,).
            wanted_velocity: Velocity that a base on wheels shall be able to give [m/s]. (2,).
            free: Which entries may move; all that act by default. Shape (k,), bool.

        Returns:
            Command within the bounds. Shape (k,).
        """
        space = self.command_model.space
        free = self.command_model.acting(mode) if free is None else free
        index = np.flatnonzero(free)
        command = np.where(free, space.neutral if start is None else start, space.neutral)
        if not len(index) or not goals:
            return command
        low, high = space.low, space.high
        if executed is not None:  # beyond what can be reached in time nothing would change
            low = np.maximum(low, executed - space.max_rate * dt)
            high = np.minimum(high, executed + space.max_rate * dt)
        low, high = low[index], high[index]
        command[index] = np.clip(command[index], low, high)
        scale, effort = self.scale[index], self._effort[index]

        def compute_residuals(commands: np.ndarray) -> np.ndarray:
            future = self.command_model.extrapolate(qpos, commands, dt, mode, drift, executed)
            return self._compute_residuals(future, goals, wanted_velocity)

        best, least, damping = command, np.inf, _DAMPING
        matrix = gradient = np.zeros(0)
        for _ in range(self.iterations):
            batch = np.tile(command, (len(index) + 1, 1))
            batch[np.arange(1, len(index) + 1), index] += _STEP * scale
            residuals = compute_residuals(batch)
            share = (command[index] - space.neutral[index]) / scale
            cost = np.square(residuals[0]).sum() + np.square(effort * share).sum()
            if cost < least:  # a better point: linearise there, trust the step more
                best, least, damping = command, cost, damping / 4
                jacobian = (residuals[1:] - residuals[0]).T / _STEP  # per share of scale
                matrix = jacobian.T @ jacobian + np.diag(np.square(effort))
                gradient = jacobian.T @ residuals[0] + np.square(effort) * share
            elif not np.isfinite(least):
                return command  # not a number: nothing to improve on
            else:
                damping *= 16
            step = _solve_in_box(
                matrix + damping * np.eye(len(index)),
                gradient,
                (low - best[index]) / scale,
                (high - best[index]) / scale,
            )
            command = best.copy()
            command[index] = np.clip(best[index] + scale * step, low, high)
        return best

    def _compute_residuals(
        self,
        future: np.ndarray,
        goals: Mapping[str, np.ndarray],
        wanted_velocity: np.ndarray | None,
    ) -> np.ndarray:
        """Weighted errors of a batch of extrapolated configurations. Shape (n, residuals)."""
        sites = tuple(self.sites[name] for name in goals)
        bodies = self.kinematics.compute_bodies(future, sites, com=self.support is not None)
        poses = bodies.compute_poses(sites)
        parts = []
        for name, goal in goals.items():
            pose = poses[self.sites[name]]
            parts.append((pose[:, :3] - goal[:3]) * self.weights.position)
            parts.append(-heading_error(goal[3:], pose[:, 3:]) * self.weights.orientation)
        if self.support is not None:
            com = bodies.compute_com()[:, :2]
            base = future[:, :7]
            parts.append(self.weights.support * self.support.compute_excess(base, com))
            parts.append(self.weights.lean * self.support.compute_lean(base, com))
        if self.command_model.is_nonholonomic and wanted_velocity is not None:
            lateral = compute_lateral(future[:, :7], wanted_velocity)
            parts.append(self.weights.lateral * lateral[:, None])
        return np.concatenate(parts, axis=1)


def _solve_in_box(
    matrix: np.ndarray, gradient: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Minimise x'Hx/2 + g'x over low <= x <= high by fixing violated entries, worst first."""
    x = np.zeros(len(gradient))
    fixed = np.zeros(len(gradient), dtype=bool)
    for _ in range(len(gradient)):
        free = ~fixed
        if not free.any():
            break
        rhs = -gradient[free] - matrix[np.ix_(free, fixed)] @ x[fixed]
        x[free] = np.linalg.solve(matrix[np.ix_(free, free)], rhs)
        excess = np.maximum(low - x, x - high)
        excess[fixed] = 0
        worst = int(np.argmax(excess))
        if excess[worst] <= 1e-12:  # noqa: PLR2004
            break
        x[worst] = np.clip(x[worst], low[worst], high[worst])
        fixed[worst] = True
    return np.clip(x, low, high)
