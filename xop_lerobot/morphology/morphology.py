"""The interface that every robot implements, and the registry of robots."""

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
        frame: The tracked frame it carries, ``"left_wrist"``.
        joints: Its joints from shoulder to wrist.
        gripper: The name of its gripper target, None for a hand without one.
        gripper_range: Opening of the gripper when closed and when open [m].
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
    """Which tracked frames drive which part of the body.

    Attributes:
        targets: Tracked frames that the retargeter follows; the arms' inverse kinematics follow
            the other wrists.
        body: Command entries and arm joints that it decides; empty for the whole command.
        configs: Parameters of the controller in each mode; the robot's own in those left out.
        paper: The paper's parameters in each mode, for the preset `table1`.
    """

    targets: tuple[str, ...] = ("head",)
    body: tuple[str, ...] = ()
    configs: Mapping[Mode, MpcConfig] = field(default_factory=dict)
    paper: Mapping[Mode, PaperParameters] = field(default_factory=lambda: PAPER_HUMANOID)


@dataclass(frozen=True)
class Work:
    """What tasks have to know of a robot's hands beyond their kinematics.

    Attributes:
        press: How far inside a box wrist goals have to be for a grip that holds [m].
        tray: Whether a hand needs a plate to carry what lies on it.
        walk: How far the robot goes before it carries something, at least and at most [m].
    """

    press: float = 0.05
    tray: bool = False
    walk: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Servos:
    """Stiff servos on the joints of the command, which do just as they are told.

    Attributes:
        gap: How far a joint may be behind its target before its servo counts as giving way [rad].
        load_share: Share of its largest torque that a joint may need to hold a posture [1]; the
            rest is for moving there.
    """

    gap: float
    load_share: float = 0.75


@dataclass(frozen=True)
class WheelDrive:
    r"""Kinematics of the driven wheels: :math:`\omega = (f v_x + s v_y + t \Omega) / r` for each.

    Attributes:
        radius: Radius of the wheels r [m].
        wheels: f [1], s [1] and t [m] by the motor of the wheel. f and s are the shares of the
            forward and the sideways velocity, negative where a wheel turns backwards for them.
    """

    radius: float
    wheels: Mapping[str, tuple[float, float, float]]

    @cached_property
    def _shares(self) -> np.ndarray:
        return np.array(list(self.wheels.values())).T

    def compute_speeds(self, forward: np.ndarray, left: np.ndarray, turn: np.ndarray) -> np.ndarray:
        """Speeds of the wheels [rad/s], in the order of `wheels`.

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
    """A robot, as far as retargeting is concerned. One folder per robot, no other code knows it.

    The full model is the plant: everything collides, cameras and visuals are there. The
    planning model has the same joints and actuators in the same order, and only the contacts
    that matter for the prediction.
    """

    name: str
    command_space: CommandSpace
    policies: tuple[str, ...]
    """Low-level policies of this robot beside the tables that name it; the first is its own."""
    frames: dict[str, str]
    """Site that each tracked frame (`head`, `left_wrist`, `right_wrist`) is in the models."""
    base_body: str
    arms: tuple[ArmChain, ...]
    arm_rest: dict[str, float]
    """Rest angle of each arm joint [rad]; joints that are not named rest at 0."""
    arm_limits: Mapping[str, tuple[float, float]] = {}
    """Angles that inverse kinematics keep arm joints within, where that is less than they could
    go [rad]: what the robot's low-level policies can do with."""
    contact_points: tuple[str, ...]
    """Sites of the points on which the robot stands (four a foot; one a wheel)."""
    fall_height: float
    """Base height over the ground under which the robot counts as fallen [m]."""
    fall_tilt: float
    """Tilt of the base over which the robot counts as fallen [rad]."""
    contact_kind: ContactKind
    """How it touches the ground: on `Feet` or on `Wheels`."""

    ramps: bool = False
    """Whether its controller goes from each set of targets to the next in a straight line."""
    work: Work = Work()
    """What tasks have to know of its hands."""
    variants: Mapping[str, Variant] = {"v1": Variant()}
    """Bindings of targets to the body by name; the first is the default."""
    effects: tuple[Effect, ...]
    """What each entry of the command does, in the order of `command_space`."""
    contact_groups: tuple[tuple[str, ...], ...]
    """`contact_points` that touch the ground together: a foot, a wheel."""
    velocity_lag_s: float = 0.3
    """Time constant with which the base takes up a velocity; wheels have none [s]."""
    rest: RestMap | None = None
    """How its base leans and moves unasked where it stands, under the policy that it is fitted to;
    None for a base that does not, or of which that is not known."""
    pivot: float = 0.0
    """Forward distance from the base's frame to its centre of turning [m]."""
    drive: WheelDrive | None = None
    """How its driven wheels turn; None for a base without any."""
    driving: Driving | None = None
    """How it drives along a path; None for a base that goes to any side."""
    support: tuple[tuple[float, float], ...] = ()
    """Corners (x, y) in the base's frame, counterclockwise, of the area on which a robot that
    cannot step stands [m]; empty for one whose policy keeps the balance."""
    largest_offset: float = 0.2
    """How far height and joints may rest beside their command and the planner counts on it, in
    shares of the command's half range [1]."""
    servos: Servos | None = None
    """The servos that follow the joints of the command; None where a policy follows it."""
    posture_limits: Mapping[str, tuple[float, float]] = {}
    """Angles within which joints of the command are kept [rad] wherever a goal does not need
    more, by entry: the knees that it is to bend."""
    standing_reach: float = 0.3
    """How far from where it rests the head of a robot that stands is led [m]."""

    point_heights: tuple[float, float] | None = None
    """Between which heights over the floor its palms get to points [m]; None keeps tasks at their
    usual ones."""
    top_heights: tuple[float, float] | None = None
    """Between which heights a top may be for its hands to get beside a box on it [m]."""

    hull_points: dict[str, float] = {}
    """Sites on the hull of the robot and the radius around each [m], for obstacles."""

    hull_hands: tuple[str, ...] = ()
    """Those of `hull_points` that are about hands, which may come near to what they work at."""

    @abstractmethod
    def build_spec(self, kind: ModelKind) -> mujoco.MjSpec:
        """Build the robot alone, at its rest posture, as an editable model."""

    @abstractmethod
    def standing_qpos(self) -> np.ndarray:
        """Generalised position at rest on the ground, facing +X at the origin. Shape (nq,)."""

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
        """How actions of this robot are laid out."""
        return ActionLayout(self.command_space, self.arm_names)

    def fit(self, policy: LowLevelPolicy) -> Morphology:
        """This robot with the commands that `policy` can do, and with how it rests.

        Raises:
            BadValue: If they have nothing in common with the robot's.
        """
        fitted = copy.copy(self)
        vars(fitted).pop("layout", None)
        fitted.command_space = self.command_space.fit(
            policy.ranges, policy.dead_zones, policy.stop_rates
        )
        fitted.rest = policy.rest
        return fitted

    def rest_action(self) -> RobotAction:
        """Stand at rest: neutral command, stationary, arms at rest, grippers open."""
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
    """Names of this project's robots, as a help text lists them: ``"g1, rby1 or rby1m"``."""
    return _say_choices(MORPHOLOGIES.built_in)


def list_robot_types() -> str:
    """LeRobot types of this project's robots, as an error names them: ``"xop_g1 or xop_rby1"``."""
    return _say_choices([f"xop_{name}" for name in MORPHOLOGIES.built_in])


def _say_choices(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} or {names[-1]}"


def read_robot(name: str) -> str:
    """A robot's name, as command lines take it: LeRobot's type of it, ``"xop_g1"``, will do too."""
    return name.removeprefix("xop_")


def make_morphology(name: str) -> Morphology:
    """Make the robot `name`.

    Raises:
        UnknownName: Listing the known robots.
    """
    return MORPHOLOGIES[name]()
