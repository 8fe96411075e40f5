"""Interface of robots, and the registry of them.

A robot is a subclass of `Morphology` in a folder of its own; no other code names it.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np

from xop_lerobot.core.command import ActionLayout, CommandSpace, Mode, RobotAction
from xop_lerobot.core.registry import Registry
from xop_lerobot.morphology.effect import Effect
from xop_lerobot.morphology.tuning import Driving, MpcConfig, PaperParameters

if TYPE_CHECKING:
    import mujoco

    from xop_lerobot.low_level.policy import LowLevelPolicy
    from xop_lerobot.low_level.rest import RestMap
    from xop_lerobot.morphology.contacts import ContactKind

ModelKind = Literal["full", "planning"]


@dataclass(frozen=True)
class ArmChain:
    """One arm of a robot.

    Attributes:
        frame: The tracked frame at its end, such as ``"left_wrist"``.
        joints: Its joints from shoulder to wrist.
        gripper: Name of its gripper target; None for a hand without one.
        gripper_range: Target of the closed and of the open gripper [m].
    """

    frame: str
    joints: tuple[str, ...]
    gripper: str | None = None
    gripper_range: tuple[float, float] = (0.0, 0.0)


PAPER_HUMANOID = {
    Mode.STATIONARY: PaperParameters(30, 3, 0.001, 25.0),
    Mode.MOBILE: PaperParameters(30, 5, 0.05, 10.0),
}
"""The paper's Table I for its humanoid."""


@dataclass(frozen=True)
class Variant:
    """Binding of tracked frames to a part of the body.

    Attributes:
        targets: Tracked frames that the retargeter follows; inverse kinematics of the arms follow
            the other wrists.
        body: Command entries and arm joints that it decides; empty for the whole command.
        configs: Controller parameters by mode; the robot's own for other modes.
        paper: The paper's parameters by mode, for the preset `table1`.
    """

    targets: tuple[str, ...] = ("head",)
    body: tuple[str, ...] = ()
    configs: Mapping[Mode, MpcConfig] = field(default_factory=dict)
    paper: Mapping[Mode, PaperParameters] = field(default_factory=lambda: PAPER_HUMANOID)


@dataclass(frozen=True)
class Work:
    """Properties of a robot's hands that tasks need beyond their kinematics.

    Attributes:
        press: Depth of the wrist goals inside a box that gives a firm grip [m].
        tray: Whether a hand needs a plate to carry an object on it.
        walk: Smallest and largest distance that the robot walks before it picks something up [m].
    """

    press: float = 0.05
    tray: bool = False
    walk: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Servos:
    """Stiff position servos on the joints of the command.

    Attributes:
        gap: Tracking error above which a servo counts as giving way [rad].
        load_share: Fraction of the torque limit that a joint may need to hold a posture [1]; the
            rest is reserved for motion.
    """

    gap: float
    load_share: float = 0.75


@dataclass(frozen=True)
class WheelDrive:
    r"""Kinematics of the driven wheels: :math:`\omega = (f v_x + s v_y + t \Omega) / r` for each.

    Attributes:
        radius: Radius r of the wheels [m].
        wheels: Coefficients f [1], s [1] and t [m] of forward velocity, lateral velocity and yaw
            rate, by the name of the wheel's motor.
    """

    radius: float
    wheels: Mapping[str, tuple[float, float, float]]

    @cached_property
    def _shares(self) -> np.ndarray:
        return np.array(list(self.wheels.values())).T

    def compute_speeds(self, forward: np.ndarray, left: np.ndarray, turn: np.ndarray) -> np.ndarray:
        """Compute the speeds of the wheels [rad/s], in the order of `wheels`.

        Args:
            forward: Forward velocity [m/s]. Shape (n,).
            left: Velocity to the left [m/s]. Shape (n,).
            turn: Yaw rate [rad/s]. Shape (n,).

        Returns:
            Shape (n, wheels).
        """
        f, s, t = self._shares
        return (forward[:, None] * f + turn[:, None] * t + left[:, None] * s) / self.radius


class Morphology(ABC):
    """Description of a robot for simulation, planning and teleoperation.

    The full model is the plant, with all collisions, cameras and visuals. The planning model has
    the same joints and actuators in the same order, and only the contacts that matter for the
    prediction.
    """

    name: str
    command_space: CommandSpace
    policies: tuple[str, ...]
    """Low-level policies of this robot beside the tables that name it; the first is the default."""
    frames: dict[str, str]
    """Site of each tracked frame (`head`, `left_wrist`, `right_wrist`) in the models."""
    base_body: str
    arms: tuple[ArmChain, ...]
    arm_rest: dict[str, float]
    """Rest angle of each arm joint [rad]; joints that are not named rest at 0."""
    arm_limits: Mapping[str, tuple[float, float]] = {}
    """Limits of arm joints in inverse kinematics, where narrower than the joint range [rad]:
    beyond them the robot's low-level policies lose their balance."""
    contact_points: tuple[str, ...]
    """Sites of the contact points with the ground (four per foot, one per wheel)."""
    fall_height: float
    """Base height over the ground below which the robot counts as fallen [m]."""
    fall_tilt: float
    """Tilt of the base above which the robot counts as fallen [rad]."""
    contact_kind: ContactKind
    """Kind of its ground contacts: `Feet` or `Wheels`."""

    ramps: bool = False
    """Whether its controller interpolates linearly between successive motor targets."""
    work: Work = Work()
    """Properties of its hands for tasks."""
    variants: Mapping[str, Variant] = {"v1": Variant()}
    """Bindings of targets to the body by name; the first is the default."""
    effects: tuple[Effect, ...]
    """Effect of each entry of the command, in the order of `command_space`."""
    contact_groups: tuple[tuple[str, ...], ...]
    """`contact_points` by foot or wheel."""
    velocity_lag_s: float = 0.3
    """Time constant of the base's response to a velocity command [s]; 0 for wheels."""
    rest: RestMap | None = None
    """Lean and displacement of its standing base under the policy that it is fitted to; None if
    there is none or it is unknown."""
    pivot: float = 0.0
    """Forward distance from the base's frame to its centre of rotation [m]."""
    drive: WheelDrive | None = None
    """Kinematics of its driven wheels; None for a base without wheels."""
    driving: Driving | None = None
    """Limits for driving along a path; None for a base that can move sideways."""
    support: tuple[tuple[float, float], ...] = ()
    """Corners (x, y) of the support area of a robot that cannot step, in the base's frame,
    counterclockwise [m]; empty for a robot whose policy keeps the balance."""
    largest_offset: float = 0.2
    """Largest steady-state error of height and joints that the planner compensates, as a fraction
    of half the range [1]."""
    servos: Servos | None = None
    """Servos on the joints of the command; None if a policy moves them."""
    posture_limits: Mapping[str, tuple[float, float]] = {}
    """Preferred ranges of the command's joints in postures, by entry [rad], such as the direction
    in which knees bend; exceeded only if a goal cannot be reached otherwise."""
    standing_reach: float = 0.3
    """Largest distance of the head's goal from its rest position in stationary mode [m]."""

    point_heights: tuple[float, float] | None = None
    """Range of heights over the floor that its palms reach [m]; None for the tasks' defaults."""
    top_heights: tuple[float, float] | None = None
    """Range of table heights at which its hands can reach a box from both sides [m]."""

    hull_points: dict[str, float] = {}
    """Sites on the robot's hull and the radius around each [m], for obstacle avoidance; empty for
    a robot that does not avoid obstacles."""

    hull_hands: tuple[str, ...] = ()
    """`hull_points` of the hands, which may come close to objects that they work at."""

    @abstractmethod
    def build_spec(self, kind: ModelKind) -> mujoco.MjSpec:
        """Build the robot without a scene, as an editable model."""

    @abstractmethod
    def standing_qpos(self) -> np.ndarray:
        """Configuration at rest on the ground, at the origin and facing +X. Shape (nq,)."""

    @abstractmethod
    def mpc_config(self, mode: Mode) -> MpcConfig:
        """Parameters of the model predictive controller in `mode`."""

    @cached_property
    def arm_names(self) -> tuple[str, ...]:
        """Arm joints of all chains, then the grippers: the order of every `arms` array."""
        joints = [joint for arm in self.arms for joint in arm.joints]
        return (*joints, *(arm.gripper for arm in self.arms if arm.gripper))

    @cached_property
    def layout(self) -> ActionLayout:
        """Layout of this robot's actions."""
        return ActionLayout(self.command_space, self.arm_names)

    def fit(self, policy: LowLevelPolicy) -> Morphology:
        """Return a copy with the command ranges and the rest map of a low-level policy.

        Raises:
            BadValue: If a range of the policy does not overlap with the robot's.
        """
        fitted = copy.copy(self)
        vars(fitted).pop("layout", None)  # cached with the old command space
        fitted.command_space = self.command_space.fit(
            policy.ranges, policy.dead_zones, policy.stop_rates
        )
        fitted.rest = policy.rest
        return fitted

    def rest_action(self) -> RobotAction:
        """Action at rest: neutral command, stationary mode, arms at rest, grippers open."""
        joints = [self.arm_rest.get(joint, 0.0) for arm in self.arms for joint in arm.joints]
        grippers = [arm.gripper_range[1] for arm in self.arms if arm.gripper]
        return RobotAction(
            self.command_space.neutral.copy(), Mode.STATIONARY, np.array(joints + grippers)
        )


MORPHOLOGIES: Registry[type[Morphology]] = Registry(
    "robot",
    {
        "g1": "xop_lerobot.morphology.g1:G1",
        "rby1": "xop_lerobot.morphology.rby1:RBY1",
        "rby1m": "xop_lerobot.morphology.rby1m:RBY1M",
    },
)


def list_robots() -> tuple[str, ...]:
    """Names of the known robots."""
    return tuple(MORPHOLOGIES)


def say_robots() -> str:
    """List the built-in robots for a help text: ``"g1, rby1 or rby1m"``."""
    return _say_choices(MORPHOLOGIES.built_in)


def list_robot_types() -> str:
    """List the LeRobot types of the built-in robots for a message: ``"xop_g1 or xop_rby1"``."""
    return _say_choices([f"xop_{name}" for name in MORPHOLOGIES.built_in])


def _say_choices(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} or {names[-1]}"


def read_robot(name: str) -> str:
    """Parse a robot's name on a command line; its LeRobot type, ``"xop_g1"``, is accepted too."""
    return name.removeprefix("xop_")


def make_morphology(name: str) -> Morphology:
    """Make the robot `name`.

    Raises:
        UnknownName: Listing the known robots.
    """
    return MORPHOLOGIES[name]()
