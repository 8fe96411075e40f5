r"""Compile the observation terms of a table to one affine map of features.

Every observation term is affine in a few features :math:`\phi` of state, command and memory
(angles, velocities, gravity, commanded angles, sines of the gait …). So the frames of a batch are a
single matrix product, :math:`\phi M + b`, with :math:`M` and :math:`b` computed once from the
table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from xop_lerobot.core.errors import BadValue
from xop_lerobot.low_level import description as d
from xop_lerobot.low_level.joints import RobotJoints


class FeatureColumns:
    """Columns of the features; first those that all networks of a policy share.

    Args:
        joints: The robot's joints.
        num_actions: Number of outputs of the network.
        num_phases: Number of phases of its clock.
        num_references: Number of outputs of its reference network.
    """

    def __init__(
        self,
        joints: RobotJoints,
        num_actions: int = 0,
        num_phases: int = 0,
        num_references: int = 0,
    ) -> None:
        num_joints = len(joints.names)
        sizes = {
            "linear_velocity": 3,
            "angular_velocity": 3,
            "gravity": 3,
            "positions": num_joints,
            "velocities": num_joints,
            "targets": num_joints,  # commanded angles of waist and arms, else 0
            "commands": len(joints.commands),
            "gated": len(joints.commands),  # zero in stationary mode
            "walks": 1,
            "actions": num_actions,
            "sin": num_phases,
            "cos": num_phases,
            "roll_pitch": 2,
            "heading": 2,
            "reference": num_references,
        }
        self._columns: dict[str, range] = {}
        self.size = 0
        for name, size in sizes.items():
            self._columns[name] = range(self.size, self.size + size)
            self.size += size
        self.num_shared = self._columns["actions"].start

    def __getitem__(self, name: str) -> slice:
        columns = self._columns[name]
        return slice(columns.start, columns.stop)

    def pick(self, name: str, which: Sequence[int] | None = None) -> list[int]:
        """Columns of a feature, or those at the indices `which`."""
        columns = self._columns[name]
        return list(columns) if which is None else [columns[index] for index in which]


class LinearMap(NamedTuple):
    r"""Terms as an affine map of the features, :math:`\phi M + b`.

    Attributes:
        matrix: M. Shape (F, w).
        offset: b. Shape (w,).
        widths: Number of values of each term.
    """

    matrix: np.ndarray
    offset: np.ndarray
    widths: list[int]

    def __call__(self, features: np.ndarray) -> np.ndarray:
        """Compute the terms of a batch. Shape (n, F) -> (n, w)."""
        return features @ self.matrix + self.offset


class TermReader:
    """Compiles the terms of one network to a `LinearMap`.

    Args:
        joints: The robot's joints.
        default: The network's default posture [rad]. Shape (nu,).
        outputs: Joints of its outputs.
        columns: Columns of the features.
        num_phases: Number of phases of its clock.
    """

    def __init__(
        self,
        joints: RobotJoints,
        default: np.ndarray,
        outputs: Sequence[int],
        columns: FeatureColumns,
        num_phases: int,
    ) -> None:
        self._joints, self._default, self._outputs = joints, default, outputs
        self._columns, self._num_phases = columns, num_phases

    def read(self, terms: Sequence[d.Seen]) -> LinearMap:
        """Compile `terms` to a map.

        Raises:
            BadValue: If a term names something that the robot does not have.
        """
        parts = [self._read(term) for term in terms]
        matrices, offsets = zip(*parts, strict=True) if parts else ([], [])
        empty = np.zeros((self._columns.size, 0)), np.zeros(0)
        return LinearMap(
            np.concatenate([empty[0], *matrices], axis=1),
            np.concatenate([empty[1], *offsets]),
            [len(offset) for offset in offsets],
        )

    def _read(self, term: d.Seen) -> tuple[np.ndarray, np.ndarray]:
        """Matrix and offset of one term. Shapes (F, w), (w,)."""
        sources, chosen = self._find_sources(term)
        width = len(term.values) if isinstance(term, d.Constant) else len(sources)
        scale = spread_over(term.scale, self._joints, chosen, width, describe(term))
        matrix, offset = np.zeros((self._columns.size, width)), np.zeros(width)
        matrix[sources, range(len(sources))] = 1.0
        match term:
            case d.Constant():
                offset[:] = term.values
            case d.Walks():
                offset[:], matrix[sources] = term.standing, term.walking - term.standing
            case d.JointTargets():
                offset[:] = -self._default[chosen] * term.relative
            case d.JointPositions():
                offset[:] = -self._default[chosen] * term.relative
                for joint in self._joints.select(term.less_command):
                    if joint not in chosen:
                        name = self._joints.names[joint]
                        raise BadValue(f"less_command names {name}, which the term does not show")
                    row = chosen.index(joint)
                    matrix[self._columns.pick("targets", [joint]), row] = -1.0
                    offset[row] = 0.0
        return matrix * scale, offset * scale

    def _find_sources(self, term: d.Seen) -> tuple[list[int], Sequence[int]]:
        """Columns of the features of a term, and the joints that they belong to."""
        joints, name = self._joints, _FEATURES.get(type(term), "")
        which: Sequence[int] | None = None
        chosen: Sequence[int] = ()
        match term:
            case d.JointPositions() | d.JointVelocities() | d.JointTargets():
                which = chosen = joints.select(term.joints)
            case d.Actions():
                chosen = self._outputs
            case d.Commands():
                name = "gated" if term.gated else name
                which = [joints.find_command(entry) for entry in term.names]
            case d.Sine() | d.Cosine():
                which = term.phases
                if max(which, default=0) >= self._num_phases:
                    raise BadValue(
                        f"{describe(term)} shows phase {max(which)}, but the clock has "
                        f"{self._num_phases} phases"
                    )
            case d.Constant():
                which = ()
        if isinstance(term, d.JointTargets):
            free = [joints.names[joint] for joint in chosen if not joints.is_commanded(joint)]
            if free:
                raise BadValue(f"{describe(term)}: no command or target for {', '.join(free)}")
        return self._columns.pick(name, which), chosen


_FEATURES: Mapping[type, str] = {
    d.LinearVelocity: "linear_velocity",
    d.AngularVelocity: "angular_velocity",
    d.Gravity: "gravity",
    d.RollPitch: "roll_pitch",
    d.HeadingError: "heading",
    d.JointPositions: "positions",
    d.JointVelocities: "velocities",
    d.JointTargets: "targets",
    d.Commands: "commands",
    d.Walks: "walks",
    d.Actions: "actions",
    d.Sine: "sin",
    d.Cosine: "cos",
    d.Constant: "walks",  # placeholder: a constant uses no column
    d.Reference: "reference",
}
"""Feature of which a term shows all or part."""


def describe(term: d.Seen | d.Past) -> str:
    """Name of a term in messages."""
    return f"term {term.__struct_config__.tag}"


def spread_over(
    numbers: d.Numbers, joints: RobotJoints, chosen: Sequence[int], width: int, what: str
) -> np.ndarray:
    """Expand numbers to one per value; numbers by pattern are for the joints `chosen`. (width,).

    Raises:
        BadValue: If their count does not fit, or numbers by pattern have no joints.
    """
    if isinstance(numbers, Mapping):
        if not chosen:
            raise BadValue(f"{what} has no joints, so its scale can't be given by joint")
        return joints.spread(numbers, 1.0)[list(chosen)]
    if isinstance(numbers, tuple) and len(numbers) != width:
        raise BadValue(f"{what} has {width} numbers, and its scale has {len(numbers)}")
    return np.broadcast_to(np.asarray(numbers, dtype=float), (width,))
