"""Fixed candidate commands that are tried beside the noisy samples, and the safety check of a plan.

`Candidates` makes the commands; `judge` slows down or vetoes a plan whose samples fall or collide.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import NamedTuple

import mujoco
import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.state import HEAD, Goal, RobotState
from xop_lerobot.low_level.policy import POLICY_DT
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.morphology.tuning import MpcConfig
from xop_lerobot.retarget.costs.balance import SupportArea
from xop_lerobot.retarget.decision import DecisionSpace
from xop_lerobot.retarget.direct import DirectRetargeter
from xop_lerobot.retarget.model.command_model import CommandModel, PlannerState
from xop_lerobot.retarget.model.proposal import (
    KinematicProposal,
    ProposalWeights,
    make_proposal_weights,
    pace,
)
from xop_lerobot.retarget.references import Reference
from xop_lerobot.retarget.static_load import StaticLoad

_LOOK_S = 0.1  # time in which a neck turns to the goal of the head [s]
_NECK_EFFORT = 0.002  # small: the neck alone is left to turn the head


class Candidates:
    """Makes the commands that `MpcConfig.candidates` names.

    Args:
        morphology: The robot.
        model: Its planning model.
        decision: Layout of the decision vector.
        command_model: First-order model of the effect of a decision.
        support: Support area for the centre of mass; None for a robot that balances itself.
        load: Static loads of the joints; None if they are not limited.

    Attributes:
        proposals: The kinematic proposal of each mode.
    """

    def __init__(
        self,
        morphology: Morphology,
        model: mujoco.MjModel,
        decision: DecisionSpace,
        command_model: CommandModel,
        support: SupportArea | None,
        load: StaticLoad | None = None,
    ) -> None:
        self._morphology, self._model = morphology, model
        self._support, self._load = support, load
        self._decision, self._command_model = decision, command_model
        self._direct: DirectRetargeter | None = None
        self.proposals: dict[Mode, KinematicProposal] = {}
        self._neck: KinematicProposal | None = None

    def configure(
        self, configs: Mapping[Mode, MpcConfig], sites: Mapping[str, str], upright: bool
    ) -> None:
        """Set the parameters, and the targets with their sites."""
        self.proposals = {
            mode: KinematicProposal(
                self._model,
                self._command_model,
                sites,
                make_proposal_weights(config.weights, upright=upright),
                self._support,
                self._morphology.base_body,
                self._load,
            )
            for mode, config in configs.items()
        }
        self._neck = None
        if HEAD in sites and (self._command_model.neck & self._command_model.body).any():
            weights = ProposalWeights(position=(0.0, 0.0, 0.0), effort=_NECK_EFFORT)
            head = {HEAD: sites[HEAD]}
            self._neck = KinematicProposal(
                self._model, self._command_model, head, weights, limits_gaze=False
            )

    def reset(self) -> None:
        """Forget the state of the direct mapping."""
        self._direct = None

    def propose(
        self,
        state: PlannerState,
        reference: Reference,
        mode: Mode,
        config: MpcConfig,
        start: np.ndarray,
    ) -> np.ndarray:
        """Compute the kinematic proposal, or the executed command if `config` uses none.

        Args:
            state: The planner's state, with the executed decision.
            reference: The reference trajectory; its last goals are those of the proposal.
            mode: Mode of the robot.
            config: Parameters of the mode.
            start: Initial guess. Shape (n,).

        Returns:
            Decision. Shape (n,).
        """
        executed, served = state.executed, reference.served
        if "proposal" not in config.candidates and config.control_reference != "proposal":
            return executed
        natural, free = None, None
        if served is not None:
            natural = served.natural
            if served.detour:  # move straight to the posture; only the velocities are optimised
                reach = self._decision.space.compute_max_rate(mode, executed) * config.proposal_s
                natural = start = pace(executed, natural, reach)
                free = self._command_model.acting(mode) & self._command_model.is_velocity()
        solution = self.proposals[mode].solve(
            state.start,
            {name: track[-1] for name, track in reference.goals.items()},
            mode,
            config.proposal_s,
            start=start,
            facing=reference.facing,
            free=free,
            natural=natural,
            balance=reference.balance,
        )
        if not np.isfinite(solution.command).all():
            return executed
        return self._look(solution.command, state, reference, mode, config)

    def _look(
        self,
        command: np.ndarray,
        state: PlannerState,
        reference: Reference,
        mode: Mode,
        config: MpcConfig,
    ) -> np.ndarray:
        """Turn the neck at once by what the chest leaves to it until `_LOOK_S`. Shape (n,)."""
        if self._neck is None or HEAD not in reference.goals:
            return command
        step = min(round(_LOOK_S / POLICY_DT), config.horizon)
        return self._neck.solve(
            state.start,
            {HEAD: reference.goals[HEAD][step]},
            mode,
            max(step, 1) * POLICY_DT,
            natural=command,
            free=self._command_model.acting(mode) & self._command_model.neck,
        ).command

    def collect(
        self,
        state: RobotState,
        goal: Goal,
        now: PlannerState,
        proposal: np.ndarray,
        config: MpcConfig,
    ) -> np.ndarray:
        """The fixed candidates, in the order of `config.candidates`. Shape (c, n)."""
        candidates, executed = [], now.executed
        space = self._decision.space
        for name in config.candidates:
            if name == "proposal":
                candidates.append(proposal)
            elif name == "paced":
                # As far as the rate limits allow within two control periods.
                rates = space.compute_max_rate(goal.mode, executed)
                candidates.append(pace(executed, proposal, rates * 2 / config.control_hz))
            elif name == "direct":
                candidates.append(self._decision.join(self._map(state, goal), state.arms))
            elif name == "previous":
                candidates.append(executed)
            else:  # "stop"
                candidates.append(np.where(self._command_model.is_velocity(), 0.0, executed))
        return np.array(candidates).reshape(-1, len(space))

    def _map(self, state: RobotState, goal: Goal) -> np.ndarray:
        """Command of the direct mapping. Shape (k,)."""
        if self._direct is None:
            self._direct = DirectRetargeter(self._morphology, self._model)
            self._direct.reset(state)
        return self._direct.plan(state, goal).command


_SLOW, _VETO = 0.1, 0.5  # risk above which a plan is slowed down, and from which it is vetoed


class Intervention(IntEnum):
    """Reason why a plan differs from the weighted mean of its samples."""

    NONE = 0
    SLOWED_FALL = 1
    """Velocities are reduced: some of the weight is on samples that fall."""
    SLOWED_COLLISION = 2
    """Velocities are reduced: some of the weight is on samples that touch an obstacle."""
    VETOED_FALL = 3
    """The plan is replaced by the best safe sample: most of the weight is on falls."""
    VETOED_COLLISION = 4
    """The plan is replaced by the best safe sample: most of the weight is on collisions."""
    DIVERGED = 5
    """No prediction is finite: velocities go to zero, the posture is held."""


class Verdict(NamedTuple):
    """Result of the safety check of a plan.

    Attributes:
        intervention: The intervention and its reason.
        risk: Weight on failing samples, 0 to 1.
        sample: Sample to execute instead; None to keep the plan.
        scale: Factor on the base velocities; 1 to keep the plan.
    """

    intervention: Intervention
    risk: float
    sample: int | None = None
    scale: float = 1.0

    def keep_plan(self) -> Verdict:
        """The same risk without an intervention, unless no prediction is finite."""
        if self.intervention is Intervention.DIVERGED:
            return self
        return Verdict(Intervention.NONE, self.risk)


def judge(
    weights: np.ndarray, costs: np.ndarray, falls: np.ndarray, touches: np.ndarray, stop: int | None
) -> Verdict:
    r"""Check a plan by the samples that it is the weighted mean of.

    The risk is :math:`r = \sum_i w_i [\text{sample } i \text{ fails}]`. Up to 0.1 the plan is kept.
    Above, the base velocities are scaled by 1 − r. From 0.5 on, the cheapest sample that does not
    fail replaces the plan; if all fail, it is the sample `stop` or, without one, the executed
    posture at zero velocity.

    Args:
        weights: Weights of the samples. Shape (K,).
        costs: Costs of the samples, NaN for diverged ones. Shape (K,).
        falls: Which samples fall or diverge. Shape (K,), bool.
        touches: Which samples touch an obstacle. Shape (K,), bool.
        stop: Index of the stopping sample; None if there is none.
    """
    finite = np.isfinite(costs)
    if not finite.any():
        return Verdict(Intervention.DIVERGED, 1.0, scale=0.0)
    failing = falls | touches
    risk = float(weights[failing].sum())
    if risk <= _SLOW:
        return Verdict(Intervention.NONE, risk)
    is_fall = weights[falls].sum() >= weights[touches].sum()
    if risk < _VETO:
        reason = Intervention.SLOWED_FALL if is_fall else Intervention.SLOWED_COLLISION
        return Verdict(reason, risk, scale=1 - risk)
    reason = Intervention.VETOED_FALL if is_fall else Intervention.VETOED_COLLISION
    safe = np.flatnonzero(~failing & finite)
    if not len(safe) and stop is None:
        return Verdict(reason, risk, scale=0.0)
    best = int(safe[np.argmin(costs[safe])]) if len(safe) else stop
    return Verdict(reason, risk, sample=best)
