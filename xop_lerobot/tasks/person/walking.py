"""Locomotion skills: search for objects, walk to a place, and switch the mode."""

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

ROBOT_LAG = 0.4
"""Time to keep looking after the person's own turn, as the robot may lag [s]."""
MODE_WAIT = 1.4
"""Longest wait for the display to show the requested mode [s]."""
GLANCE_ANGLE = 0.9
"""Head turn for a look to either side [rad]."""
LOW_SHARE = 0.5
"""Share of the robot's head height below which objects at its feet are out of view ahead."""
LOOK_DOWN, LOOK_DOWN_S = 0.45, 1.0
"""Nod to look for low objects [rad], and its duration [s]."""
RISING_STEP = 0.02
"""Rise of the robot's head from which it is standing up [m]."""
MODE_TRIES = 6
"""Number of double pinches before giving up."""
MAX_STRAINS = 3
"""Number of legs with a straining robot after which the place is accepted."""
LENIENCY = (4, 1.5)
"""Number of legs after which the tolerance is at least so many times the usual."""
ACCEPTED_GAP = 0.2
"""Remaining distance left to arms and a lean if the robot does not come nearer [m]."""
STRAIN_LIMITS = (0.06, 0.2)
"""Difference in height [m] and tilt [rad] to the person's own head that shows strain."""
LADEN_PACE = 0.5
"""Factor on the walking speed while carrying [1]."""
SHORTFALL, OVERAIM, MAX_OVERAIM = 0.12, 0.5, 0.4
"""Remaining distance of a leg that counts as falling short [m]; share of it added to the aim of the
next leg if two legs fell short to the same side; largest such addition [m]. People adapt to a robot
that consistently falls short."""
TURN_FIRST = 0.35
"""Direction change up to which the person starts walking without turning first [rad]."""


def find(mind: Mind, *names: str) -> Doing:
    """Look ahead, then to both sides, then turn round, until all objects are seen.

    Args:
        mind: The person.
        names: Objects to find.

    Raises:
        GaveUp: If one is not found after a full turn.
    """
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
    """Look down for objects not yet seen, if the task says that some are low; keep looking down."""
    head = float(mind.eyes.pose("head")[2])
    if mind.eyes.recall("lowest", head) > LOW_SHARE * head:
        return
    mind.note("look down")
    last = mind.body.posture
    mind.body.move(replace(last, look=np.array([last.look[0], LOOK_DOWN])), LOOK_DOWN_S)
    yield from _search(mind, names)


def _look_up(mind: Mind) -> Doing:
    """Look ahead again: a nod brings the head forward, which would offset the standing place."""
    last = mind.body.posture
    if last.look[1]:
        mind.body.move(replace(last, look=np.array([last.look[0], 0.0])), LOOK_DOWN_S)
        yield from mind.settle("head")


def glance(mind: Mind, *names: str) -> Doing:
    """Look to both sides without a step for objects not yet seen, then ahead again."""
    for angle in (*(mind.rng.choice([-1, 1]) * np.array([GLANCE_ANGLE, -GLANCE_ANGLE])), 0.0):
        if _knows(mind, names) and angle:
            continue
        last = mind.body.posture
        way = abs(float(angle) - float(last.look[0]))
        end = replace(last, look=np.array([float(angle), last.look[1]]))
        mind.body.move(end, 1.875 * way / mind.person.turn_speed)
        yield from _search(mind, names if angle else ())


def set_mode(mind: Mind, mode: Mode) -> Doing:
    """Double pinch with the left hand until the display shows the mode.

    A squatting robot stands up before it walks, so the wait is extended while it is seen to rise.

    Raises:
        GaveUp: After `MODE_TRIES` double pinches.
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
            if mind.eyes.pose("head")[2] > height + RISING_STEP:
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
    """Walk until the robot's head is at a place.

    Each leg is walked open loop; then the person stops, looks, and plans the next. When legs keep
    falling short, the next one aims beyond the place. After `tries` legs the result is accepted.

    Args:
        mind: The person.
        place: Goal of the robot's head, x y yaw of its world [m, m, rad]. Shape (3,).
        tolerance: Accepted position error [m]; `Person.place_tolerance` by default.
        hands: Wrists while walking, relative to the head; relaxed by default. Shape (2, 7).
        laden: Whether the hands carry an object: the pace is slower, and a bent robot is no sign of
            strain.
        tries: Largest number of legs.
    """
    person = mind.person
    near = person.place_tolerance if tolerance is None else tolerance
    hands = relaxed_hands(person.size) if hands is None else hands
    yield from mind.settle()
    stuck, left, ahead = 0, np.zeros(2), np.zeros(2)
    for leg in range(tries):
        miss, turn = compute_miss(mind, place)
        if leg >= LENIENCY[0]:
            near = max(near, LENIENCY[1] * person.place_tolerance)
        if miss <= near and abs(turn) <= person.heading_tolerance:
            return
        own, seen, turn_then = mind.body.posture.place, mind.eyes.pose("head"), mind.belief.turn
        mind.note(f"leg {leg}: {100 * miss:.0f} cm, {np.degrees(turn):.0f}° to go")
        last, left = left, place[:2] - mind.eyes.pose("head")[:2]
        if leg > 1 and miss > SHORTFALL and left @ last > 0:
            ahead += OVERAIM * left
            ahead *= min(1.0, MAX_OVERAIM / max(float(np.linalg.norm(ahead)), 1e-9))
        aim = place + np.array([*ahead, 0.0])
        target = mind.belief.place_to_own(aim)
        target[:2] += mind.scatter(miss, 2)
        target[2] += float(mind.scatter(abs(turn), 1)[0])
        yield from _walk(mind, target, hands, leg % 3 == 2, LADEN_PACE if laden else 1.0)
        yield from mind.settle(patience=2.5)
        if is_strained(mind) and not laden:
            yield from _come_back(mind, own, seen, turn_then)
            stuck += 1
            miss, turn = compute_miss(mind, place)
            bridged = miss <= ACCEPTED_GAP and abs(turn) <= 2 * person.heading_tolerance
            if stuck >= MAX_STRAINS or bridged:
                return


def is_strained(mind: Mind) -> bool:
    """Whether the robot bends or stretches after a head goal that it cannot reach."""
    seen, own = mind.eyes.pose("head"), mind.body.compute_head()
    lift = abs(float(seen[2]) - mind.belief.scale * float(own[2]))
    tilt = np.abs(quat_to_rpy(seen[3:])[:2] - quat_to_rpy(own[3:])[:2])
    return bool(lift > STRAIN_LIMITS[0] or tilt.max() > STRAIN_LIMITS[1])


def _come_back(mind: Mind, own: np.ndarray, seen: np.ndarray, turn: float) -> Doing:
    """Walk back by what the robot did not follow, since pushing on would not help.

    Args:
        mind: The person.
        own: Standing place before the leg, in the room. Shape (3,).
        seen: The robot's head before the leg. Shape (7,).
        turn: Believed yaw between the worlds before the leg [rad]; a bent robot's head shows it
            poorly.
    """
    mind.note("the robot does not come along")
    head = mind.eyes.pose("head")
    came = quat_rotate(quat_from_yaw(-turn), head[:3] - seen[:3])
    turned = wrap_angle(compute_heading(head[3:]) - compute_heading(seen[3:]))
    target = own + np.array([came[0], came[1], float(turned)])
    mind.body.walk(_at(mind, target))
    yield from mind.settle(patience=2.5)


def compute_miss(mind: Mind, place: np.ndarray) -> tuple[float, float]:
    """Compute the robot head's seen distance from a place [m], and the remaining turn [rad]."""
    head = mind.eyes.pose("head")
    return (
        float(np.linalg.norm(place[:2] - head[:2])),
        float(wrap_angle(place[2] - compute_heading(head[3:]))),
    )


def _walk(mind: Mind, target: np.ndarray, hands: np.ndarray, straight: bool, pace: float) -> Doing:
    """Walk one leg: short distances by side or back steps, long ones facing ahead.

    Long legs turn before and after. With `straight`, short ones too: it covers what side steps
    failed to.
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
    """The current posture at another place (x, y, yaw), turned the shorter way. Shape (3,)."""
    last = mind.body.posture
    turn = float(wrap_angle(place[2] - last.place[2]))
    return replace(last, place=np.array([*place[:2], last.place[2] + turn]))


def _search(mind: Mind, names: tuple[str, ...]) -> Doing:
    """Keep looking while turning; halt as soon as all objects are seen."""
    while mind.body.is_moving:
        if names and _knows(mind, names):
            yield from mind.pause(mind.person.decision_s)
            mind.body.halt()
            yield from mind.settle("head")
            return
        yield
    limit = mind.time + mind.person.delay + ROBOT_LAG
    while mind.time < limit and not (names and _knows(mind, names)):
        yield


def _knows(mind: Mind, names: tuple[str, ...]) -> bool:
    return all(mind.eyes.knows(name) for name in names)
