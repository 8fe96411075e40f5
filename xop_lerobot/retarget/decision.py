"""Decision vector of the controller: the low-level command, then the arm joint targets."""

from __future__ import annotations

import mujoco
import numpy as np

from xop_lerobot.core.command import CommandDim
from xop_lerobot.morphology.effect import Acts, Effect
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.retarget.arms.ik import ARM_MAX_RATE

ARM_LAG_S = 0.1
"""Time constant of the first-order lag with which arm joints follow their targets [s]."""
ARM_EFFORT = 3.0
"""Relative effort of arm joints in the kinematic proposal [1]; it unwinds them towards rest."""


class DecisionSpace:
    r"""The decision vector :math:`u = (a, q_{arm})`: command entries, then all arm joints.

    The free entries are the `body` that the targets are bound to: in the paper's Version 1 the
    command, in its Version 2 the torso and the left arm.

    Args:
        morphology: The robot.
        model: Its planning model; the joint ranges bound the arm targets.

    Attributes:
        space: Names, bounds and rates of the entries.
        effects: Effect of each entry.
        num_commands: Number of command entries.
    """

    def __init__(self, morphology: Morphology, model: mujoco.MjModel) -> None:
        self.joints = tuple(joint for arm in morphology.arms for joint in arm.joints)
        dims = []
        for name in self.joints:
            joint = model.joint(name)
            low, high = joint.range if model.jnt_limited[joint.id] else (-np.pi, np.pi)
            rest = morphology.arm_rest.get(name, 0.0)
            key = f"{name}.pos"
            # Arms are not part of the posture: `limit_action` limits each of their joints.
            dims.append(CommandDim(name, key, "rad", low, high, rest, ARM_MAX_RATE, alone=True))
        self.num_commands = len(morphology.command_space)
        self.space = morphology.command_space.extend(tuple(dims))
        arm_effects = (
            Effect(Acts.JOINT, name, lag_s=ARM_LAG_S, effort=ARM_EFFORT) for name in self.joints
        )
        self.effects = (*morphology.effects, *arm_effects)

    def make_mask(self, body: tuple[str, ...]) -> np.ndarray:
        """Mask of the entries that `body` names; the whole command if empty. Shape (n,), bool.

        Raises:
            UnknownName: If an entry is unknown; lists the known ones.
        """
        mask = np.zeros(len(self.space), dtype=bool)
        for name in body or self.space.names[: self.num_commands]:
            mask[self.space.index(name)] = True
        return mask

    def join(self, command: np.ndarray, arms: np.ndarray) -> np.ndarray:
        """Decision vector of a command and arm targets, without the grippers. Shape (n,)."""
        return np.concatenate([command, arms[: len(self.joints)]])

    def split(
        self, decisions: np.ndarray, arms: np.ndarray, body: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Split decisions into commands and arm targets; grippers keep their targets.

        Args:
            decisions: Decisions. Shape (K, H, n).
            arms: Present arm and gripper targets. Shape (m,).
            body: Mask of the free entries; without arm joints `arms` is returned as is. (n,).

        Returns:
            Commands, shape (K, H, k), and arm targets, shape (m,) or (K, H, m).
        """
        commands, count = decisions[..., : self.num_commands], len(self.joints)
        if body[self.num_commands :].any():
            grippers = np.broadcast_to(arms[count:], (*decisions.shape[:2], len(arms) - count))
            arms = np.concatenate([decisions[..., self.num_commands :], grippers], axis=-1)
        return commands, arms
