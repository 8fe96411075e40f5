"""Plausibility checks of a live stream: each limb is checked, and each rejection counted."""

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
"""However close behind each other two frames come, so much lies between what they show [s]."""
MAX_STEP_TIME = 0.04
"""However long nothing was believed, a limb has moved for no longer than that [s]."""
MAX_BODY_TIME = 0.1
"""The same of a whole body, which people turn on purpose and with a network that stalls [s]."""
RENEWALS = 5
"""From so many changes of a pose it is told how often it changes."""
RENEWAL_S = 0.5
"""A pose that has not changed for so long stands [s]."""
ARM = 0.2
"""A turn counts like the way of a point so far from the wrist [m]."""
NORM_TOLERANCE = 1e-2
"""How far a quaternion's norm may be from 1."""
SPACE = 100.0
"""Farther from the origin of its space nobody is [m]."""
MAX_PINCH = 0.4
"""Thumb and index are never farther apart [m]."""
OPEN_PINCH = 0.08
"""Distance of thumb and index of a hand of which none was seen yet [m]."""


@dataclass
class GuardConfig:
    """Limits of the plausibility checks.

    Attributes:
        stale: Without a new believable frame for so long, the head counts as lost [s].
        frozen: A hand whose pose does not change by a bit for so long, while others do, is
            lost: devices go on sending the last one [s].
        settle: A limb that has jumped is believed again when it went on smoothly from there
            for so long; the head only after `stale` more, so that an engagement ends first [s].
        head_speed: The head is never faster [m/s].
        hand_speed: A hand is never faster [m/s].
        head_turn: The head never turns faster [rad/s].
        hand_turn: A hand never turns faster [rad/s].
        body_turn: Head and hands never turn faster together, as the whole person does [rad/s].
        slack: A jump up to this long is noise [m].
        head_slack: A jump of the head up to this angle is noise [rad].
        turn_slack: A jump of a hand up to this angle is noise [rad].
        reach: A hand is never farther from the head [m].
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
    """Reason why `pose` is impossible, None if it is possible. Shape (7,)."""
    if not np.isfinite(pose).all():
        return "not_finite"
    if abs(float(np.linalg.norm(pose[3:])) - 1) > NORM_TOLERANCE:
        return "no_rotation"
    return "out_of_space" if float(np.abs(pose[:3]).max()) > SPACE else None


class LimbGuard:
    r"""Checks the successive poses of one limb.

    A pose is a jump if it is farther from the last believed one than
    :math:`v_{max} dt + slack`, dt from 1/90 to 0.04 s, or turned by more than the like. Poses that
    go on smoothly from a jump are believed again after `settle`, and not before: that time passes
    does not make a motion of a jump.

    Args:
        speed: Largest speed [m/s].
        turn: Largest rate of turn [rad/s].
        settle: How long a new place must last [s].
        slack: A jump up to this long is noise [m].
        turn_slack: A jump up to this angle is noise [rad].
    """

    def __init__(
        self, speed: float, turn: float, settle: float, slack: float, turn_slack: float
    ) -> None:
        self._speed, self._turn, self._settle = speed, turn, settle
        self._slack, self._turn_slack = slack, turn_slack
        self.pose: np.ndarray | None = None
        """The last pose that was believed. Shape (7,)."""
        self._time = 0.0
        self._raw = np.full(7, np.nan)
        self._changed_at = 0.0
        self._changes: deque[float] = deque(maxlen=RENEWALS)
        self._candidate: tuple[float, np.ndarray] | None = None
        self._candidate_since = 0.0
        self.relocations = 0
        """How often a jump has turned out to be where the limb is now."""

    def judge(
        self, time: float, pose: np.ndarray, frozen: float, jumped: bool = False
    ) -> str | None:
        """Check the pose of `time` [s]; return the reason of a rejection, None if it is accepted.

        Args:
            time: Stamp of the frame [s].
            pose: x y z qw qx qy qz. Shape (7,).
            frozen: Time without any change after which the limb is lost [s].
            jumped: Whether it is known from elsewhere that the limb has jumped.
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
        # It could have come here by now, but is still where it has jumped to.
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
    """Distance [m] and angle [rad] between two poses. Shapes (7,)."""
    turn = rotation_error(pose[3:], last[3:])
    return float(np.linalg.norm(pose[:3] - last[:3])), float(np.linalg.norm(turn))


def goes_along(before: np.ndarray, after: np.ndarray, last: np.ndarray, pose: np.ndarray) -> bool:
    """Whether a hand has moved with the head, as on one rigid body, rather than stayed.

    Args:
        before: Pose of the head. Shape (7,).
        after: The same later. Shape (7,).
        last: Pose of the hand, with `before`. Shape (7,).
        pose: Pose of the hand, with `after`. Shape (7,).
    """
    turn = quat_multiply(after[3:], quat_conjugate(before[3:]))
    there, back = make_pose(after[:3], turn), make_pose(before[:3], np.array([1.0, 0, 0, 0]))
    carried = pose_multiply(there, pose_multiply(pose_inverse(back), last))
    (moved, turned), (stayed, unturned) = compute_step(carried, pose), compute_step(last, pose)
    return moved + ARM * turned < (stayed + ARM * unturned) / 2


class StreamGuard:
    """Turns a device's messages into plausible frames.

    A frame whose head cannot be believed is dropped; when that goes on, the stream is stale. A
    hand that cannot be believed is marked as lost, and its pose and pinch stay as they were
    last, so that no bad number gets through. All of it follows the stamps alone.

    When a headset recentres, its whole space turns and shifts, and nobody has moved. That is told
    from hands that go along with the head: so quickly nobody turns round as a whole.

    Args:
        config: What counts as a fault.
    """

    def __init__(self, config: GuardConfig | None = None) -> None:
        self.config = config or GuardConfig()
        self.counts: Counter[str] = Counter()
        """How many frames or limbs were refused, by reason; and `taken`, `repeated`."""
        self.reset()

    def reset(self) -> None:
        """Forget what was seen, as after a new connection; the counts stay."""
        c = self.config
        # A head that has jumped must be stale for the readers before it is believed again.
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
        """How often the poses of left and right hand change [Hz]; None where that is not known."""
        left, right = (limb.compute_rate(time) for limb in self._limbs[1:])
        return left, right

    def take(self, frame: OperatorFrame, source_time: float | None = None) -> OperatorFrame | None:
        """Judge a frame.

        Args:
            frame: As the device sent it, stamped with the time of its receipt.
            source_time: The device's own stamp or number, where it has one: only newer frames
                are taken.

        Returns:
            The frame as far as it can be believed, or None if it is dropped.
        """
        reason = self._find_old(frame, source_time)
        if reason is None:
            self._time = frame.time
            if source_time is not None:
                self._source_time = source_time
            raw = np.concatenate([*(frame.pose(name) for name in FRAMES), frame.pinch])
            # Devices that outrun their tracking send frames twice, and go on when it has died.
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
        """Whether head and hands have turned together by more than a person can."""
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
            # A hand that was never seen is nowhere; it is marked as lost.
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
