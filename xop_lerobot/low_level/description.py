r"""Schema of policy tables: networks, their observations, and the joints that their outputs move.

A table is a TOML file that describes a low-level policy. docs/use/own_policy.md explains every key
by an example. msgspec validates files against the structs below and reports unknown keys, wrong
types and missing entries with their location.

Joints are named by patterns (``"*_knee_joint"``) or by the groups of `joints.GROUPS`; where numbers
are given by joint, the last matching pattern wins.
"""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct

from xop_lerobot.core.command import Mode

Positive = Annotated[int, Meta(ge=1)]
type Numbers = float | tuple[float, ...] | dict[str, float]
"""One number for all, one for each, or numbers by joint pattern."""


class _Strict(Struct, frozen=True, forbid_unknown_fields=True):
    pass


class Term(_Strict, frozen=True, tag_field="term"):
    """One term of an observation.

    Attributes:
        scale: Factors on its values.
        remembered: Whether past frames include it.
        frames: Number of frames shown: the last `frames` - 1, oldest first, then the present one.
    """

    scale: Numbers = 1.0
    remembered: bool = True
    frames: Positive = 1


class LinearVelocity(Term, frozen=True, tag="linear_velocity"):
    """Velocity of the base, body frame [m/s]. 3 numbers."""


class AngularVelocity(Term, frozen=True, tag="angular_velocity"):
    """Angular velocity of the base, body frame [rad/s]. 3 numbers."""


class Gravity(Term, frozen=True, tag="gravity"):
    """Unit gravity in the body frame. 3 numbers."""


class RollPitch(Term, frozen=True, tag="roll_pitch"):
    """Roll and pitch of the base [rad]. 2 numbers."""


class HeadingError(Term, frozen=True, tag="heading_error"):
    """Sine and cosine of the heading less the integral of the commanded yaw rate. 2 numbers."""


class JointPositions(Term, frozen=True, tag="joint_positions"):
    """Angles of joints [rad].

    Attributes:
        joints: Joints to show.
        relative: Whether angles are relative to the default posture.
        less_command: Joints whose angles are relative to their command instead.
    """

    joints: tuple[str, ...] = ("all",)
    relative: bool = True
    less_command: tuple[str, ...] = ()


class JointVelocities(Term, frozen=True, tag="joint_velocities"):
    """Velocities of joints [rad/s]."""

    joints: tuple[str, ...] = ("all",)


class JointTargets(Term, frozen=True, tag="joint_targets"):
    """Commanded angles of waist and arms [rad].

    Attributes:
        joints: Joints to show.
        relative: Whether angles are relative to the default posture.
    """

    joints: tuple[str, ...] = ("arms",)
    relative: bool = False


class Commands(Term, frozen=True, tag="commands", kw_only=True):
    """Entries of the command, in its units.

    Attributes:
        names: Entries to show.
        gated: Whether they are zero in stationary mode.
    """

    names: tuple[str, ...]
    gated: bool = False


class Walks(Term, frozen=True, tag="walks"):
    """The mode as a number, `standing` or `walking`. 1 number."""

    standing: float = 0.0
    walking: float = 1.0


class Actions(Term, frozen=True, tag="actions"):
    """Outputs of the network one step ago."""


class Sine(Term, frozen=True, tag="sin"):
    """Sine of the clock's phases. One number each."""

    phases: tuple[int, ...] = (0,)


class Cosine(Term, frozen=True, tag="cos"):
    """Cosine of the clock's phases. One number each."""

    phases: tuple[int, ...] = (0,)


class Constant(Term, frozen=True, tag="constant", kw_only=True):
    """Constant numbers."""

    values: tuple[float, ...]


class Reference(Term, frozen=True, tag="reference"):
    """Outputs of the network's reference (`ReferenceTable`)."""


class Past(_Strict, frozen=True, tag_field="term", tag="past"):
    """Past frames of the observation, of the terms that are remembered.

    Attributes:
        frames: Number of frames, without the present one.
        order: ``"oldest first"`` or ``"newest first"``.
        by: ``"frame"`` to group by frame, ``"term"`` to group by term.
    """

    frames: Positive
    order: Literal["oldest first", "newest first"] = "oldest first"
    by: Literal["frame", "term"] = "frame"


type Seen = (
    LinearVelocity
    | AngularVelocity | Gravity | RollPitch | HeadingError | JointPositions | JointVelocities
    | JointTargets | Commands | Walks | Actions | Sine | Cosine | Constant | Reference
)  # fmt: skip


class File(_Strict, frozen=True):
    """A file of network weights.

    Attributes:
        name: File name, in the cache or beside the table.
        url: Download address at a pinned revision; None if it can't be downloaded.
        sha256: Expected SHA-256; None to accept any file.
    """

    name: str
    url: str | None = None
    sha256: str | None = None


class Clock(_Strict, frozen=True):
    r"""Phases :math:`\varphi` of a gait: :math:`\varphi \leftarrow \varphi + \Delta t/T` mod 1.

    Attributes:
        period: :math:`T` [s].
        phases: Initial phases of a robot that starts to walk [cycles].
        advance: Whether the phase advances before or after it is shown.
        standing: Behaviour of a standing robot's phases: they advance (``"runs"``), are set to
            `phases` (``"resets"``), or advance until one of them reaches the first of
            `standing_phases`, and stop there (``"stops"``).
        standing_phases: Phases shown to a standing robot; None for the phases as they are.
        stance: Duty factor of a foot, which is mapped to half a cycle; None for no mapping.
    """

    period: Annotated[float, Meta(gt=0)]
    phases: tuple[float, ...] = (0.0,)
    advance: Literal["before", "after"] = "before"
    standing: Literal["runs", "resets", "stops"] = "resets"
    standing_phases: tuple[float, ...] | None = None
    stance: Annotated[float, Meta(gt=0, lt=1)] | None = None


class ReferenceTable(_Strict, frozen=True):
    """A network whose outputs are part of the observation of the policy's own network.

    Attributes:
        file: Its weights.
        statistics: File of means and standard deviations of its input and output.
        sees: Terms of its input.
    """

    file: File
    sees: tuple[Seen, ...]
    statistics: File | None = None


class Action(_Strict, frozen=True):
    r"""Mapping of outputs to joint targets: :math:`q^* = q_0 + s\,a`, within the joint limits.

    Joints without an output follow command and arm targets, or else keep the default posture.

    Attributes:
        joints: Joints of the outputs, in order.
        scale: :math:`s`.
        clip: Magnitude to which outputs are clipped; None for no limit.
        residual: Joints whose output is added to their command instead of the default posture.
        discard: Joints whose output is not used.
        hold: Joints that stay at the default posture, regardless of the command.
    """

    joints: tuple[str, ...]
    scale: Numbers = 0.25
    clip: float | None = None
    residual: tuple[str, ...] = ()
    discard: tuple[str, ...] = ()
    hold: tuple[str, ...] = ()


class Network(_Strict, frozen=True):
    """A network: its file, observation and actions.

    Attributes:
        file: Its weights: ONNX, TorchScript (``.pt``), or ``.npz`` of a multilayer perceptron.
        sees: Terms of the observation, in order.
        action: Mapping of its outputs to joint targets.
        default: Default posture by joint [rad]; 0 for joints that are not named.
        clip_seen: Magnitude to which the observation is clipped; None for no limit.
        clock: Its gait clock.
        reference: A network whose outputs it sees.
        begins: Initial content of its past frames: zeros, or the first frame.
        whole_past: Number of frames, including the present one, of a second input; None without.
    """

    file: File
    sees: tuple[Seen | Past, ...]
    action: Action
    default: dict[str, float] = {}
    clip_seen: float | None = None
    clock: Clock | None = None
    reference: ReferenceTable | None = None
    begins: Literal["zeros", "first frame"] = "zeros"
    whole_past: Positive | None = None


class Motors(_Strict, frozen=True):
    """Motor gains that a policy was trained with, by joint; other joints keep the model's.

    Attributes:
        stiffness: k_p [N m/rad].
        damping: k_d [N m s/rad].
        torque: Torque limit [N m].
    """

    stiffness: dict[str, float] = {}
    damping: dict[str, float] = {}
    torque: dict[str, float] = {}


class Rest(_Strict, frozen=True):
    """Rest pose of the base of a standing robot; see `rest.RestMap`.

    Attributes:
        axes: Two entries of the command and their grid values.
        pitch: Pitch of the base [rad]; one row per value of the first entry.
        forward: Forward position of the base relative to the middle of the feet [m]; same layout.
    """

    axes: dict[str, tuple[float, ...]]
    pitch: tuple[tuple[float, ...], ...]
    forward: tuple[tuple[float, ...], ...]


class PolicyTable(_Strict, frozen=True):
    """A low-level policy as data.

    Attributes:
        title: Display name.
        robot: The robot that it fits.
        license: Licence of its weights, an SPDX identifier.
        source: Origin.
        stationary: What runs in stationary mode: one of `networks`, or another policy.
        mobile: The same for mobile mode.
        networks: Networks by name.
        terms: Note on the licence that is logged at first use; empty for none.
        motors: Motor gains that it was trained with.
        arm_limits: Limits of the arm targets, by joint [rad].
        ranges: Command ranges that it can follow, by mode and entry: lowest, highest. Commands are
            limited to them; entries that are not named keep the robot's bounds.
        stands_below: In mobile mode a robot also stands while the magnitudes of all these entries
            are below these values.
        dead_zones: Magnitude of a velocity below which the policy does not react, by entry.
        stop_rates: Rate limits of velocities when the robot has to stop, by entry, instead of the
            robot's own [unit of the entry per second].
        rest: Lean and displacement of the base of a standing robot; None for none.
        handover_s: Time over which targets are blended from one network to the other [s].
    """

    title: str
    robot: str
    license: str
    source: str
    stationary: str
    mobile: str
    networks: dict[str, Network] = {}
    terms: str = ""
    motors: Motors = Motors()
    arm_limits: dict[str, tuple[float, float]] = {}
    ranges: dict[Literal["stationary", "mobile"], dict[str, tuple[float, float]]] = {}
    stands_below: dict[str, float] = {}
    dead_zones: dict[str, float] = {}
    stop_rates: dict[str, float] = {}
    rest: Rest | None = None
    handover_s: float = 0.2

    def find_part(self, mode: Mode) -> str:
        """Name of the network or policy that runs in `mode`."""
        return self.stationary if mode is Mode.STATIONARY else self.mobile
