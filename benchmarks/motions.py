"""What operators do in their first hour: motions of a person of 1.65 m, as functions of time.

Positions are in metres, angles in radians, times in seconds. The world of a motion has its origin
on the floor below the person at the start, X ahead and Y to the left.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.transforms import (
    compute_minimum_jerk,
    make_pose,
    quat_from_rpy,
    quat_from_yaw,
    quat_multiply,
    quat_rotate,
)
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.script import OPEN_PINCH

EYE_HEIGHT = 1.53
"""Height of the eyes of a person of 1.65 m [m]."""
START_S = 1.0
"""When a motion begins: until then the person stands at rest [s]."""
HAND_AT_REST = (0.30, 0.20, -0.50, 0.0, 0.0, 0.0)
"""Left wrist at rest, from the head: position [m], then roll, pitch and yaw [rad]."""

type Vector = tuple[float, ...] | np.ndarray


def mirror(hand: Vector) -> np.ndarray:
    """The right wrist that mirrors a left one, and the reverse. Shape (6,)."""
    return np.asarray(hand) * [1, -1, 1, -1, 1, -1]


@dataclass(frozen=True)
class Posture:
    """A person at one instant.

    Attributes:
        place: Where the person stands, x and y in the world [m].
        heading: Heading of the body [rad].
        head: Displacement of the head from where it is upright, along the heading [m].
        gaze: Roll, pitch (down is positive) and yaw of the head from the heading [rad].
        left: Left wrist from the head, along the heading [m], then its roll, pitch, yaw [rad].
        right: The right one; None mirrors the left one.
        seen: Whether head, left and right wrist are tracked.
        mode: Mode that the person has chosen; None is the motion's.
    """

    place: Vector = (0.0, 0.0)
    heading: float = 0.0
    head: Vector = (0.0, 0.0, 0.0)
    gaze: Vector = (0.0, 0.0, 0.0)
    left: Vector = HAND_AT_REST
    right: Vector | None = None
    seen: tuple[bool, bool, bool] = (True, True, True)
    mode: Mode | None = None

    def make_frame(self, time: float, mode: Mode) -> OperatorFrame:
        """What a headset without noise streams of it."""
        turn = quat_from_yaw(self.heading)
        upright = np.array([*self.place, EYE_HEIGHT])
        head = upright + quat_rotate(turn, np.asarray(self.head, float))
        wrists = []
        for hand in (self.left, mirror(self.left) if self.right is None else self.right):
            at = head + quat_rotate(turn, np.asarray(hand[:3], float))
            wrists.append(make_pose(at, quat_multiply(turn, quat_from_rpy(*hand[3:]))))
        return OperatorFrame(
            time,
            make_pose(head, quat_multiply(turn, quat_from_rpy(*self.gaze))),
            *wrists,
            pinch=np.full(2, OPEN_PINCH),
            tracked=np.array(self.seen),
            mode=self.mode or mode,
        )


@dataclass(frozen=True)
class Motion:
    """One motion.

    Attributes:
        title: What the person does, for tables.
        mode: Mode in which it starts.
        seconds: When it ends, from its beginning [s]; the last posture is held then.
        move: Posture at a time from its beginning [s].
        beyond: Robots that cannot follow all of it; ``"all"`` for every robot.
        ends_within: Whether they can follow its end all the same.
    """

    title: str
    mode: Mode
    seconds: float
    move: Callable[[float], Posture]
    beyond: frozenset[str] = frozenset()
    ends_within: bool = True

    @property
    def end(self) -> float:
        """When it ends, on the device's clock [s]."""
        return START_S + self.seconds

    def is_reachable(self, robot: str) -> bool:
        """Whether `robot` can follow all of it."""
        return not self.beyond & {robot, "all"}

    def frame_at(self, time: float) -> OperatorFrame:
        """Frame at `time` of the device's clock [s]."""
        posture = self.move(float(np.clip(time - START_S, 0.0, self.seconds)))
        return posture.make_frame(time, self.mode)


MOTIONS: dict[str, Motion] = {}
"""Motions by name."""


def _add(
    mode: str, seconds: float, title: str, beyond: str = "", *, ends: bool = True
) -> Callable[[Callable[[float], Posture]], Callable[[float], Posture]]:
    """Register a function of time as a motion of its name."""

    def register(move: Callable[[float], Posture]) -> Callable[[float], Posture]:
        name = move.__name__.lstrip("_")
        robots = frozenset(beyond.split())
        MOTIONS[name] = Motion(title, Mode[mode.upper()], seconds, move, robots, ends)
        return move

    return register


def _go(t: float, start: float, seconds: float) -> float:
    """Share of a minimum-jerk movement that is done, 0 to 1."""
    return float(compute_minimum_jerk((t - start) / seconds))


def _visit(t: float, start: float, seconds: float, hold: float) -> float:
    """Share of a movement there and, after `hold`, back: 0, 1, 0."""
    return _go(t, start, seconds) - _go(t, start + seconds + hold, seconds)


def _cycles(t: float, hertz: float, end: float) -> float:
    """Sine that fades in and out over half a second each."""
    return math.sin(2 * math.pi * hertz * t) * (_go(t, 0, 0.5) - _go(t, end - 0.5, 0.5))


def _hand(
    x: float, y: float, z: float, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0
) -> np.ndarray:
    return np.array([x, y, z, roll, pitch, yaw])


def _between(share: float, hand: Vector, start: Vector = HAND_AT_REST) -> np.ndarray:
    return np.asarray(start) + share * (np.asarray(hand) - np.asarray(start))


def _travel(t: float, seconds: float, distance: float, rise: float = 0.8) -> float:
    """Distance walked at constant speed, with `rise` seconds to start and to stop [m]."""
    u = float(np.clip(t, 0, seconds))
    up = min(u, rise) ** 2 / (2 * rise) + max(0.0, min(u, seconds - rise) - rise)
    down = max(0.0, u - (seconds - rise))
    return distance / (seconds - rise) * (up + down - down**2 / (2 * rise))


# -- stationary: head and trunk --------------------------------------------------------------------


@_add("stationary", 8, "stands at rest")
def _stand(t: float) -> Posture:
    return Posture()


@_add("stationary", 7, "looks to both sides by 60°, slowly")
def _look_aside(t: float) -> Posture:
    return Posture(gaze=(0, 0, 1.05 * (_visit(t, 0, 1.5, 0.5) - _visit(t, 3.5, 1.5, 0.5))))


@_add("stationary", 5, "glances aside by 60° within 0.4 s, and back")
def _head_turn_fast(t: float) -> Posture:
    return Posture(gaze=(0, 0, 1.05 * (_visit(t, 0, 0.4, 0.6) - _visit(t, 2, 0.4, 0.6))))


@_add("stationary", 5, "nods by 30°, slowly", "g1")
def _nod(t: float) -> Posture:
    return Posture(gaze=(0, 0.52 * (_visit(t, 0, 1, 0.5) - 0.5 * _visit(t, 2.5, 1, 0.5)), 0))


@_add("stationary", 4, "nods by 35° within 0.25 s, three times", "g1")
def _nod_fast(t: float) -> Posture:
    down = sum(_visit(t, start, 0.25, 0.1) for start in (0.0, 1.0, 2.0))
    return Posture(gaze=(0, 0.6 * down, 0))


@_add("stationary", 7, "looks straight down at the feet for 3 s", "all")
def _look_down(t: float) -> Posture:
    share = _visit(t, 0, 1.0, 3.0)
    return Posture(head=(0.08 * share, 0, -0.06 * share), gaze=(0, 1.5 * share, 0))


@_add("stationary", 5, "looks up by 35°")
def _look_up(t: float) -> Posture:
    return Posture(gaze=(0, -0.6 * _visit(t, 0, 1.0, 2.0), 0))


@_add("stationary", 6, "tilts the head to both sides by 20°")
def _tilt(t: float) -> Posture:
    return Posture(gaze=(0.35 * (_visit(t, 0, 1, 0.5) - _visit(t, 3, 1, 0.5)), 0, 0))


@_add("stationary", 6, "turns the body by 45°, and back")
def _turn_45_in_place(t: float) -> Posture:
    return Posture(heading=0.79 * _visit(t, 0, 1.5, 1.5))


@_add("stationary", 4, "turns by 120° and stays so", "all", ends=False)
def _stationary_turn_120(t: float) -> Posture:
    return Posture(heading=2.1 * _go(t, 0, 2.5))


@_add("stationary", 9, "squats by 0.2 m, slowly")
def _squat(t: float) -> Posture:
    return Posture(head=(0, 0, -0.2 * _visit(t, 0, 2.5, 2.0)))


@_add("stationary", 5, "squats by 0.25 m within 0.6 s, and up as fast")
def _squat_fast(t: float) -> Posture:
    return Posture(head=(0, 0, -0.25 * _visit(t, 0, 0.6, 2.0)))


@_add("stationary", 9, "squats until the hands are at the floor", "all")
def _squat_floor(t: float) -> Posture:
    share = _visit(t, 0, 2.0, 2.5)
    return Posture(head=(0.1 * share, 0, -0.85 * share), gaze=(0, 0.4 * share, 0))


@_add("stationary", 9, "sits down on a chair, and gets up", "all")
def _sit(t: float) -> Posture:
    share = _visit(t, 0, 1.5, 4.0)
    return Posture(head=(-0.15 * share, 0, -0.45 * share))


@_add("stationary", 7, "leans forward by 0.15 m")
def _lean_forward(t: float) -> Posture:
    share = _visit(t, 0, 1.2, 2.0)
    return Posture(head=(0.15 * share, 0, -0.02 * share), gaze=(0, 0.26 * share, 0))


@_add("stationary", 6, "leans back by 0.08 m")
def _lean_back(t: float) -> Posture:
    share = _visit(t, 0, 1.2, 1.5)
    return Posture(head=(-0.08 * share, 0, 0), gaze=(0, -0.1 * share, 0))


@_add("stationary", 8, "leans to both sides by 0.12 m")
def _lean_side(t: float) -> Posture:
    share = _visit(t, 0, 1.2, 1.0) - _visit(t, 4, 1.2, 1.0)
    return Posture(head=(0, 0.12 * share, -0.01 * abs(share)), gaze=(-0.2 * share, 0, 0))


@_add("stationary", 8, "bows by 45°", "g1")
def _bow_45(t: float) -> Posture:
    share = _visit(t, 0, 1.5, 3.0)
    return Posture(head=(0.35 * share, 0, -0.25 * share), gaze=(0, 0.79 * share, 0))


@_add("stationary", 8, "bows until the trunk is level", "all")
def _bow_90(t: float) -> Posture:
    share = _visit(t, 0, 2.0, 2.0)
    return Posture(head=(0.55 * share, 0, -0.65 * share), gaze=(0, 1.4 * share, 0))


@_add("stationary", 5, "stands on tiptoe", "all")
def _tiptoe(t: float) -> Posture:
    return Posture(head=(0, 0, 0.08 * _visit(t, 0, 0.6, 2.0)))


@_add("stationary", 7, "shifts the weight from foot to foot")
def _fidget(t: float) -> Posture:
    side = _cycles(t, 0.5, 7.0)
    return Posture(head=(0, 0.05 * side, -0.01 * abs(side)), gaze=(0, 0, 0.2 * side))


# -- stationary: hands -----------------------------------------------------------------------------

AHEAD = _hand(0.52, 0.20, -0.30)
OVERHEAD = _hand(0.15, 0.20, 0.40, 0, -1.4, 0)
WIDE = _hand(0.05, 0.75, -0.28, 0, 0, 1.4)
SIDE = _hand(0.25, 0.65, -0.35, 0, 0, 1.0)
DOWN = _hand(0.10, 0.25, -0.80, 0, 1.2, 0)


@_add("stationary", 7, "reaches ahead at chest height")
def _reach_ahead(t: float) -> Posture:
    return Posture(left=_between(_visit(t, 0, 1.2, 2.5), AHEAD))


@_add("stationary", 8, "reaches overhead with both hands")
def _reach_overhead(t: float) -> Posture:
    return Posture(left=_between(_visit(t, 0, 1.5, 3.0), OVERHEAD))


@_add("stationary", 7, "lets both arms hang")
def _arms_hang(t: float) -> Posture:
    return Posture(left=_between(_visit(t, 0, 1.2, 2.5), DOWN))


@_add("stationary", 10, "squats and reaches for the floor", "all")
def _reach_floor(t: float) -> Posture:
    share = _visit(t, 0, 2.0, 3.0)
    return Posture(
        head=(0.25 * share, 0, -0.6 * share),
        gaze=(0, 0.6 * share, 0),
        left=_between(share, _hand(0.35, 0.15, -0.75, 0, 0.6, 0)),
    )


@_add("stationary", 8, "stretches both arms out to the sides")
def _arms_wide(t: float) -> Posture:
    return Posture(left=_between(_visit(t, 0, 1.2, 3.0), WIDE))


@_add("stationary", 8, "reaches far to the left with both hands")
def _reach_far_side(t: float) -> Posture:
    share = _visit(t, 0, 1.5, 2.5)
    right = _hand(0.35, 0.30, -0.40, 0, 0, 1.0)
    return Posture(
        gaze=(0, 0, 0.5 * share),
        left=_between(share, SIDE),
        right=_between(share, right, mirror(HAND_AT_REST)),
    )


@_add("stationary", 8, "crosses the arms before the chest")
def _arms_crossed(t: float) -> Posture:
    share = _visit(t, 0, 1.5, 2.5)
    return Posture(
        left=_between(share, _hand(0.30, -0.15, -0.40, -0.5, 0, -0.8)),
        right=_between(share, _hand(0.22, 0.15, -0.48, 0.5, 0, 0.8), mirror(HAND_AT_REST)),
    )


@_add("stationary", 8, "puts both hands behind the back")
def _behind_back(t: float) -> Posture:
    share = _visit(t, 0, 1.5, 2.5)
    return Posture(left=_between(share, _hand(-0.20, 0.15, -0.65, -0.5, 0, 2.0)))


@_add("stationary", 7, "turns both palms up")
def _palms_up(t: float) -> Posture:
    return Posture(left=_between(_visit(t, 0, 1.2, 2.5), _hand(0.30, 0.20, -0.50, -math.pi)))


@_add("stationary", 7, "brings both hands together")
def _hands_together(t: float) -> Posture:
    share = _visit(t, 0, 1.0, 3.0)
    return Posture(left=_between(share, _hand(0.36, 0.04, -0.42, -1.2, 0, -0.3)))


@_add("stationary", 7, "stirs with both hands, 12 cm, once a second")
def _stir(t: float) -> Posture:
    fade = _go(t, 0, 1.0) - _go(t, 6.0, 1.0)
    angle = 2 * math.pi * t
    circle = 0.12 * fade * np.array([math.cos(angle), math.sin(angle), 0, 0, 0, 0])
    return Posture(left=_between(fade, _hand(0.36, 0.2, -0.45)) + circle)


@_add("stationary", 6, "waves the right hand fast")
def _wave_fast(t: float) -> Posture:
    fade = _go(t, 0, 1.0) - _go(t, 5.0, 1.0)
    right = _between(fade, _hand(0.28, -0.35, 0.0, 0, -1.2, 0), mirror(HAND_AT_REST))
    return Posture(right=right + np.array([0, 0.14 * _cycles(t, 2.0, 5.0), 0, 0, 0, 0]))


@_add("stationary", 6, "punches with both hands in turn")
def _punch(t: float) -> Posture:
    hits = [_visit(t, start, 0.2, 0.1) for start in (0.5, 1.5, 2.5, 3.5)]
    chest = _hand(0.25, 0.15, -0.30)
    reach = _hand(0.55, 0.10, -0.22)
    ready = _go(t, 0, 0.5) - _go(t, 5.0, 0.8)
    left = _between(hits[0] + hits[2], reach, _between(ready, chest))
    right = _between(hits[1] + hits[3], reach, _between(ready, chest))
    return Posture(left=left, right=mirror(right))


@_add("stationary", 7, "one hand high, the other low")
def _high_and_low(t: float) -> Posture:
    share = _visit(t, 0, 1.5, 2.5)
    return Posture(
        left=_between(share, _hand(0.30, 0.25, 0.20, 0, -1.0, 0)),
        right=_between(share, mirror(DOWN), mirror(HAND_AT_REST)),
    )


@_add("stationary", 8, "turns by 40° and reaches there")
def _reach_turned(t: float) -> Posture:
    share = _visit(t, 0, 1.5, 2.5)
    return Posture(heading=0.7 * share, left=_between(share, _hand(0.45, 0.20, -0.40)))


@_add("stationary", 9, "squats by 0.2 m and reaches ahead")
def _squat_reach(t: float) -> Posture:
    share = _visit(t, 0, 1.5, 3.0)
    return Posture(
        head=(0.05 * share, 0, -0.2 * share), left=_between(share, _hand(0.45, 0.2, -0.45))
    )


@_add("stationary", 7, "a hand is lost for 2 s and seen again elsewhere")
def _hand_lost(t: float) -> Posture:
    share = _go(t, 1.0, 2.0)
    return Posture(
        left=_between(share, _hand(0.40, 0.30, -0.30)), seen=(True, not 0.8 < t < 3.2, True)
    )


@_add("stationary", 8, "the head is lost for 1.5 s while squatting")
def _head_lost(t: float) -> Posture:
    share = _visit(t, 0, 2.0, 1.0)
    return Posture(head=(0, 0, -0.15 * share), seen=(not 1.0 < t < 2.5, True, True))


# -- in the wrong mode -----------------------------------------------------------------------------


@_add("stationary", 7, "walks off ahead, 1.5 m, in stationary mode", "all", ends=False)
def _walk_off_in_stationary(t: float) -> Posture:
    return Posture(place=(_travel(t, 4.0, 1.5), 0))


@_add("stationary", 7, "walks back, 1 m, in stationary mode", "all", ends=False)
def _walk_back_in_stationary(t: float) -> Posture:
    return Posture(place=(-_travel(t, 3.5, 1.0), 0))


@_add("stationary", 7, "walks aside, 1 m, in stationary mode", "all", ends=False)
def _walk_aside_in_stationary(t: float) -> Posture:
    return Posture(place=(0, _travel(t, 3.5, 1.0)))


@_add("stationary", 10, "walks off and comes back in stationary mode", "all")
def _walk_off_and_back(t: float) -> Posture:
    return Posture(place=(_travel(t, 3.5, 1.2) - _travel(t - 5.0, 3.5, 1.2), 0))


@_add("mobile", 7, "stops by changing the mode in mid-step, and goes on", "all", ends=False)
def _stop_by_mode(t: float) -> Posture:
    mode = Mode.STATIONARY if t > 2.5 else Mode.MOBILE
    return Posture(place=(_travel(t, 4.5, 1.8), 0), mode=mode)


@_add("mobile", 7, "lets go in mid-step", "all", ends=False)
def _let_go_in_step(t: float) -> Posture:
    return Posture(place=(_travel(t, 5.0, 2.0), 0), seen=(t < 2.0, True, True))


@_add("mobile", 9, "walks 1 m, changes the mode and squats")
def _walk_then_squat(t: float) -> Posture:
    squat = _visit(t, 4.5, 1.2, 1.5)
    mode = Mode.STATIONARY if t > 4.0 else Mode.MOBILE
    return Posture(place=(_travel(t, 2.8, 1.0), 0), head=(0, 0, -0.15 * squat), mode=mode)


# -- mobile ----------------------------------------------------------------------------------------


@_add("mobile", 8, "stands at rest in mobile mode")
def _stand_mobile(t: float) -> Posture:
    return Posture()


@_add("mobile", 7, "walks 2 m ahead at 0.45 m/s")
def _walk_ahead(t: float) -> Posture:
    return Posture(place=(_travel(t, 5.2, 2.0), 0))


@_add("mobile", 5, "walks 3 m ahead at 1.1 m/s")
def _walk_brisk(t: float) -> Posture:
    return Posture(place=(_travel(t, 3.5, 3.0), 0))


@_add("mobile", 6, "walks back by 1.5 m")
def _walk_back(t: float) -> Posture:
    return Posture(place=(-_travel(t, 4.5, 1.5), 0))


@_add("mobile", 8, "steps aside by 1 m", "rby1")
def _sidestep(t: float) -> Posture:
    return Posture(place=(0, _travel(t, 3.5, 1.0)))


@_add("mobile", 8, "walks 1.5 m ahead and 1 m aside without turning", "rby1")
def _diagonal(t: float) -> Posture:
    share = _travel(t, 5.0, 1.0)
    return Posture(place=(1.5 * share, share))


@_add("mobile", 13, "walks round a circle of 0.8 m radius")
def _circle(t: float) -> Posture:
    angle = _travel(t, 12.0, 2 * math.pi)
    return Posture(place=(0.8 * math.sin(angle), 0.8 * (1 - math.cos(angle))), heading=angle)


@_add("mobile", 14, "walks a slalom of 3 m")
def _slalom(t: float) -> Posture:
    x = _travel(t, 9.0, 3.0)
    slope = 0.3 * 2 * math.pi / 1.5 * math.sin(2 * math.pi * x / 1.5)
    return Posture(place=(x, 0.3 * (1 - math.cos(2 * math.pi * x / 1.5))), heading=math.atan(slope))


@_add("mobile", 5, "turns by 90° on the spot at 0.9 rad/s")
def _turn_90(t: float) -> Posture:
    return Posture(heading=_travel(t, 2.5, math.pi / 2, 0.6))


@_add("mobile", 7, "turns by 180° on the spot at 0.9 rad/s")
def _turn_180(t: float) -> Posture:
    return Posture(heading=_travel(t, 4.1, math.pi, 0.6))


@_add("mobile", 10, "turns by 360° on the spot at 0.9 rad/s")
def _turn_360(t: float) -> Posture:
    return Posture(heading=_travel(t, 7.6, 2 * math.pi, 0.6))


@_add("mobile", 7, "turns round at 2.5 rad/s, and back", "all")
def _turn_fast(t: float) -> Posture:
    return Posture(heading=math.pi * _visit(t, 0, 2.4, 0.6))


@_add("mobile", 6, "walks 0.6 m and turns by 90° meanwhile")
def _step_while_turning(t: float) -> Posture:
    share = _travel(t, 3.0, 1.0)
    return Posture(place=(0.5 * share, 0.3 * share), heading=math.pi / 2 * share)


@_add("mobile", 9, "walks 1 m, turns round and walks back")
def _walk_and_return(t: float) -> Posture:
    x = _travel(t, 2.6, 1.0) - _travel(t - 6.2, 2.6, 1.0)
    return Posture(place=(x, 0), heading=math.pi * _go(t, 2.8, 3.4))


@_add("mobile", 9, "walks half a metre and stops, three times")
def _stop_and_go(t: float) -> Posture:
    return Posture(place=(sum(_travel(t - start, 2.0, 0.5, 0.6) for start in (0, 3, 6)), 0))


@_add("mobile", 7, "walks 1.5 m looking at the floor", "g1", ends=False)
def _walk_look_down(t: float) -> Posture:
    return Posture(place=(_travel(t, 4.5, 1.5), 0), gaze=(0, 0.7 * _go(t, 0, 1.0), 0))


@_add("mobile", 7, "walks 1.5 m in a crouch", "g1", ends=False)
def _crouch_walk(t: float) -> Posture:
    return Posture(place=(_travel(t, 4.5, 1.5), 0), head=(0, 0, -0.2 * _go(t, 0, 1.5)))


@_add("mobile", 7, "walks 1.5 m looking aside by 50°")
def _walk_look_aside(t: float) -> Posture:
    return Posture(place=(_travel(t, 4.5, 1.5), 0), gaze=(0, 0, 0.87 * _visit(t, 0.5, 1.0, 2.5)))


@_add("mobile", 7, "walks 1.5 m with both arms ahead")
def _walk_reach(t: float) -> Posture:
    return Posture(place=(_travel(t, 4.5, 1.5), 0), left=_between(_go(t, 0, 1.0), AHEAD))


@_add("mobile", 8, "walks 1.5 m and swings the arms")
def _walk_swing(t: float) -> Posture:
    swing = _hand(0.12 * _cycles(t, 0.9, 5.0), 0, 0)
    rest = np.array(HAND_AT_REST)
    return Posture(place=(_travel(t, 4.5, 1.5), 0), left=rest + swing, right=mirror(rest - swing))


@_add("mobile", 9, "steps of 10 cm in all directions", "rby1")
def _small_steps(t: float) -> Posture:
    ways = ((0.1, 0.0), (0.0, 0.1), (-0.1, 0.0), (0.0, -0.1))
    place = sum(_go(t, 2.0 * i, 0.8) * np.array(way) for i, way in enumerate(ways))
    return Posture(place=np.asarray(place))


@_add("mobile", 9, "the head is lost for 1 s while walking", "all")
def _head_lost_walking(t: float) -> Posture:
    return Posture(place=(_travel(t, 5.0, 1.5), 0), seen=(not 2.0 < t < 3.0, True, True))
