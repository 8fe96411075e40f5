"""The joints of a robot as tables of policies name them: by group, by name, by pattern."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache

import numpy as np

from xop_lerobot.core.errors import BadValue
from xop_lerobot.morphology.morphology import Morphology, make_morphology

GROUPS = ("all", "legs", "waist", "arms")
"""Joints of the robot: all of them, in the model's order; those that neither a command nor an arm
target names; those that a command names; those of the arms."""


def as_index(places: Sequence[int] | np.ndarray) -> slice | np.ndarray:
    """What picks columns: a slice where they follow each other, which costs nothing."""
    places = np.asarray(places, dtype=int)
    if len(places) and np.array_equal(places, np.arange(places[0], places[0] + len(places))):
        return slice(int(places[0]), int(places[-1]) + 1)
    return places


@dataclass(frozen=True)
class RobotJoints:
    """Actuated joints of a robot, in the order of the model's actuators.

    Attributes:
        names: Their names.
        commands: Names of the entries of the command.
        positions: Where each is in `qpos`. Shape (nu,).
        velocities: Where each is in `qvel`. Shape (nu,).
        low: Lower limits [rad]. Shape (nu,).
        high: Upper limits [rad]. Shape (nu,).
        stiffness: Of the model's servos [N m/rad]. Shape (nu,).
        damping: Of the model's servos [N m s/rad]. Shape (nu,).
        by_command: Joint -> entry of the command that is its angle.
        by_arm: Joint -> arm target that is its angle.
        nq: Size of `qpos`.
        nv: Size of `qvel`.
        num_arms: Number of arm targets.
    """

    names: tuple[str, ...]
    commands: tuple[str, ...]
    positions: np.ndarray
    velocities: np.ndarray
    low: np.ndarray
    high: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    by_command: Mapping[int, int]
    by_arm: Mapping[int, int]
    nq: int
    nv: int
    num_arms: int

    @classmethod
    def of(cls, morphology: Morphology) -> RobotJoints:
        """Read the joints from a robot's planning model.

        Raises:
            BadValue: If it has motors that turn no joint.
        """
        import mujoco  # noqa: PLC0415

        model = morphology.build_spec("planning").compile()
        others = np.flatnonzero(model.actuator_trntype != mujoco.mjtTrn.mjTRN_JOINT)
        if len(others):
            names = ", ".join(model.actuator(i).name for i in others)
            raise BadValue(
                f"robot '{morphology.name}' has motors that turn no joint, which no table drives: "
                f"{names}"
            )
        ids = model.actuator_trnid[:, 0]
        names = tuple(model.joint(joint).name for joint in ids)
        commands, arms = morphology.command_space.names, morphology.arm_names
        bare = [name.removesuffix("_joint") for name in names]
        low, high = np.where(model.jnt_limited[ids], model.jnt_range[ids].T, [[-np.inf], [np.inf]])
        return cls(
            names,
            commands,
            model.jnt_qposadr[ids].copy(),
            model.jnt_dofadr[ids].copy(),
            low,
            high,
            model.actuator_gainprm[:, 0].copy(),
            -model.actuator_biasprm[:, 2],
            {joint: commands.index(name) for joint, name in enumerate(bare) if name in commands},
            {joint: arms.index(name) for joint, name in enumerate(names) if name in arms},
            model.nq,
            model.nv,
            len(arms),
        )

    def select(self, patterns: Sequence[str]) -> list[int]:
        """Joints that `patterns` name: pattern by pattern, each in the model's order.

        Raises:
            BadValue: If a pattern fits no joint, or a joint is named twice.
        """
        found: list[int] = []
        for pattern in patterns:
            fits = [joint for joint in range(len(self.names)) if self._fits(joint, pattern)]
            if not fits:
                raise BadValue(
                    f"{pattern!r} fits no joint. Groups: {', '.join(GROUPS)}; joints: "
                    f"{', '.join(self.names)}"
                )
            found += fits
        twice = sorted({self.names[joint] for joint in found if found.count(joint) > 1})
        if twice:
            raise BadValue(f"{', '.join(twice)} is named twice by {', '.join(patterns)}")
        return found

    def find_command(self, entry: str) -> int:
        """Position of an entry of the command.

        Raises:
            BadValue: Listing the entries of the robot.
        """
        if entry not in self.commands:
            raise BadValue(
                f"{entry!r} is no entry of the command. Known: {', '.join(self.commands)}"
            )
        return self.commands.index(entry)

    def spread(self, numbers: Mapping[str, float], default: float | np.ndarray) -> np.ndarray:
        """One number a joint, by patterns of which the last that fits counts. Shape (nu,).

        Raises:
            BadValue: If a pattern fits no joint.
        """
        spread = np.full(len(self.names), default, dtype=float)
        for pattern, number in numbers.items():
            spread[self.select([pattern])] = number
        return spread

    @property
    def arms(self) -> list[int]:
        """Joints of the arms, in the order of the arm targets."""
        return sorted(self.by_arm, key=lambda joint: self.by_arm[joint])

    def is_commanded(self, joint: int) -> bool:
        """Whether a command or an arm target is the angle of `joint`."""
        return joint in self.by_command or joint in self.by_arm

    def _fits(self, joint: int, pattern: str) -> bool:
        if pattern not in GROUPS:
            return fnmatchcase(self.names[joint], pattern)
        waist, arm = joint in self.by_command, joint in self.by_arm
        return {"all": True, "legs": not (waist or arm), "waist": waist, "arms": arm}[pattern]


@cache
def read_joints(robot: str) -> RobotJoints:
    """The joints of a robot, by its name."""
    return RobotJoints.of(make_morphology(robot))
