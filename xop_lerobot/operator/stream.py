"""Plausibility checks of a live stream, per limb; each rejection is counted."""

from __future__ import annotations

import dataclasses
import itertools
import math
import statistics
from collections import Counter, deque
from dataclasses import dataclass

import numpy as np

from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.state import FRAMES
from xop_lerobot.core.transforms import (
    make_pose,
    pose_inverse,
    pose_multiply,
    quat_conjugate,
    quat_multiply,
    rotation_error,
)
from xop_lerobot.operator.frame import OperatorFrame

MIN_STEP_TIME = 1 / 90
"""Lower bound on dt in the motion limits: however close two stamps are, the frames show moments at
least this far apart [s]."""
MAX_STEP_TIME = 0.04
"""Upper bound on the time for a limb's motion, however long nothing was accepted [s]."""
MAX_BODY_TIME = 0.1
"""The same for a turn of the whole body, longer because people turn on purpose while a network
stalls [s]."""
RENEWALS = 5
"""Number of pose changes from which their rate is measured."""
RENEWAL_S = 0.5
"""Time without a change after which a pose is constant [s]."""
ARM = 0.2
"""Lever arm by which a rotation is compared with a translation [m]."""
NORM_TOLERANCE = 1e-2
"""Largest deviation of a quaternion's norm from 1."""
SPACE = 100.0
"""Largest plausible distance from the origin along an axis [m]."""
MAX_PINCH = 0.4
"""Largest plausible distance of thumb and index [m]."""
OPEN_PINCH = 0.08
"""Distance of thumb and index assumed before a hand is first seen [m]."""


@dataclass
class GuardConfig:
    """Limits of the plausibility checks.

    Attributes:
        stale: Time without an accepted frame after which the head counts as lost [s].
        frozen: Time without any change of a hand's pose, while the stream continues, after which
            the hand is lost: devices keep sending the last pose [s].
        settle: Time for which a limb must move smoothly after a jump until it is accepted again;
            for the head `stale` more, so that an engagement ends first [s].
        head_speed: Largest speed of the head [m/s].
        hand_speed: Largest speed of a hand [m/s].
        head_turn: Largest turn rate of the head [rad/s].
        hand_turn: Largest turn rate of a hand [rad/s].
        body_turn: Largest turn rate of head and hands together, as of the whole person [rad/s].
        slack: Position tolerance for noise [m].
        head_slack: Rotation tolerance of the head for noise [rad].
        turn_slack: Rotation tolerance of a hand for noise [rad].
        reach: Largest distance of a hand from the head [m].
    """

    stale: float = 0.25
    frozen: float = 0.08
    settle: float = 0.15
    head_speed: float = 4.0
    hand_speed: float = 8.0
    head_turn: float = 15.0
    hand_turn: float = 25.0
    body_turn: float = 5.0
    slack: float = 0.03
    head_slack: float = 0.035
    turn_slack: float = 0.3
    reach: float = 1.3

    def __post_init__(self) -> None:
        """Check every value.

        Raises:
            BadValue: If one is not a finite number above 0.
        """
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value > 0):
                raise BadValue(f"guard.{name} must be finite and above 0, got {value}")


def _find_nonsense(pose: np.ndarray) -> str | None:
    """Return why `pose` is impossible, None if it is possible. Shape (7,)."""
    if not np.isfinite(pose).all():
        return "not_finite"
    if abs(float(np.linalg.norm(pose[3:])) - 1) > NORM_TOLERANCE:
        return "no_rotation"
    return "out_of_space" if float(np.abs(pose[:3]).max()) > SPACE else None


class LimbGuard:
    r"""Checks the successive poses of one limb.

    A pose is a jump if its distance from the last accepted one exceeds :math:`v_{max} dt + slack`,
    with dt limited to 1/90 to 0.04 s, or its rotation the corresponding limit. Poses that continue
    smoothly after a jump are accepted after `settle`, not before: elapsed time alone does not turn
    a jump into a motion.

    Args:
        speed: Largest speed [m/s].
        turn: Largest turn rate [rad/s].
        settle: Time for which a new place must persist [s].
        slack: Position tolerance for noise [m].
        turn_slack: Rotation tolerance for noise [rad].
    """

    def __init__(
        self, speed: float, turn: float, settle: float, slack: float, turn_slack: float
    ) -> None:
        self._speed, self._turn, self._settle = speed, turn, settle
        self._slack, self._turn_slack = slack, turn_slack
        self.pose: np.ndarray | None = None
        """Last accepted pose. Shape (7,)."""
        self._time = 0.0
        self._raw = np.full(7, np.nan)
        self._changed_at = 0.0
        self._changes: deque[float] = deque(maxlen=RENEWALS)
        self._candidate: tuple[float, np.ndarray] | None = None
        self._candidate_since = 0.0
        self.relocations = 0
        """Number of jumps accepted as the limb's new place."""

    def judge(
        self, time: float, pose: np.ndarray, frozen: float, jumped: bool = False
    ) -> str | None:
        """Check the pose of `time` [s]; return the reason of a rejection, None if accepted.

        Args:
            time: Stamp of the frame [s].
            pose: x y z qw qx qy qz. Shape (7,).
            frozen: Time without any change after which the limb is lost [s].
            jumped: Whether the limb is known to have jumped.
        """
        reason = _find_nonsense(pose)
        if reason is not None:
            return reason
        if not np.array_equal(pose, self._raw):
            self._raw, self._changed_at = np.array(pose, dtype=float), time
            self._changes.append(time)
        elif time - self._changed_at > frozen:
            return "frozen"
        if self.pose is None or not (jumped or self._has_jumped(time, pose)):
            self._believe(time, pose)
            return None
        candidate = self._candidate
        if candidate is None or not self._follows(*candidate, time, pose):
            self._candidate_since = time
        self._candidate = (time, np.array(pose, dtype=float))
        if time - self._candidate_since < self._settle:
            return "jump"
        self.relocations += 1
        self._believe(time, pose)
        return None

    def compute_rate(self, time: float) -> float | None:
        """Recent rate of change of the pose [Hz]; None if it is constant or new."""
        changes = self._changes
        if len(changes) < RENEWALS or time - changes[-1] > RENEWAL_S:
            return None
        return 1 / statistics.median(b - a for a, b in itertools.pairwise(changes))

    def _believe(self, time: float, pose: np.ndarray) -> None:
        self._time, self.pose, self._candidate = time, np.array(pose, dtype=float), None

    def _has_jumped(self, time: float, pose: np.ndarray) -> bool:
        assert self.pose is not None
        if not self._follows(self._time, self.pose, time, pose):
            return True
        if self._candidate is None:
            return False
        # Within the motion limits by now, but still nearer to where it jumped to: not back.
        steps = (compute_step(last, pose) for last in (self._candidate[1], self.pose))
        (moved, turned), (moved_back, turned_back) = steps
        return moved + ARM * turned < moved_back + ARM * turned_back

    def _follows(self, before: float, last: np.ndarray, time: float, pose: np.ndarray) -> bool:
        dt = min(max(time - before, MIN_STEP_TIME), MAX_STEP_TIME)
        moved, turned = compute_step(last, pose)
        return (
            moved <= self._speed * dt + self._slack and turned <= self._turn * dt + self._turn_slack
        )


def compute_step(last: np.ndarray, pose: np.ndarray) -> tuple[float, float]:
    """Compute distance [m] and angle [rad] between two poses of shape (7,)."""
    turn = rotation_error(pose[3:], last[3:])
    return float(np.linalg.norm(pose[:3] - last[:3])), float(np.linalg.norm(turn))


def goes_along(before: np.ndarray, after: np.ndarray, last: np.ndarray, pose: np.ndarray) -> bool:
    """Whether a hand moved rigidly with the head rather than staying in place.

    Args:
        before: Head pose. Shape (7,).
        after: Later head pose. Shape (7,).
        last: Hand pose at `before`. Shape (7,).
        pose: Hand pose at `after`. Shape (7,).
    """
    turn = quat_multiply(after[3:], quat_conjugate(before[3:]))
    there, back = make_pose(after[:3], turn), make_pose(before[:3], np.array([1.0, 0, 0, 0]))
    carried = pose_multiply(there, pose_multiply(pose_inverse(back), last))
    (moved, turned), (stayed, unturned) = compute_step(carried, pose), compute_step(last, pose)
    return moved + ARM * turned < (stayed + ARM * unturned) / 2


class StreamGuard:
    """Turns a device's messages into plausible frames.

    A frame with an implausible head is dropped; if that persists, the stream is stale. An
    implausible hand is marked as lost and keeps its last pose and pinch, so that no bad number
    passes. Everything depends on the stamps alone.

    When a headset recentres, its whole space turns and shifts although nobody has moved. This is
    detected by hands that turn with the head faster than a person can turn.

    Args:
        config: Limits.
    """

    def __init__(self, config: GuardConfig | None = None) -> None:
        self.config = config or GuardConfig()
        self.counts: Counter[str] = Counter()
        """Number of rejected frames or limbs by reason; also `taken` and `repeated`."""
        self.reset()

    def reset(self) -> None:
        """Forget all frames, as after a new connection; the counts remain."""
        c = self.config
        # A head that has jumped must go stale for the readers before it is accepted again.
        settle = c.settle + c.stale
        self._limbs = [
            LimbGuard(c.head_speed, c.head_turn, settle, c.slack, c.head_slack),
            *(
                LimbGuard(c.hand_speed, c.hand_turn, c.settle, c.slack, c.turn_slack)
                for _ in FRAMES[1:]
            ),
        ]
        self._taken: OperatorFrame | None = None
        self._pinch = np.full(2, OPEN_PINCH)
        self._time = self._source_time = -math.inf
        self._raw: np.ndarray | None = None

    @property
    def relocations(self) -> int:
        """Number of relocations of the head; each one requires a new alignment."""
        return self._limbs[0].relocations

    def compute_hand_rates(self, time: float) -> tuple[float | None, float | None]:
        """Rates at which left and right hand poses change [Hz]; None if unknown."""
        left, right = (limb.compute_rate(time) for limb in self._limbs[1:])
        return left, right

    def take(self, frame: OperatorFrame, source_time: float | None = None) -> OperatorFrame | None:
        """Check a frame.

        Args:
            frame: The device's frame, stamped with its time of receipt.
            source_time: The device's own stamp or number, if any: only newer frames are accepted.

        Returns:
            The frame with implausible hands marked as lost, or None if it is dropped.
        """
        reason = self._find_old(frame, source_time)
        if reason is None:
            self._time = frame.time
            if source_time is not None:
                self._source_time = source_time
            raw = np.concatenate([*(frame.pose(name) for name in FRAMES), frame.pinch])
            # Devices faster than their tracking send frames twice, also after tracking has died.
            if self._raw is not None and np.array_equal(raw, self._raw):
                reason = "repeated"
            self._raw = raw
        if reason is None:
            reason = self._judge_head(frame)
        if reason is not None:
            self.counts[reason] += 1
            return None
        self.counts["taken"] += 1
        self._taken = self._make(frame)
        return self._taken

    def _find_old(self, frame: OperatorFrame, source_time: float | None) -> str | None:
        if frame.time <= self._time:
            return "out_of_order"
        if source_time is not None and not source_time > self._source_time:
            return "repeated" if source_time == self._source_time else "out_of_order"
        return None

    def _judge_head(self, frame: OperatorFrame) -> str | None:
        if not frame.tracked[0]:
            return "head_lost"
        jumped = self._has_space_jumped(frame)
        reason = self._limbs[0].judge(frame.time, frame.head, self.config.stale, jumped)
        return None if reason is None else f"head_{reason}"

    def _has_space_jumped(self, frame: OperatorFrame) -> bool:
        """Whether head and hands have turned together faster than a person can."""
        last = self._taken
        if last is None or _find_nonsense(frame.head) is not None:
            return False
        dt = min(max(frame.time - last.time, MIN_STEP_TIME), MAX_BODY_TIME)
        turned = compute_step(last.head, frame.head)[1]
        if turned <= self.config.body_turn * dt + self.config.head_slack:
            return False
        hands = [
            (last.pose(name), frame.pose(name))
            for name, was, now in zip(FRAMES[1:], last.tracked[1:], frame.tracked[1:], strict=True)
            if was and now and _find_nonsense(frame.pose(name)) is None
        ]
        return bool(hands) and all(goes_along(last.head, frame.head, *pair) for pair in hands)

    def _make(self, frame: OperatorFrame) -> OperatorFrame:
        tracked = np.ones(3, dtype=bool)
        wrists, pinch = [], self._pinch.copy()
        for hand, name in enumerate(FRAMES[1:]):
            reason = self._judge_hand(frame, hand, name)
            if reason is None:
                pinch[hand] = frame.pinch[hand]
            else:
                self.counts[f"{name.removesuffix('_wrist')}_{reason}"] += 1
                tracked[1 + hand] = False
            limb = self._limbs[1 + hand]
            # Placeholder pose for a hand that was never seen; it is marked as lost.
            wrists.append(frame.head if limb.pose is None else limb.pose)
        self._pinch = pinch
        return dataclasses.replace(
            frame,
            left_wrist=wrists[0].copy(),
            right_wrist=wrists[1].copy(),
            pinch=pinch.copy(),
            tracked=tracked,
        )

    def _judge_hand(self, frame: OperatorFrame, hand: int, name: str) -> str | None:
        if not frame.tracked[1 + hand]:
            return "lost"
        pose, pinch = frame.pose(name), float(frame.pinch[hand])
        if np.linalg.norm(pose[:3] - frame.head[:3]) > self.config.reach:
            return "out_of_reach"
        if not (math.isfinite(pinch) and 0 <= pinch <= MAX_PINCH):
            return "bad_pinch"
        return self._limbs[1 + hand].judge(frame.time, pose, self.config.frozen)
