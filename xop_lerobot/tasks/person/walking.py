"""Searching, walking, and changing the mode."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.transforms import (
    compute_heading,
    quat_from_yaw,
    quat_rotate,
    quat_to_rpy,
    wrap_angle,
)
from xop_lerobot.tasks.person.body import Posture, relaxed_hands, stand_upright
from xop_lerobot.tasks.person.mind import Doing, GaveUp, Mind

LAG = 0.4
"""How long a person still looks when the own turn is over: the robot may be behind [s]."""
MODE_WAIT = 1.4
"""Longest wait for the display to show the other mode [s]."""
GLANCE = 0.9
"""Turn of the head with which a person looks to a side [rad]."""
LOW = 0.5
"""Share of the robot's height under which things at its feet are not seen by who looks ahead."""
LOOK_DOWN, LOOK_DOWN_S = 0.45, 1.0
"""Nod with which a person looks for them [rad], and its time [s]."""
RISEN = 0.02
"""A head that has come up so far is rising [m]."""
MODE_TRIES = 6
"""How often a person tries a double pinch before giving up."""
MOST_STUCK = 3
"""How often a person tries to go on with a robot that strains."""
LENIENT = (4, 1.5)
"""After so many legs a person has to do with so many times the usual tolerance."""
BRIDGED = 0.2
"""Way that is left to arms and a lean, where a robot does not come any nearer [m]."""
STRAIN = (0.06, 0.2)
"""Difference of height [m] and of tilt [rad] to the own head from which a robot strains."""
LADEN = 0.5
"""Factor on the speed of who carries something."""
FALLS_SHORT, AIM_BEYOND, MOST_BEYOND = 0.12, 0.5, 0.4
"""From which distance on a leg has missed its place [m]; share of it that the next one is aimed
beyond, if two have missed it to the same side, and the most of it [m]: people get used to a robot
that always falls short."""
TURN_FIRST = 0.35
"""Angle up to which a person sets out without turning first [rad]."""


def find(mind: Mind, *names: str) -> Doing:
    """Look ahead, then to both sides; what is not there is behind: turn round until it is seen."""
    while mind.eyes.is_blind:
        yield
    yield from mind.pause(mind.person.decision_s)
    if not _knows(mind, names):
        yield from look_down(mind, names)
    if not _knows(mind, names):
        mind.note("look to both sides")
        yield from glance(mind, *names)
    if _knows(mind, names):
        yield from _look_up(mind)
        return
    mind.note("turn round to look")
    yield from set_mode(mind, Mode.MOBILE)
    round_about = mind.rng.choice([-1, 1]) * np.array([0, 0, 2 * np.pi])
    posture = mind.body.posture
    mind.body.walk(replace(posture, place=posture.place + round_about))
    yield from _search(mind, names)
    if not _knows(mind, names):
        raise GaveUp(f"did not find {', '.join(names)}")
    yield from _look_up(mind)


def look_down(mind: Mind, names: tuple[str, ...]) -> Doing:
    """Look down for what is not known yet, if it is known to be low; and stay so."""
    head = float(mind.eyes.pose("head")[2])
    if mind.eyes.recall("lowest", head) > LOW * head:
        return
    mind.note("look down")
    last = mind.body.posture
    mind.body.move(replace(last, look=np.array([last.look[0], LOOK_DOWN])), LOOK_DOWN_S)
    yield from _search(mind, names)


def _look_up(mind: Mind) -> Doing:
    """Look ahead again, to stand where one seems to; a nod brings the head forward."""
    last = mind.body.posture
    if last.look[1]:
        mind.body.move(replace(last, look=np.array([last.look[0], 0.0])), LOOK_DOWN_S)
        yield from mind.settle("head")


def glance(mind: Mind, *names: str) -> Doing:
    """Look to both sides without a step, for what is not known yet; then ahead again."""
    for angle in (*(mind.rng.choice([-1, 1]) * np.array([GLANCE, -GLANCE])), 0.0):
        if _knows(mind, names) and angle:
            continue
        last = mind.body.posture
        way = abs(float(angle) - float(last.look[0]))
        end = replace(last, look=np.array([float(angle), last.look[1]]))
        mind.body.move(end, 1.875 * way / mind.person.turn_speed)
        yield from _search(mind, names if angle else ())


def set_mode(mind: Mind, mode: Mode) -> Doing:
    """Pinch twice with the left hand, and look at the display whether it took.

    A robot that squats stands up before it walks: who sees it rise waits.
    """
    if mind.eyes.mode is mode:
        return
    for _ in range(MODE_TRIES):
        mind.note(f"double pinch for {mode.name.lower()}")
        yield from mind.finish()
        yield from mind.pause(0.2)
        mind.body.double_pinch("left")
        yield from mind.finish()
        limit, height = mind.time + MODE_WAIT, mind.eyes.pose("head")[2]
        while mind.eyes.mode is not mode and mind.time < limit:
            yield
            if mind.eyes.pose("head")[2] > height + RISEN:
                limit, height = mind.time + MODE_WAIT, mind.eyes.pose("head")[2]
        if mind.eyes.mode is mode:
            return
    raise GaveUp(f"could not change to {mode.name.lower()}")


def go_to(
    mind: Mind,
    place: np.ndarray,
    *,
    tolerance: float | None = None,
    hands: np.ndarray | None = None,
    laden: bool = False,
    tries: int = 8,
) -> Doing:
    """Walk until the robot's head is at a place, x y yaw of the robot's world.

    Each leg is walked as planned, then the person stops and looks; what is left is the next
    leg, aimed beyond the place when legs fall short of it again and again. After `tries` legs it
    has to do.

    Args:
        mind: Who goes.
        place: Where the robot's head shall be, and its heading.
        tolerance: How far beside it is good enough [m].
        hands: Wrists while walking, from the head (2, 7); relaxed in front by default.
        laden: Whether they carry something: then slowly, and bent as it may bend a robot.
        tries: Most legs.
    """
    person = mind.person
    near = person.place_tolerance if tolerance is None else tolerance
    hands = relaxed_hands(person.size) if hands is None else hands
    yield from mind.settle()
    stuck, left, ahead = 0, np.zeros(2), np.zeros(2)
    for leg in range(tries):
        miss, turn = compute_miss(mind, place)
        if leg >= LENIENT[0]:
            near = max(near, LENIENT[1] * person.place_tolerance)
        if miss <= near and abs(turn) <= person.heading_tolerance:
            return
        own, seen, turn_then = mind.body.posture.place, mind.eyes.pose("head"), mind.belief.turn
        mind.note(f"leg {leg}: {100 * miss:.0f} cm, {np.degrees(turn):.0f}° to go")
        last, left = left, place[:2] - mind.eyes.pose("head")[:2]
        if leg > 1 and miss > FALLS_SHORT and left @ last > 0:
            ahead += AIM_BEYOND * left
            ahead *= min(1.0, MOST_BEYOND / max(float(np.linalg.norm(ahead)), 1e-9))
        aim = place + np.array([*ahead, 0.0])
        target = mind.belief.place_to_own(aim)
        target[:2] += mind.scatter(miss, 2)
        target[2] += float(mind.scatter(abs(turn), 1)[0])
        yield from _walk(mind, target, hands, leg % 3 == 2, LADEN if laden else 1.0)
        yield from mind.settle(patience=2.5)
        if is_strained(mind) and not laden:
            yield from _come_back(mind, own, seen, turn_then)
            stuck += 1
            miss, turn = compute_miss(mind, place)
            bridged = miss <= BRIDGED and abs(turn) <= 2 * person.heading_tolerance
            if stuck >= MOST_STUCK or bridged:
                return


def is_strained(mind: Mind) -> bool:
    """Whether the robot bends or stretches after a head that it cannot follow."""
    seen, own = mind.eyes.pose("head"), mind.body.compute_head()
    lift = abs(float(seen[2]) - mind.belief.scale * float(own[2]))
    tilt = np.abs(quat_to_rpy(seen[3:])[:2] - quat_to_rpy(own[3:])[:2])
    return bool(lift > STRAIN[0] or tilt.max() > STRAIN[1])


def _come_back(mind: Mind, own: np.ndarray, seen: np.ndarray, turn: float) -> Doing:
    """Go back to as far as the robot has come along; pushing on would not help it.

    Args:
        mind: Who walked.
        own: Where the person stood before. Shape (3,).
        seen: Where the robot's head was then. Shape (7,).
        turn: How the robot's world was believed to be turned then: a robot that bends now tells
            nothing of it [rad].
    """
    mind.note("the robot does not come along")
    head = mind.eyes.pose("head")
    came = quat_rotate(quat_from_yaw(-turn), head[:3] - seen[:3])
    turned = wrap_angle(compute_heading(head[3:]) - compute_heading(seen[3:]))
    target = own + np.array([came[0], came[1], float(turned)])
    mind.body.walk(_at(mind, target))
    yield from mind.settle(patience=2.5)


def compute_miss(mind: Mind, place: np.ndarray) -> tuple[float, float]:
    """How far the robot's head is seen from a place [m], and the turn that is left [rad]."""
    head = mind.eyes.pose("head")
    return (
        float(np.linalg.norm(place[:2] - head[:2])),
        float(wrap_angle(place[2] - compute_heading(head[3:]))),
    )


def _walk(mind: Mind, target: np.ndarray, hands: np.ndarray, straight: bool, pace: float) -> Doing:
    """One leg: short ways by steps to any side, long ones ahead, with turns before and after.

    What the steps to the side did not bring, the person then goes straight for (`straight`).
    """
    body, person = mind.body, mind.person
    upright = stand_upright(body.posture, hands.copy())
    changed = body.posture.drop + float(np.abs(body.posture.lean).sum())
    if changed + float(np.abs(body.posture.look).sum()) > 0.01 or not np.allclose(
        body.posture.hands, hands, atol=1e-3
    ):
        body.move(upright, max(0.8, changed / person.posture_speed))
        yield from mind.finish()
    way = target[:2] - body.posture.place[:2]
    length = float(np.linalg.norm(way))
    if length > person.step_length or (straight and length > person.place_tolerance):
        course = float(np.arctan2(way[1], way[0]))
        bend = abs(float(wrap_angle(course - body.posture.place[2])))
        if TURN_FIRST < bend:
            body.walk(_at(mind, np.array([*body.posture.place[:2], course])), pace)
            yield from mind.settle(patience=1.5)
            # Turning on the spot has taken the head along; aim once more.
        body.walk(_at(mind, np.array([*target[:2], course])), pace)
        yield from mind.finish()
        if abs(float(wrap_angle(target[2] - course))) > TURN_FIRST:
            yield from mind.pause(mind.person.decision_s)
    body.walk(_at(mind, target), pace)
    yield from mind.finish()


def _at(mind: Mind, place: np.ndarray) -> Posture:
    """The posture at another place (x, y, yaw), turned the shorter way."""
    last = mind.body.posture
    turn = float(wrap_angle(place[2] - last.place[2]))
    return replace(last, place=np.array([*place[:2], last.place[2] + turn]))


def _search(mind: Mind, names: tuple[str, ...]) -> Doing:
    """Look while turning; what comes into view ends the turn."""
    while mind.body.is_moving:
        if names and _knows(mind, names):
            yield from mind.pause(mind.person.decision_s)
            mind.body.halt()
            yield from mind.settle("head")
            return
        yield
    limit = mind.time + mind.person.delay + LAG
    while mind.time < limit and not (names and _knows(mind, names)):
        yield


def _knows(mind: Mind, names: tuple[str, ...]) -> bool:
    return all(mind.eyes.knows(name) for name in names)
