"""The interface of a low-level policy π(x, a, h)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.low_level.rest import RestMap

if TYPE_CHECKING:
    import mujoco


POLICY_DT = 0.02
"""Period of every low-level policy [s] (50 Hz)."""


class PolicyOutput(NamedTuple):
    """What one step of a low-level policy returns.

    Attributes:
        targets: Control of every actuator, in the model's actuator order. Shape (n, nu).
        memory: The policy's memory after the step. Shape (n, nm).
    """

    targets: np.ndarray
    memory: np.ndarray


class LowLevelPolicy(ABC):
    r"""A closed-loop controller :math:`\tau_k = \pi(x_k, a_k, h_k)` (Eq. 1b), batched.

    The policy runs at 50 Hz; the model's actuators turn its targets into torques at every
    physics step, so gains and torque limits live in the model. All state between steps is in
    `memory`, a plain array: it is copied from the plant into every rollout at each solve.
    An implementation is a pure function of its arguments, never of what it was asked before.
    """

    name: str
    memory_size: int
    arm_limits: Mapping[str, tuple[float, float]] = {}
    """Angles within which arm targets are kept, by joint, where the robot does not stand or walk
    safely beyond [rad]; `benchmarks/run_policies.py` tells."""

    ranges: Mapping[Mode, Mapping[str, tuple[float, float]]] = {}
    """Commands that it can do in each mode, by entry, where that is less than the robot's."""
    dead_zones: Mapping[str, float] = {}
    """Size of a velocity under which nothing happens, by entry of the command."""
    stop_rates: Mapping[str, float] = {}
    """Rate limits of velocities that end because the robot is to stand, by entry."""
    rest: RestMap | None = None
    """How the base of a standing robot leans and moves unasked; None where that is not known."""

    def adapt(self, model: mujoco.MjModel) -> None:
        """Give `model`, of a plant or of rollouts, the motors that the policy was trained with.

        `PolicyLoop` and `PolicyRollout` call it, so nobody else has to. Nothing by default: the
        robots' models have the gains of their own policies.
        """
        del model

    @abstractmethod
    def initial_memory(self, n: int = 1) -> np.ndarray:
        """Memory of a policy that has not run yet. Shape (n, memory_size)."""

    @abstractmethod
    def act(
        self,
        qpos: np.ndarray,
        qvel: np.ndarray,
        command: np.ndarray,
        arms: np.ndarray,
        memory: np.ndarray,
        mode: Mode | np.ndarray,
    ) -> PolicyOutput:
        """Compute motor targets for the next 20 ms.

        Args:
            qpos: Generalised positions, MuJoCo order. Shape (n, nq).
            qvel: Generalised velocities, MuJoCo order. Shape (n, nv).
            command: Commands, in the robot's `CommandSpace`. Shape (n, k).
            arms: Arm joint targets [rad], then gripper openings [m]. Shape (n, m).
            memory: Memory of each member of the batch. Shape (n, memory_size).
            mode: Stationary or mobile, one for the batch or, for policies of networks, one each.
                Shape () or (n,).

        Returns:
            Targets and the memory after the step; the inputs are left untouched.
        """
