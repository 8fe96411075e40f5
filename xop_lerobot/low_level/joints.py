"""Actuated joints of a robot, selected by group, name or pattern as in policy tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache

import numpy as np

from xop_lerobot.core.errors import BadValue
from xop_lerobot.morphology.morphology import Morphology, make_morphology

GROUPS = ("all", "legs", "waist", "arms")
"""Groups of joints: all, in the model's order; those without a command or arm target; those that
are command entries; those of the arms."""


def as_index(places: Sequence[int] | np.ndarray) -> slice | np.ndarray:
    """Index of columns: a slice if they are consecutive, since slicing copies nothing."""
    places = np.asarray(places, dtype=int)
    if len(places) and np.array_equal(places, np.arange(places[0], places[0] + len(places))):
        return slice(int(places[0]), int(places[-1]) + 1)
    return places


@dataclass(frozen=True)
class RobotJoints:
    """Actuated joints of a robot, in the order of the model's actuators.

    Attributes:
        names: Their names.
        commands: Names of the command entries.
        positions: Addresses in `qpos`. Shape (nu,).
        velocities: Addresses in `qvel`. Shape (nu,).
        low: Lower limits [rad]. Shape (nu,).
        high: Upper limits [rad]. Shape (nu,).
        stiffness: Stiffness of the model's servos [N m/rad]. Shape (nu,).
        damping: Damping of the model's servos [N m s/rad]. Shape (nu,).
        by_command: Joint -> index of the command entry that is its target.
        by_arm: Joint -> index of the arm target that is its target.
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
            BadValue: If it has actuators that are not on a joint.
        """
        import mujoco  # noqa: PLC0415

        model = morphology.build_spec("planning").compile()
        others = np.flatnonzero(model.actuator_trntype != mujoco.mjtTrn.mjTRN_JOINT)
        if len(others):
            names = ", ".join(model.actuator(i).name for i in others)
            raise BadValue(
                f"robot '{morphology.name}' has motors that are not on a joint, which a policy "
                f"table can't drive: {names}"
            )
        ids = model.actuator_trnid[:, 0]
        names = tuple(model.joint(joint).name for joint in ids)
        commands, arms = morphology.command_space.names, morphology.arm_names
        # Entries of the command that are joint angles are named as their joints, less the suffix.
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
        """Indices of the joints that match `patterns`: by pattern, then in the model's order.

        Raises:
            BadValue: If a pattern matches no joint, or a joint is named twice.
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
        """Index of a command entry.

        Raises:
            BadValue: If there is no such entry; lists those of the robot.
        """
        if entry not in self.commands:
            raise BadValue(
                f"{entry!r} is no entry of the command. Known: {', '.join(self.commands)}"
            )
        return self.commands.index(entry)

    def spread(self, numbers: Mapping[str, float], default: float | np.ndarray) -> np.ndarray:
        """Expand numbers by pattern to one per joint; the last match wins. Shape (nu,).

        Raises:
            BadValue: If a pattern matches no joint.
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
        """Whether a command entry or an arm target is the target of `joint`."""
        return joint in self.by_command or joint in self.by_arm

    def _fits(self, joint: int, pattern: str) -> bool:
        if pattern not in GROUPS:
            return fnmatchcase(self.names[joint], pattern)
        waist, arm = joint in self.by_command, joint in self.by_arm
        return {"all": True, "legs": not (waist or arm), "waist": waist, "arms": arm}[pattern]


@cache
def read_joints(robot: str) -> RobotJoints:
    """Actuated joints of a robot, by its name."""
    return RobotJoints.of(make_morphology(robot))
