"""The person's own body in its room: standing place, posture, hands, and human motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from xop_lerobot.core.transforms import (
    compute_minimum_jerk,
    interpolate_poses,
    make_pose,
    pose_inverse,
    pose_multiply,
    quat_exp,
    quat_from_rpy,
    quat_from_yaw,
    quat_multiply,
    quat_rotate,
)
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.noise import HumanNoise
from xop_lerobot.tasks.person.person import Person

SIDES: tuple[str, str] = ("left", "right")
WRIST_TO_PALM = 0.1
"""Distance from the wrist to the middle of the palm [m]."""
OPEN, SHUT = 0.08, 0.008
"""Distance between thumb and index tip of an open hand, and in a pinch [m]."""
PINCHES = ((0.0, 0.25), (0.45, 0.70))
"""Start and end of each pinch in a double pinch [s]."""
PINCH_RAMP = 0.09
"""Time for thumb and index to close, and to open [s]."""
DOUBLE_PINCH_S = 0.75
"""Duration of a double pinch [s]."""
HALT_S = 0.7
"""Time in which an interrupted walk or turn comes to rest [s]."""
RELAXED = (0.30, 0.22, -0.50)
"""Left wrist held in front, relative to the head: forward, left, up, for eyes at 1.6 m [m]."""
STEP_HZ = 1.6
"""Step frequency of slow walking [Hz]."""
BOB = (0.010, 0.012)
"""Amplitude of the head's vertical and lateral motion at 0.6 m/s [m]."""
NECK = 0.45
"""Forward motion of the eyes per nod; trunk and neck share the nod equally [m/rad]."""
TRUNK = 0.50
"""Radius of the arc on which bending the trunk lowers the eyes, for eyes at 1.6 m [m]."""
HIPS_BACK = 0.20
"""Backward motion of the hips under a bending trunk, which keeps the balance [m/rad]."""


@dataclass(frozen=True)
class Posture:
    """Posture of the body, in the person's room.

    Attributes:
        place: Standing place and heading, x y yaw [m, m, rad]. Shape (3,).
        drop: Lowering of the eyes by the knees [m].
        lean: Offset of the head ahead and to the left of the standing place [m]. Shape (2,).
        look: Yaw to the left and pitch down of the head, relative to the body [rad]. Shape (2,).
        hands: Left and right wrist, relative to the head position with the body's heading. Shape
            (2, 7).
        bend: Forward bend of the trunk at the hips, also contained in `look` [rad].
    """

    place: np.ndarray
    drop: float
    lean: np.ndarray
    look: np.ndarray
    hands: np.ndarray
    bend: float = 0.0

    def compute_frame(self, eye_height: float) -> np.ndarray:
        """Position of the head with the body's heading, without turn and nod. Shape (7,)."""
        turn = quat_from_yaw(self.place[2])
        ahead = self.lean[0] + NECK * np.sin(self.look[1]) - HIPS_BACK * np.sin(self.bend)
        lean = np.array([ahead, self.lean[1], 0])
        sunk = self.drop + compute_sinking(self.bend, eye_height)
        position = np.array([*self.place[:2], eye_height - sunk])
        return make_pose(position + quat_rotate(turn, lean), turn)


def compute_sinking(bend: float, eye_height: float) -> float:
    """Compute how far bending the trunk by `bend` [rad] lowers the eyes [m]."""
    return TRUNK * eye_height / Person.eye_height * (1 - float(np.cos(bend)))


def relaxed_hands(scale: float = 1.0) -> np.ndarray:
    """Return both hands held in front, palms inwards, fingers forward. Shape (2, 7)."""
    return np.array(
        [
            make_pose(
                scale * np.array(RELAXED) * [1, side, 1], quat_from_rpy(-side * np.pi / 2, 0, 0)
            )
            for side in (1, -1)
        ]
    )


def stand_upright(posture: Posture, hands: np.ndarray | None = None) -> Posture:
    """Return the posture without squat, lean, bend and nod, optionally with other hands."""
    hands = posture.hands if hands is None else hands
    return Posture(posture.place, 0.0, np.zeros(2), np.zeros(2), hands)


class Body:
    """Moves from posture to posture as people do.

    Reaches and bends are minimum-jerk, with all parts starting and ending together. Walking has
    smooth starts and stops and constant speed in between; the head bobs with the steps. Sway and
    tremor are always present. Hands move with the body unless told to stay in the room.

    Args:
        person: Height and speeds.
        noise: Sway and tremor.
    """

    def __init__(self, person: Person, noise: HumanNoise) -> None:
        self._person, self._noise = person, noise
        self.posture = Posture(
            np.zeros(3), 0.0, np.zeros(2), np.zeros(2), relaxed_hands(person.size)
        )
        self._start = self._end = self.posture
        self._began, self._duration, self._ramp = 0.0, 0.0, 0.0
        self._braking = False
        self._pinched_at: dict[str, float] = {}
        self._walked = self._speed = 0.0
        self.time = 0.0

    @property
    def is_moving(self) -> bool:
        """Whether a movement is under way."""
        return self.time < self._began + self._duration

    @property
    def is_pinching(self) -> bool:
        """Whether a double pinch is under way."""
        return any(self.time < at + DOUBLE_PINCH_S for at in self._pinched_at.values())

    def hold(self, hands: np.ndarray) -> None:
        """Set the wrists without a movement, before the session starts. Shape (2, 7)."""
        self.posture = self._start = self._end = replace(self.posture, hands=hands)

    def move(self, end: Posture, duration: float) -> None:
        """Start a minimum-jerk movement to `end` that takes `duration` [s]."""
        self._begin(end, duration, 0.0)

    def walk(self, end: Posture, pace: float = 1.0) -> None:
        """Start walking straight to `end`, at constant speed except for start and stop.

        Headings are not wrapped, so a turn may exceed half a circle.

        Args:
            end: Posture at the destination.
            pace: Factor on the speed [1].
        """
        distance = float(np.linalg.norm(end.place[:2] - self.posture.place[:2]))
        turn = abs(float(end.place[2] - self.posture.place[2]))
        person = self._person
        # Each ramp covers half the distance of constant speed, so the two cost one ramp more.
        even = max(distance / person.walk_speed, turn / person.turn_speed)
        start = person.walk_start / pace
        self._begin(end, even / pace + start, start)

    def halt(self) -> None:
        """Interrupt a walk or turn and come to rest within `HALT_S`."""
        if not self.is_moving:
            return
        later = self._compute_posture(self.time + 0.01)
        rate = (later.place - self.posture.place) / 0.01
        end = replace(self.posture, place=self.posture.place + 0.5 * HALT_S * rate)
        self._begin(end, HALT_S, 0.0)
        self._braking = True

    def double_pinch(self, *sides: str) -> None:
        """Start a double pinch with thumb and index of the named hands."""
        for side in sides:
            self._pinched_at[side] = self.time

    def advance(self, time: float) -> None:
        """Advance to `time` [s] of the person's clock."""
        dt, self.time = time - self.time, time
        last = self.posture.place[:2]
        self.posture = self._compute_posture(time)
        if dt > 0:
            step = float(np.linalg.norm(self.posture.place[:2] - last))
            self._walked += step
            share = 1 - np.exp(-dt / 0.2)
            self._speed += share * (step / dt - self._speed)

    def compute_hands_in_room(self, posture: Posture | None = None) -> np.ndarray:
        """Compute the wrists in the room, without sway. Shape (2, 7)."""
        posture = posture or self.posture
        return pose_multiply(posture.compute_frame(self._person.eye_height), posture.hands)

    def with_hands_in_room(self, posture: Posture, hands: Mapping[str, np.ndarray]) -> Posture:
        """Return the posture with the given hands at these poses of the room. Shapes (7,)."""
        frame = pose_inverse(posture.compute_frame(self._person.eye_height))
        wrists = posture.hands.copy()
        for side, pose in hands.items():
            wrists[SIDES.index(side)] = pose_multiply(frame, pose)
        return replace(posture, hands=wrists)

    def compute_head(self) -> np.ndarray:
        """Compute the head pose in the room, without sway. Shape (7,)."""
        frame = self.posture.compute_frame(self._person.eye_height)
        nod = quat_from_rpy(0, float(self.posture.look[1]), float(self.posture.look[0]))
        return make_pose(frame[:3], quat_multiply(frame[3:], nod))

    def make_frame(self, time: float) -> OperatorFrame:
        """Return what a headset would stream now, stamped `time` [s]."""
        frame = self.posture.compute_frame(self._person.eye_height)
        head, hands = self.compute_head(), pose_multiply(frame, self.posture.hands)
        sway, turn = self._noise.at(self.time), frame[3:]
        bob = self._compute_bob()

        def disturb(pose: np.ndarray, offset: np.ndarray, rotation: np.ndarray) -> np.ndarray:
            quat = quat_multiply(pose[3:], quat_exp(rotation))
            return make_pose(pose[:3] + quat_rotate(turn, offset + bob), quat)

        wrists = [disturb(hands[i], sway.wrists[i], sway.wrist_turns[i]) for i in range(2)]
        return OperatorFrame(
            time=time,
            head=disturb(head, sway.head, sway.head_turn),
            left_wrist=wrists[0],
            right_wrist=wrists[1],
            pinch=np.array([self._compute_pinch(side) for side in SIDES]),
        )

    def _begin(self, end: Posture, duration: float, ramp: float) -> None:
        self._start, self._end = self.posture, end
        self._began, self._duration, self._ramp = self.time, max(duration, 0.05), ramp
        self._braking = False

    def _compute_posture(self, time: float) -> Posture:
        if not self._duration:
            return self.posture
        u = (time - self._began) / self._duration
        if u >= 1:
            return self._end
        if self._braking:
            share = 2 * u - 2 * u**3 + u**4  # quartic from constant speed to rest
        elif self._ramp:
            share = _compute_ramped(u, self._ramp / self._duration)
        else:
            share = compute_minimum_jerk(u)
        u = compute_minimum_jerk(u)
        start, end = self._start, self._end
        place = start.place + share * (end.place - start.place)
        return Posture(
            place=place,
            drop=start.drop + u * (end.drop - start.drop),
            lean=start.lean + u * (end.lean - start.lean),
            look=start.look + u * (end.look - start.look),
            hands=interpolate_poses(start.hands, end.hands, u),
            bend=start.bend + u * (end.bend - start.bend),
        )

    def _compute_bob(self) -> np.ndarray:
        """Vertical and lateral motion of the head while walking, world axes [m]. Shape (3,)."""
        size = min(self._speed / 0.6, 1.0) * self._noise.scale
        phase = 2 * np.pi * STEP_HZ * self.time
        return size * np.array([0, BOB[1] * np.sin(phase / 2), BOB[0] * np.sin(phase)])

    def _compute_pinch(self, side: str) -> float:
        since = self.time - self._pinched_at.get(side, -np.inf)
        for start, end in PINCHES:
            if start - PINCH_RAMP <= since - PINCH_RAMP <= end:
                shut = compute_minimum_jerk((since - start) / PINCH_RAMP)
                opened = compute_minimum_jerk((since - end + PINCH_RAMP) / PINCH_RAMP)
                return OPEN + (SHUT - OPEN) * (shut - opened)
        return OPEN


def _compute_ramped(u: float, ramp: float) -> float:
    """Share of the distance covered at share u of the time.

    The speed rises as a smoothstep over the first `ramp` of the time, is constant, and falls as a
    smoothstep over the last `ramp`.
    """
    ramp = min(ramp, 0.5)

    def rise(x: float) -> float:  # integral of the smoothstep 3x² − 2x³
        return x**3 - 0.5 * x**4

    if u < ramp:
        covered = ramp * rise(u / ramp)
    elif u <= 1 - ramp:
        covered = 0.5 * ramp + (u - ramp)
    else:
        covered = (1 - ramp) - ramp * rise((1 - u) / ramp)
    return covered / (1 - ramp)
