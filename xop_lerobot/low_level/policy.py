"""Interface of low-level policies π(x, a, h): batched closed-loop controllers at 50 Hz."""

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
    """Output of one step of a low-level policy.

    Attributes:
        targets: Control of every actuator, in the model's actuator order. Shape (n, nu).
        memory: The policy's memory after the step. Shape (n, nm).
    """

    targets: np.ndarray
    memory: np.ndarray


class LowLevelPolicy(ABC):
    r"""A closed-loop controller :math:`\tau_k = \pi(x_k, a_k, h_k)` (Eq. 1b), batched.

    The policy runs at 50 Hz; the model's actuators turn its targets into torques at every
    physics step, so gains and torque limits are part of the model. All state between steps is in
    `memory`, a plain array that each solve copies from the plant into every rollout. So an
    implementation must be a pure function of its arguments.
    """

    name: str
    memory_size: int
    arm_limits: Mapping[str, tuple[float, float]] = {}
    """Limits of the arm targets, by joint, beyond which the robot does not stand or walk safely
    [rad]; measured by `benchmarks/run_policies.py`."""

    ranges: Mapping[Mode, Mapping[str, tuple[float, float]]] = {}
    """Command ranges that it can follow, by mode and entry, where narrower than the robot's."""
    dead_zones: Mapping[str, float] = {}
    """Magnitude of a velocity below which the policy does not react, by command entry."""
    stop_rates: Mapping[str, float] = {}
    """Rate limits of velocities when the robot has to stop, by command entry."""
    rest: RestMap | None = None
    """Lean and displacement of the base of a standing robot; None if unknown."""

    def adapt(self, model: mujoco.MjModel) -> None:
        """Set the motors of `model` to those that the policy was trained with.

        `PolicyLoop` and `PolicyRollout` call it for the models of plant and rollouts. Does nothing
        by default, since the robots' models have the gains of their own policies.
        """
        del model

    @abstractmethod
    def initial_memory(self, n: int = 1) -> np.ndarray:
        """Memory before the first step. Shape (n, memory_size)."""

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
            Targets, and the memory after the step. The inputs are not modified.
        """
