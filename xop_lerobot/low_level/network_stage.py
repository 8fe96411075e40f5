"""One network of a policy, batched: observation, memory, and mapping of outputs to joints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.transforms import quat_yaw, wrap_angle
from xop_lerobot.low_level import description as d
from xop_lerobot.low_level.clock import GaitClock
from xop_lerobot.low_level.joints import RobotJoints, as_index
from xop_lerobot.low_level.networks import LoadedNetwork, ReferenceNetwork
from xop_lerobot.low_level.policy import POLICY_DT
from xop_lerobot.low_level.terms import FeatureColumns, TermReader, describe, spread_over


class Situation(NamedTuple):
    """Inputs of a batch that all networks of a policy share.

    Attributes:
        shared: Features that need no memory (`FeatureColumns`). Shape (n, F).
        stands: Mask of the robots that stand. Shape (n,), bool.
        quat: Orientation of the base, wxyz. Shape (n, 4).
        yaw_rate: Commanded yaw rate [rad/s]. Shape (n,).
    """

    shared: np.ndarray
    stands: np.ndarray
    quat: np.ndarray
    yaw_rate: np.ndarray

    def choose(self, rows: np.ndarray) -> Situation:
        """Select rows of the batch."""
        return Situation(*(each[rows] for each in self))


class NetworkStage:
    """One network with its memory; a pure function of a batch.

    The memory holds the last outputs and, if the table needs them: the clock's phases, the desired
    heading and whether the robot stood, the recurrent state, whether a frame was seen, and the
    past frames, oldest first.

    Args:
        table: Description of the network.
        joints: The robot's joints.
        network: Its weights.
        reference: The reference network, if the table has one.

    Attributes:
        memory_size: Size of the memory.
        num_inputs: Width of the observation.
        sees_velocity: Whether the observation includes the linear velocity of the base.
        held: Joints that stay at the default posture, regardless of the command.

    Raises:
        BadValue: If the table does not fit the robot, or the network the table.
    """

    def __init__(
        self,
        table: d.Network,
        joints: RobotJoints,
        network: LoadedNetwork,
        reference: ReferenceNetwork | None = None,
    ) -> None:
        self._joints, self._network, self._reference = joints, network, reference
        self._default = joints.spread(table.default, 0.0)
        self._clip_seen = table.clip_seen
        self._clock = None if table.clock is None else GaitClock(table.clock)
        num_phases = 0 if table.clock is None else len(table.clock.phases)
        self._read_action(table.action)
        num_references = 0 if reference is None else reference.num_outputs
        self._columns = FeatureColumns(joints, len(self._outputs), num_phases, num_references)
        reader = TermReader(joints, self._default, self._outputs, self._columns, num_phases)
        self._read_observation(table, reader)
        seen = [*table.sees, *(() if table.reference is None else table.reference.sees)]
        self._sees_heading = any(isinstance(term, d.HeadingError) for term in seen)
        self.sees_velocity = any(isinstance(term, d.LinearVelocity) for term in seen)
        self._sees_tilt = any(isinstance(term, d.RollPitch) for term in seen)
        if reference is not None and table.reference is not None:
            self._reference_terms = reader.read(table.reference.sees)
            width = len(self._reference_terms.offset)
            if reference.num_inputs not in (None, width):
                raise BadValue(
                    f"the reference has {reference.num_inputs} inputs, and its terms are {width} "
                    "numbers"
                )
        self._lay_out_memory(num_phases, begins=table.begins == "first frame")

    # ------------------------------------------------------------ set-up from the table

    def _read_action(self, action: d.Action) -> None:
        joints, outputs = self._joints, self._joints.select(action.joints)
        found = self._network.num_outputs
        if found not in (None, len(outputs)):
            raise BadValue(
                f"the network has {found} outputs, and action.joints are {len(outputs)} joints"
            )
        unused, residual = joints.select(action.discard), joints.select(action.residual)
        scale = spread_over(action.scale, joints, outputs, len(outputs), "action")
        self._outputs, self._clip = outputs, action.clip
        used = np.array([row for row, joint in enumerate(outputs) if joint not in unused])
        moved = np.array(outputs)[used]
        self._used, self._moved = as_index(used), as_index(moved)
        self._scale = scale[used]
        self._added = as_index(np.flatnonzero(np.isin(moved, residual)))
        self._base = as_index(moved[self._added])  # joints to whose command outputs are added
        self._centre = self._default[moved]
        self._centre[self._added] = 0.0
        held = self.held = joints.select(action.hold)
        free = [not joints.is_commanded(joint) for joint in range(len(joints.names))]
        resting = np.flatnonzero(np.isin(range(len(joints.names)), held) | free)
        self._resting, self._postures = as_index(resting), self._default[resting]

    def _read_observation(self, table: d.Network, reader: TermReader) -> None:
        """Find the position of each present and past value in the observation."""
        now = [term for term in table.sees if not isinstance(term, d.Past)]
        self._terms = reader.read(now)
        starts = np.concatenate([[0], np.cumsum(self._terms.widths)]).astype(int)
        spans = [range(*pair) for pair in zip(starts[:-1], starts[1:], strict=True)]
        kept: list[int] = []  # columns of a frame that are remembered
        places = []  # columns of each term in the remembered part
        for term, span in zip(now, spans, strict=True):
            places.append(range(len(kept), len(kept) + len(span) * term.remembered))
            kept += span if term.remembered else ()
        self._kept = np.array(kept, dtype=int)
        self._keeps_all = len(kept) == starts[-1]
        self._whole = table.whole_past or 0
        shown = [term.frames - (not isinstance(term, d.Past)) for term in table.sees]
        self._num_frames = max([self._whole - 1, 0, *shown])
        self._past_size, self._now_size = self._num_frames * len(kept), int(starts[-1])
        order: list[int] = []  # columns of the buffer, which is the past, then the present frame
        sizes, left = [], zip(now, spans, places, strict=True)
        for each in table.sees:
            if isinstance(each, d.Past):
                groups = [range(len(kept))] if each.by == "frame" else places
                part = self._find_past(each.frames, groups, newest=each.order == "newest first")
            else:
                term, span, place = next(left)
                if term.frames > 1 and not term.remembered:
                    raise BadValue(f"{describe(term)} has frames, so it must be remembered")
                part = self._find_past(term.frames - 1, [place], newest=False)
                part += [self._past_size + column for column in span]
            order += part
            sizes.append(f"{describe(each)} {len(part)}")
        if self._network.num_inputs not in (None, len(order)):
            raise BadValue(
                f"the network has {self._network.num_inputs} inputs, and its terms are "
                f"{len(order)} numbers: {', '.join(sizes)}"
            )
        self.num_inputs = len(order)
        in_order = order == list(range(self._past_size + self._now_size))
        self._order = None if in_order else np.array(order, dtype=int)

    def _find_past(self, count: int, groups: Sequence[range], *, newest: bool) -> list[int]:
        """Columns of the last `count` past frames, by groups of remembered columns."""
        frames = list(range(self._num_frames - count, self._num_frames))  # oldest first
        if newest:
            frames.reverse()
        size = len(self._kept)
        return [frame * size + place for group in groups for frame in frames for place in group]

    def _lay_out_memory(self, num_phases: int, *, begins: bool) -> None:
        sizes = {
            "actions": len(self._outputs),
            "phases": num_phases,
            "heading": 2 if self._sees_heading else 0,  # desired heading; whether the robot stood
            "hidden": self._network.num_hidden,
            "begun": int(begins),
            "past": self._past_size,
        }
        self._begins = begins
        self._places: dict[str, slice] = {}
        self.memory_size = 0
        for name, size in sizes.items():
            self._places[name] = slice(self.memory_size, self.memory_size + size)
            self.memory_size += size

    # ------------------------------------------------------------ one step

    def initial_memory(self, n: int) -> np.ndarray:
        """Memory before the first step, of a standing robot. Shape (n, memory_size)."""
        memory = np.zeros((n, self.memory_size))
        if self._clock is not None:
            memory[:, self._places["phases"]] = self._clock.initial
        if self._sees_heading:
            memory[:, self._places["heading"].stop - 1] = 1.0
        return memory

    def act(self, situation: Situation, memory: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Run the network once.

        Args:
            situation: The batch.
            memory: Memory before the step. Shape (n, memory_size).

        Returns:
            Targets of all joints [rad], before any limit, shape (n, nu), and the memory after.
        """
        seen, whole, after = self.observe(situation, memory)
        actions, hidden = self._network(seen, memory[:, self._places["hidden"]], whole)
        if self._clip is not None:
            actions = np.minimum(np.maximum(actions, -self._clip), self._clip)
        after[:, self._places["actions"]] = actions
        after[:, self._places["hidden"]] = hidden
        targets = self._rest(situation)
        moved = self._centre + self._scale * actions[:, self._used]
        moved[:, self._added] += targets[:, self._base]
        targets[:, self._moved] = moved
        return targets, after

    def watch(self, situation: Situation, memory: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Update the memory by a step that another network made (shadowing).

        The last outputs are set to those that would have given `targets`, so that this network can
        take over at any time. A recurrent state is reset.

        Args:
            situation: The batch.
            memory: Memory before the step. Shape (n, memory_size).
            targets: Targets of all joints under this network's motors [rad]. Shape (n, nu).

        Returns:
            The memory after the step.
        """
        _, _, after = self.observe(situation, memory)
        moved = targets[:, self._moved] - self._centre
        moved[:, self._added] -= self._rest(situation)[:, self._base]
        outputs = np.zeros((len(targets), len(self._outputs)))
        outputs[:, self._used] = moved / self._scale
        if self._clip is not None:
            outputs = np.clip(outputs, -self._clip, self._clip)
        after[:, self._places["actions"]] = outputs
        after[:, self._places["hidden"]] = 0.0
        return after

    def observe(
        self, situation: Situation, memory: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
        """Compute the observation.

        Returns:
            The observation, float32, shape (n, num_inputs); the second input, or None; and the
            memory after the step, still without outputs and recurrent state.
        """
        after = np.empty((len(memory), self.memory_size))
        now = self._terms(self._compute_features(situation, memory, after))
        if not self._past_size:
            seen = now if self._order is None else now[:, self._order]
            return self._finish(seen), None, after
        buffer = np.empty((len(memory), self._past_size + self._now_size))
        buffer[:, self._past_size :] = now
        past = buffer[:, : self._past_size]
        past[:] = memory[:, self._places["past"]]
        frame = now if self._keeps_all else now[:, self._kept]
        if self._begins:
            begun = self._places["begun"]
            fresh = memory[:, begun.start] == 0
            past[fresh] = np.tile(frame[fresh], self._num_frames)
            after[:, begun] = 1.0
        later, size = after[:, self._places["past"]], frame.shape[1]
        later[:, :-size] = past[:, size:]
        later[:, -size:] = frame
        seen = buffer if self._order is None else buffer[:, self._order]
        whole = None
        if self._whole:
            frames = np.concatenate([past, frame], axis=1)
            whole = frames[:, -self._whole * size :].astype(np.float32)
        return self._finish(seen), whole, after

    def _finish(self, seen: np.ndarray) -> np.ndarray:
        if self._clip_seen is not None:
            seen = np.clip(seen, -self._clip_seen, self._clip_seen)
        return seen.astype(np.float32)

    def _rest(self, situation: Situation) -> np.ndarray:
        """Targets of the joints without an output. Shape (n, nu)."""
        targets = situation.shared[:, self._columns["targets"]].copy()
        targets[:, self._resting] = self._postures
        return targets

    def _compute_features(
        self, situation: Situation, memory: np.ndarray, after: np.ndarray
    ) -> np.ndarray:
        """Compute all features; writes phases and heading to the memory `after`. (n, F)."""
        columns = self._columns
        features = np.zeros((len(memory), columns.size))
        features[:, : columns.num_shared] = situation.shared
        features[:, columns["actions"]] = memory[:, self._places["actions"]]
        if self._clock is not None:
            shown, phases = self._clock.step(memory[:, self._places["phases"]], situation.stands)
            after[:, self._places["phases"]] = phases
            features[:, columns["sin"]] = np.sin(2 * np.pi * shown)
            features[:, columns["cos"]] = np.cos(2 * np.pi * shown)
        if self._sees_tilt:
            features[:, columns["roll_pitch"]] = compute_roll_pitch(situation.quat)
        if self._sees_heading:
            wanted, stood = memory[:, self._places["heading"]].T
            yaw = quat_yaw(situation.quat)
            wanted = np.where(stood > 0, yaw, wanted + situation.yaw_rate * POLICY_DT)
            turn = yaw - wanted
            after[:, self._places["heading"]] = np.stack(
                [wrap_angle(wanted), situation.stands], axis=1
            )
            features[:, columns["heading"]] = np.stack([np.sin(turn), np.cos(turn)], axis=1)
        if self._reference is not None:
            features[:, columns["reference"]] = self._reference(self._reference_terms(features))
        return features


def compute_roll_pitch(quat: np.ndarray) -> np.ndarray:
    """Roll and pitch of the base [rad]. Shape (n, 4) -> (n, 2)."""
    w, x, y, z = quat.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    return np.stack([roll, pitch], axis=1)
