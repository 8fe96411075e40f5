r"""What a table says of a low-level policy: networks, what they see, what their outputs move.

A table is a TOML file. docs/use/own_policy.md explains every key by an example; the structs below
are its grammar, and msgspec checks a file against them: an unknown key, a wrong type or a missing
entry is named with its place.

Joints are named by patterns (``"*_knee_joint"``) or by the groups of `joints.GROUPS`; where numbers
go by joint, the last pattern that fits counts.
"""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct

from xop_lerobot.core.command import Mode

Positive = Annotated[int, Meta(ge=1)]
type Numbers = float | tuple[float, ...] | dict[str, float]
"""One number for all, one for each, or numbers by pattern of joints."""


class _Strict(Struct, frozen=True, forbid_unknown_fields=True):
    pass


class Term(_Strict, frozen=True, tag_field="term"):
    """One term of an observation.

    Attributes:
        scale: Factors of its numbers.
        remembered: Whether the frames of the past hold it.
        frames: How many times it is shown: as it was in the frames before, oldest first, and now.
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
        joints: Which.
        relative: Whether they are shown less the default posture.
        less_command: Joints that are shown less their command instead.
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
        joints: Which.
        relative: Whether they are shown less the default posture.
    """

    joints: tuple[str, ...] = ("arms",)
    relative: bool = False


class Commands(Term, frozen=True, tag="commands", kw_only=True):
    """Entries of the command, in its units.

    Attributes:
        names: Which.
        gated: Whether they are shown as zero in stationary mode.
    """

    names: tuple[str, ...]
    gated: bool = False


class Walks(Term, frozen=True, tag="walks"):
    """The mode: `standing` or `walking`. 1 number."""

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
    """Numbers that never change."""

    values: tuple[float, ...]


class Reference(Term, frozen=True, tag="reference"):
    """Outputs of the network's reference (`ReferenceTable`)."""


class Past(_Strict, frozen=True, tag_field="term", tag="past"):
    """Frames of the past: what is remembered of an observation.

    Attributes:
        frames: How many; the one of now is not among them.
        order: ``"oldest first"`` or ``"newest first"``.
        by: ``"frame"`` for one frame after the other, ``"term"`` for all of a term, then all of
            the next.
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
    """A file of weights.

    Attributes:
        name: Its name, in the cache or beside the table.
        url: Where it is published, at a pinned revision; None if it can't be downloaded.
        sha256: Its SHA-256; None where any file is as good.
    """

    name: str
    url: str | None = None
    sha256: str | None = None


class Clock(_Strict, frozen=True):
    r"""Phases :math:`\varphi` of a gait: :math:`\varphi \leftarrow \varphi + \Delta t/T` mod 1.

    Attributes:
        period: :math:`T` [s].
        phases: With which a robot sets off.
        advance: Whether time passes before a phase is shown, or after.
        standing: What becomes of the phases of a robot that stands: they go on (``"runs"``), are
            set back to `phases` (``"resets"``), or go on until one of them is at the first of
            `standing_phases`, and stop there (``"stops"``).
        standing_phases: What a robot that stands is shown; None for its phases as they are.
        stance: Share of a cycle in which a foot is on the ground, which is stretched to half of
            the sine; None for none.
    """

    period: Annotated[float, Meta(gt=0)]
    phases: tuple[float, ...] = (0.0,)
    advance: Literal["before", "after"] = "before"
    standing: Literal["runs", "resets", "stops"] = "resets"
    standing_phases: tuple[float, ...] | None = None
    stance: Annotated[float, Meta(gt=0, lt=1)] | None = None


class ReferenceTable(_Strict, frozen=True):
    """A network that turns terms into numbers which the policy's own network sees.

    Attributes:
        file: Its weights.
        statistics: File of means and deviations of its input and output.
        sees: Its input.
    """

    file: File
    sees: tuple[Seen, ...]
    statistics: File | None = None


class Action(_Strict, frozen=True):
    r"""What the outputs move: :math:`q^* = q_0 + s\,a`, within the joints' limits.

    Joints that no output moves follow command and arm targets, else keep the default posture.

    Attributes:
        joints: Joints of the outputs, in order.
        scale: :math:`s`.
        clip: Size to which outputs are clipped; None for no limit.
        residual: Joints whose output is added to their command, in place of the default posture.
        discard: Joints whose output is not used.
        hold: Joints that stay at the default posture whatever is commanded.
    """

    joints: tuple[str, ...]
    scale: Numbers = 0.25
    clip: float | None = None
    residual: tuple[str, ...] = ()
    discard: tuple[str, ...] = ()
    hold: tuple[str, ...] = ()


class Network(_Strict, frozen=True):
    """A network: its file, what it sees, what it moves.

    Attributes:
        file: Its weights: ONNX, TorchScript (``.pt``), or ``.npz`` of a multilayer perceptron.
        sees: The observation, in order.
        action: What its outputs move.
        default: Default posture by joint [rad]; 0 where nothing is said.
        clip_seen: Size to which the observation is clipped; None for no limit.
        clock: Its gait.
        reference: A network before it.
        begins: What its past holds at first: zeros, or the first frame.
        whole_past: Number of frames, with that of now, of a second input; None without one.
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
    """Motors that a policy was trained with, by joint; those not named are the model's.

    Attributes:
        stiffness: [N m/rad].
        damping: [N m s/rad].
        torque: Largest torque [N m].
    """

    stiffness: dict[str, float] = {}
    damping: dict[str, float] = {}
    torque: dict[str, float] = {}


class Rest(_Strict, frozen=True):
    """Where the base of a standing robot comes to rest; see `rest.RestMap`.

    Attributes:
        axes: Two entries of the command and the values at which it was measured.
        pitch: Pitch of the base [rad], a row for each value of the first entry.
        forward: Place of the base ahead of the middle of the feet [m], the same.
    """

    axes: dict[str, tuple[float, ...]]
    pitch: tuple[tuple[float, ...], ...]
    forward: tuple[tuple[float, ...], ...]


class PolicyTable(_Strict, frozen=True):
    """A low-level policy as data.

    Attributes:
        title: Its name, as people say it.
        robot: The robot that it fits.
        license: Licence of its weights, an SPDX identifier.
        source: Where it comes from.
        stationary: What runs in stationary mode: one of `networks`, or another policy.
        mobile: What runs in mobile mode.
        networks: Networks by name.
        terms: What a user has to know of the licence, said at first use; empty for nothing.
        motors: Motors that it was trained with.
        arm_limits: Angles within which arm targets are kept, by joint [rad].
        ranges: What it can do in each mode: entry of the command -> lowest, highest. What is
            outside is not asked of it; entries that are not named keep the robot's bounds.
        stands_below: In mobile mode a robot stands as well while all these entries of the command
            are smaller in size.
        dead_zones: Size of a velocity under which nothing happens, by entry of the command.
        stop_rates: How fast velocities may end where the robot is to stand, by entry, in place of
            the robot's own limits [unit of the entry per second].
        rest: How the base of a standing robot leans and moves unasked; None where it does not.
        handover_s: Time in which targets go over from one network's to another's [s].
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
        """Name of the network, or of the policy, that runs in `mode`."""
        return self.stationary if mode is Mode.STATIONARY else self.mobile
