"""Optimal control problem of Eq. 1: dynamics (rollouts of the policy in MuJoCo) and cost.

It knows nothing of how the problem is solved; see `mpc.py`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import mujoco
import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.state import RobotState
from xop_lerobot.low_level.policy import POLICY_DT, LowLevelPolicy
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.morphology.tuning import MpcConfig
from xop_lerobot.retarget.costs import CollisionCost, FallCost, SupportArea, make_costs
from xop_lerobot.retarget.costs.cost import Cost, Evaluation
from xop_lerobot.retarget.decision import DecisionSpace
from xop_lerobot.retarget.model.command_model import CommandModel, PlannerState, Start
from xop_lerobot.retarget.model.linearisation import Readings, find_sites_on
from xop_lerobot.retarget.obstacles import Obstacle, make_obstacles
from xop_lerobot.retarget.references import Reference
from xop_lerobot.retarget.rollout import PolicyRollout, Prediction
from xop_lerobot.retarget.static_load import make_static_load


class Scores(NamedTuple):
    """Costs and failures of the samples.

    Attributes:
        terms: Cost of every sample by term. Shapes (K,).
        costs: Their sum; not finite for a diverged sample. Shape (K,).
        falls: Which samples fall or diverge. Shape (K,), bool.
        touches: Which samples touch an obstacle. Shape (K,), bool.
    """

    terms: Mapping[str, np.ndarray]
    costs: np.ndarray
    falls: np.ndarray
    touches: np.ndarray


class Problem:
    r"""Dynamics, constraints and cost :math:`\sum_k l(x_k, a_k, G) + V_f(x_H, G)` of Eq. 1.

    The dynamics (1b, 1c) are MuJoCo with the low-level policy and its memory in the loop. The
    cost-to-go :math:`V_f` is evaluated at an extrapolation beyond the horizon by the
    `CommandModel`.

    Args:
        morphology: The robot.
        policy: Its low-level policy.
        model: Its planning model in the scene.
        decision: Layout of the decision vector.
        command_model: First-order model of the effect of a decision.
        num_threads: Threads of the physics.
        obstacles: Obstacles to avoid; by default the geoms that are fixed in `model`.

    Attributes:
        support: Support area for the centre of mass; None for a robot that balances itself.
        load: Static loads of the joints; None if a policy moves them.
        costs: The cost terms.
        readings: Extracts poses and positions from predictions.
    """

    def __init__(
        self,
        morphology: Morphology,
        policy: LowLevelPolicy,
        model: mujoco.MjModel,
        decision: DecisionSpace,
        command_model: CommandModel,
        num_threads: int,
        obstacles: Iterable[Obstacle] | None = None,
    ) -> None:
        self.morphology, self.decision, self.command_model = morphology, decision, command_model
        self.rollout = PolicyRollout(model, policy, num_threads)
        self._model = model
        self.load = make_static_load(morphology, model)
        self.support = None
        if morphology.support:
            resting = Readings(morphology, model, {}).compute_com(morphology.standing_qpos())
            self.support = SupportArea(morphology.support, tuple(resting[:2]))
        hull = morphology.hull_points
        self._collision = CollisionCost(
            make_obstacles(model) if obstacles is None else obstacles,
            hull,
            hands=morphology.hull_hands,
            base=find_sites_on(model, morphology.base_body, hull),
        )
        self._fall = FallCost(
            morphology.fall_tilt,
            morphology.fall_height,
            float(morphology.standing_qpos()[2]),
            command_model.find_lowest_height(),
            command_model.compute_rest_tilt,
        )
        self.costs: tuple[Cost, ...] = make_costs(
            morphology, command_model, self.support, self._collision, self._fall, self.load
        )
        self.set_obstacles(self.obstacles)

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """The obstacles to avoid."""
        return self._collision.obstacles.obstacles

    def set_obstacles(self, obstacles: tuple[Obstacle, ...]) -> None:
        """Replace the obstacles to avoid."""
        self._collision.set_obstacles(obstacles)
        # Without obstacles the hull points are not needed; leaving them out saves time.
        hull = self.morphology.hull_points if obstacles else {}
        self.readings = Readings(self.morphology, self._model, hull)

    def restrict(self, decisions: np.ndarray, mode: Mode) -> np.ndarray:
        """Project decisions on the mode, the bounds (1d) and the policy's dead zones. (..., n)."""
        space = self.decision.space
        return space.restrict(space.leave_dead_zones(decisions, mode), mode)

    def predict(
        self, state: RobotState, now: PlannerState, decisions: np.ndarray, mode: Mode
    ) -> Prediction:
        """Roll out decisions within the rate limits.

        Args:
            state: Present state of the robot: :math:`x_0` and the policy's memory (1e, 1f).
            now: The planner's state, with the executed decision.
            decisions: Sampled decisions. Shape (K, H, n).
            mode: Mode of the robot.
        """
        limited = self.command_model.limit_rates(now.executed, decisions, mode, POLICY_DT)
        commands, arms = self.decision.split(limited, state.arms, self.command_model.body)
        ramped = (state.command, state.arms, state.mode) if self.morphology.ramps else None
        prediction = self.rollout.predict(
            state.qpos, state.qvel, state.memory, commands, arms, mode, ramped
        )
        return prediction._replace(commands=limited)

    def evaluate(
        self,
        prediction: Prediction,
        decisions: np.ndarray,
        now: PlannerState,
        reference: Reference,
        proposal: np.ndarray,
        mode: Mode,
        config: MpcConfig,
    ) -> Evaluation:
        """Collect the quantities that the cost terms are computed from.

        Args:
            prediction: The predictions of `decisions`.
            decisions: Sampled decisions, before the rate limits. Shape (K, H, n).
            now: The planner's state, with the executed decision.
            reference: The reference trajectory.
            proposal: The kinematic proposal. Shape (n,).
            mode: Mode of the robot.
            config: Parameters of the mode.
        """
        model, executed = self.command_model, now.executed
        origins = {
            "proposal": proposal,
            "neutral": self.decision.space.neutral,
            "zero": np.zeros(len(executed)),
        }
        decided = model.acting(mode)
        end = Start(
            qpos=prediction.qpos[:, -1],
            executed=prediction.commands[:, -1],
            drift=now.drift,
            offset=now.offset,
            settled=model.settle(now.settled, decisions[:, -1], config.horizon * POLICY_DT),
        )
        with np.errstate(invalid="ignore"):  # diverged samples are NaN
            extrapolated = model.extrapolate(end, decisions[:, -1], config.extrapolation_s, mode)
        frames = self.morphology.frames
        sites = {name: frames[name] for name in reference.goals}
        read = self.readings.read(prediction.sensordata, sites)
        then = self.readings.place(extrapolated, sites)
        last = config.horizon + 1
        return Evaluation(
            qpos=prediction.qpos,
            qvel=prediction.qvel,
            commands=decisions,
            executed=executed,
            reference=np.where(decided, origins[config.control_reference], decisions[0, 0]),
            poses=read.poses,
            points=read.points,
            velocities=read.velocities,
            terminal_qpos=extrapolated,
            terminal_poses=then.poses,
            terminal_points=then.points,
            terminal_com=then.com,
            goals={name: poses[:last] for name, poses in reference.goals.items()},
            terminal_goals={name: poses[last] for name, poses in reference.goals.items()},
            facing=reference.facing,
            mode=mode,
            dt=POLICY_DT,
            weights=config.weights,
            upright=tuple(name for name in reference.upright if name in sites),
            drives=bool((decided & model.is_velocity()).any()),
            balance=reference.balance,
            extrapolates=config.extrapolation_s > 0,
            scale_control=config.scale_control,
        )

    def score(self, evaluation: Evaluation) -> Scores:
        """Compute the costs of predictions, and which of them fail."""
        with np.errstate(invalid="ignore"):  # diverged samples are NaN and get no weight
            terms = {cost.name: cost.compute(evaluation) for cost in self.costs}
        costs = np.sum(list(terms.values()), axis=0)
        falls = self._fall.find_falls(evaluation) | ~np.isfinite(costs)
        return Scores(terms, costs, falls, self._collision.find_touches(evaluation))
