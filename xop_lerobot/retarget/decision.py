"""What the controller may decide: the low-level command, and the targets of the arm joints."""

from __future__ import annotations

import mujoco
import numpy as np

from xop_lerobot.core.command import CommandDim
from xop_lerobot.morphology.effect import Acts, Effect
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.retarget.arms.ik import ARM_MAX_RATE

ARM_LAG_S = 0.1
"""Time constant with which arm joints follow their targets, to first order [s]."""
ARM_EFFORT = 3.0
"""How dear arm joints are to the kinematic proposal, away from their rest: they unwind in time."""


class DecisionSpace:
    r"""The decision vector :math:`u = (a, q_{arm})`: command entries, then all arm joints.

    Which of them are free is the `body` that a target is bound to. The paper's Version 1 frees
    the command alone, its Version 2 the torso and the left arm.

    Args:
        morphology: The robot.
        model: Its planning model; the joints' ranges bound the arm targets.

    Attributes:
        space: Names, bounds and rates of the entries.
        effects: What each entry does.
        num_commands: How many of them are the command's.
    """

    def __init__(self, morphology: Morphology, model: mujoco.MjModel) -> None:
        self.joints = tuple(joint for arm in morphology.arms for joint in arm.joints)
        dims = []
        for name in self.joints:
            joint = model.joint(name)
            low, high = joint.range if model.jnt_limited[joint.id] else (-np.pi, np.pi)
            rest = morphology.arm_rest.get(name, 0.0)
            dims.append(
                CommandDim(name, f"{name}.pos", "rad", low, high, rest, max_rate=ARM_MAX_RATE)
            )
        self.num_commands = len(morphology.command_space)
        self.space = morphology.command_space.extend(tuple(dims))
        arm_effects = (
            Effect(Acts.JOINT, name, lag_s=ARM_LAG_S, effort=ARM_EFFORT) for name in self.joints
        )
        self.effects = (*morphology.effects, *arm_effects)

    def make_mask(self, body: tuple[str, ...]) -> np.ndarray:
        """Which entries `body` names; all of the command for an empty one. Shape (n,), bool.

        Raises:
            UnknownName: If it names an entry that is not there; lists the known ones.
        """
        mask = np.zeros(len(self.space), dtype=bool)
        for name in body or self.space.names[: self.num_commands]:
            mask[self.space.index(name)] = True
        return mask

    def join(self, command: np.ndarray, arms: np.ndarray) -> np.ndarray:
        """Decision vector of a command and the arms' targets (grippers are left out). (n,)."""
        return np.concatenate([command, arms[: len(self.joints)]])

    def split(
        self, decisions: np.ndarray, arms: np.ndarray, body: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Commands and arm targets of decisions; grippers stay as they are.

        Args:
            decisions: Decisions. Shape (K, H, n).
            arms: Arm and gripper targets now. Shape (m,).
            body: Which entries are decided; without arms among them `arms` is what it is. (n,).

        Returns:
            Commands, shape (K, H, k), and arm targets, shape (m,) or (K, H, m).
        """
        commands, count = decisions[..., : self.num_commands], len(self.joints)
        if body[self.num_commands :].any():
            grippers = np.broadcast_to(arms[count:], (*decisions.shape[:2], len(arms) - count))
            arms = np.concatenate([decisions[..., self.num_commands :], grippers], axis=-1)
        return commands, arms
