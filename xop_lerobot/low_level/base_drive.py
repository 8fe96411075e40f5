"""Low-level controllers of wheeled robots whose torso and arms are position-controlled servos."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadShape, PolicyFileError
from xop_lerobot.low_level.policy import LowLevelPolicy, PolicyOutput
from xop_lerobot.morphology.effect import Acts

if TYPE_CHECKING:
    from xop_lerobot.morphology.morphology import Morphology


class BaseDrive(LowLevelPolicy):
    """Wheel speeds by the robot's `WheelDrive`; targets of torso, arms and grippers passed through.

    The servos are in the model: torque proportional to the speed error at the wheels, position
    control at the joints. Targets are matched by name: an actuator takes the command entry of its
    name, else the arm target of its name, else zero (the head looks straight ahead). Targets are
    clipped to the actuators' ranges.

    Args:
        path: Must be None, since this controller has no file.
        morphology: The robot; None for the built-in one that has a policy of this name.

    Raises:
        PolicyFileError: If a path is given.
    """

    memory_size = 0

    def __init__(self, path: str | None = None, morphology: Morphology | None = None) -> None:
        if path is not None:
            raise PolicyFileError(f"low-level policy '{self.name}' has no file, got '{path}'")
        if morphology is None:
            from xop_lerobot.morphology.morphology import MORPHOLOGIES  # noqa: PLC0415

            robots = (MORPHOLOGIES[name]() for name in MORPHOLOGIES.built_in)
            morphology = next(robot for robot in robots if self.name in robot.policies)
        model = morphology.build_spec("planning").compile()
        actuators = [model.actuator(i).name for i in range(model.nu)]
        commands, arms = morphology.command_space.names, morphology.arm_names
        self._sizes = model.nq, model.nv, len(commands), len(arms)
        assert morphology.drive is not None, f"{morphology.name} has no wheel kinematics"
        self._drive = morphology.drive
        self._wheels = [actuators.index(name) for name in self._drive.wheels]
        acts = [effect.acts for effect in morphology.effects]
        twist = (Acts.FORWARD, Acts.LEFT, Acts.TURN)
        self._twist = tuple(acts.index(each) if each in acts else None for each in twist)
        self._from_command = _pairs(actuators, commands)
        self._from_arms = _pairs(actuators, [a for a in arms if a not in commands], arms)
        limited = model.actuator_ctrllimited.astype(bool)
        self._low = np.where(limited, model.actuator_ctrlrange[:, 0], -np.inf)
        self._high = np.where(limited, model.actuator_ctrlrange[:, 1], np.inf)

    def initial_memory(self, n: int = 1) -> np.ndarray:
        """Empty memory: the controller is stateless. Shape (n, 0)."""
        return np.zeros((n, 0))

    def act(
        self,
        qpos: np.ndarray,
        qvel: np.ndarray,
        command: np.ndarray,
        arms: np.ndarray,
        memory: np.ndarray,
        mode: Mode | np.ndarray,
    ) -> PolicyOutput:
        """Compute actuator targets for the next 20 ms; see `LowLevelPolicy.act`.

        Raises:
            BadShape: If an argument does not fit the robot.
        """
        n = len(qpos)
        given = {"qpos": qpos, "qvel": qvel, "command": command, "arms": arms, "memory": memory}
        for (name, array), size in zip(given.items(), (*self._sizes, 0), strict=True):
            if np.shape(array) != (n, size):
                raise BadShape(name, (n, size), np.shape(array))
        targets = np.zeros((n, len(self._low)))
        twist = [np.zeros(n) if i is None else command[:, i] for i in self._twist]
        targets[:, self._wheels] = self._drive.compute_speeds(*twist)
        targets[:, self._from_command[0]] = command[:, self._from_command[1]]
        targets[:, self._from_arms[0]] = arms[:, self._from_arms[1]]
        return PolicyOutput(np.clip(targets, self._low, self._high, out=targets), np.zeros((n, 0)))


class DiffDrive(BaseDrive):
    """Two driven wheels on one axle: RB-Y1."""

    name = "diff_drive"


class MecanumDrive(BaseDrive):
    """Four mecanum wheels: RB-Y1 M."""

    name = "mecanum_drive"


def _pairs(
    actuators: list[str], wanted: list[str] | tuple[str, ...], source: tuple[str, ...] | None = None
) -> tuple[list[int], list[int]]:
    """Indices in `actuators` and in `source` of the wanted names that are actuators."""
    source = tuple(wanted) if source is None else source
    names = [name for name in wanted if name in actuators]
    return [actuators.index(name) for name in names], [source.index(name) for name in names]
