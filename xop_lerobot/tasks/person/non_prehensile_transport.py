"""Intention that carries a toy on the open left palm over obstacles and tips it into a box."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.transforms import (
    compute_heading,
    make_pose,
    quat_from_rpy,
    quat_from_yaw,
    quat_multiply,
    quat_rotate,
    quat_yaw,
    wrap_angle,
)
from xop_lerobot.tasks.person.body import SIDES
from xop_lerobot.tasks.person.hands import take_posture
from xop_lerobot.tasks.person.mind import Doing, GaveUp, Mind
from xop_lerobot.tasks.person.walking import compute_miss, go_to, set_mode

NOD = 0.25
"""Nod that brings the person's own palm into view [rad]."""
OBSTACLE_CLEARANCE = 0.10
"""Height of the palm above the tops of the obstacles [m]."""
RIM_CLEARANCE = 0.08
"""Height of the palm above the container's rim while tipping [m]."""
DEFAULT_EDGE = 0.04
"""Distance from the middle of a palm to its edge, if the task gives no hint [m]."""
DEFAULT_FALL = 0.065
"""Horizontal distance that the toy falls beyond that edge, if the task gives no hint [m]."""
START_GAP = 0.12
"""Distance of the hand to the left of the first obstacle at the start [m]."""
CARRY_SPEED = 0.10
"""Mean speed of a hand on which an object lies loose [m/s]."""
AIM_TOLERANCES = (0.006, 0.015)
"""Accepted error of the aim, along the hand and across it [m]."""
LOOK_AGAIN_S = 1.0
"""Pause before the aim is confirmed by a second look [s]."""
TIP_ROLL = 1.3
"""Roll that tips the palm [rad]."""
TIP_S = 1.6
"""Duration of the roll [s]."""
TIPPED_TILT = 0.5
"""Seen tilt from which the palm has tipped [rad]."""
WAIT_S = 2.5
"""Initial pause until the toy lies on the palm [s]."""


def carry_toy(mind: Mind) -> Doing:
    """Carry the toy on the palm to the container and tip it in."""
    while mind.eyes.is_blind:
        yield
    mind.eyes.look_over()
    mind.learn()
    mind.follows_head = False
    yield from look_down(mind)
    yield from mind.pause(WAIT_S)
    yield from walk_up(mind)
    opening, _, left = compute_axes(mind)
    top = max(
        float(mind.eyes.pose(name)[2] + mind.eyes.size(name)[2])
        for name in mind.eyes.names
        if name.startswith("obstacle") and mind.eyes.knows(name)
    )
    height = max(top + OBSTACLE_CLEARANCE, float(opening[2]) + RIM_CLEARANCE)
    palm = mind.feel("left_palm")[:3]
    mind.note("lift the toy")
    yield from carry_to(mind, np.array([*palm[:2], height]))
    mind.note("over the obstacle")
    spot = compute_spot(mind, height)
    # Sideways first, so that the palm passes the obstacle at height before it moves ahead.
    across = palm + ((spot - palm) @ left) * left
    yield from carry_to(mind, np.array([*across[:2], height]))
    yield from carry_to(mind, spot)
    yield from aim(mind)
    yield from tip(mind)


def look_down(mind: Mind) -> Doing:
    """Nod to see hand and opening, keeping the hands fixed in the room."""
    body, last = mind.body, mind.body.posture
    keep = dict(zip(SIDES, body.compute_hands_in_room(), strict=True))
    posture = replace(last, look=np.array([0.0, NOD]))
    yield from take_posture(mind, body.with_hands_in_room(posture, keep))


def compute_axes(mind: Mind) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre of the opening, and the ahead and left directions when facing it. Shapes (3,)."""
    opening = mind.eyes.pose("opening")
    heading = float(quat_yaw(opening[3:])) + np.pi / 2
    course = mind.belief.turn + float(mind.body.posture.place[2])
    if abs(float(wrap_angle(heading - course))) > np.pi / 2:
        heading += np.pi
    ahead = np.array([np.cos(heading), np.sin(heading), 0])
    return opening[:3], ahead, np.array([-ahead[1], ahead[0], 0])


def walk_up(mind: Mind) -> Doing:
    """Walk to where the hand is left of the first obstacle, unless it is there already."""
    opening, ahead, left = compute_axes(mind)
    head, palm = mind.eyes.pose("head"), mind.feel("left_palm")
    heading = float(np.arctan2(ahead[1], ahead[0]))
    turn = quat_from_yaw(heading - compute_heading(head[3:]))
    offset = quat_rotate(turn, palm[:3] - head[:3])
    hand = mind.eyes.pose("obstacle_0")[:3] + START_GAP * left
    hand = hand + ((opening - hand) @ ahead) * ahead
    hand = hand - mind.eyes.recall("toy_forward", 0.0) * ahead
    place = np.array([*(hand - offset)[:2], heading])
    miss, _ = compute_miss(mind, place)
    if miss < mind.person.place_tolerance + 0.1:
        return
    mind.follows_head = True
    yield from set_mode(mind, Mode.MOBILE)
    yield from go_to(mind, place, hands=mind.body.posture.hands)
    mind.follows_head = False
    yield from set_mode(mind, Mode.STATIONARY)
    yield from look_down(mind)


def compute_spot(mind: Mind, height: float) -> np.ndarray:
    """Palm position from which the toy falls into the opening. Shape (3,)."""
    opening, ahead, left = compute_axes(mind)
    spot = opening - mind.eyes.recall("toy_forward", 0.0) * ahead
    spot = (
        spot
        + (mind.eyes.recall("edge", DEFAULT_EDGE) + mind.eyes.recall("fall", DEFAULT_FALL)) * left
    )
    return np.array([*spot[:2], height])


def compute_palm_up(mind: Mind, roll: float = 0.0) -> np.ndarray:
    """Palm up, fingers ahead, rolled to the right by `roll` [rad]. Shape (4,)."""
    _, ahead, _ = compute_axes(mind)
    heading = float(np.arctan2(ahead[1], ahead[0]))
    return quat_multiply(quat_from_yaw(heading), quat_from_rpy(np.pi + roll, 0, 0))


def carry_to(mind: Mind, point: np.ndarray) -> Doing:
    """Move the left palm to a point, level and slowly, with up to two corrections."""
    for attempt in range(3):
        error = point - mind.feel("left_palm")[:3]
        length = float(np.linalg.norm(error))
        if attempt and length < mind.person.hand_tolerance:
            return
        mind.note(f"palm {100 * length:.1f} cm to go")
        yield from _push(mind, error, gain=1.0 if not attempt else mind.person.hand_gain)


def aim(mind: Mind) -> Doing:
    """Bring the toy beside the opening, to within `AIM_TOLERANCES` at two looks in a row."""
    looked = False
    for _ in range(2 * mind.person.corrections):
        opening, ahead, left = compute_axes(mind)
        spot = compute_spot(mind, float(opening[2]) + RIM_CLEARANCE)
        error = spot - mind.feel("left_palm")[:3]
        if mind.eyes.sees("toy"):
            # Along the hand the toy's position counts, since it may have slid on the palm.
            off = (opening - mind.eyes.pose("toy")[:3]) @ ahead
            error = error + (off - error @ ahead) * ahead
        mind.note(f"toy {100 * (error @ ahead):.1f} cm, {100 * (error @ left):.1f} cm beside")
        fine = abs(error @ ahead) <= AIM_TOLERANCES[0] and abs(error @ left) <= AIM_TOLERANCES[1]
        if fine and abs(error[2]) <= 1.5 * AIM_TOLERANCES[1]:
            if looked:
                return
            looked = True
            yield from mind.pause(LOOK_AGAIN_S)
            continue
        looked = False
        yield from _push(mind, error, gain=mind.person.hand_gain)


def tip(mind: Mind) -> Doing:
    """Release the level constraint by a double pinch of both hands, then roll the palm over.

    Raises:
        GaveUp: If the palm stays level after three attempts.
    """
    for _ in range(3):
        mind.note("double pinch of both hands")
        mind.body.double_pinch("left", "right")
        yield from mind.finish()
        yield from mind.pause(1.0)
        # Without the constraint the robot's hand takes the tilt of the person's, which moves the
        # toy; so aim again.
        yield from aim(mind)
        mind.note("tip")
        room = mind.body.compute_hands_in_room()[0]
        tipped = mind.belief.quat_to_own(compute_palm_up(mind, TIP_ROLL))
        end = mind.body.with_hands_in_room(mind.body.posture, {"left": make_pose(room[:3], tipped)})
        mind.body.move(end, TIP_S)
        yield from mind.settle("left_palm")
        yield from mind.pause(1.5)
        up = quat_rotate(mind.feel("left_palm")[3:], np.array([0, 0, -1.0]))
        if mind.eyes.success or np.arccos(np.clip(up[2], -1, 1)) > TIPPED_TILT:
            yield from mind.pause(1.5)
            return
        mind.note("the palm stays level")
        level = mind.belief.quat_to_own(compute_palm_up(mind))
        end = mind.body.with_hands_in_room(mind.body.posture, {"left": make_pose(room[:3], level)})
        mind.body.move(end, TIP_S)
        yield from mind.settle("left_palm")
    raise GaveUp("the palm does not tip")


def _push(mind: Mind, error: np.ndarray, gain: float) -> Doing:
    """Move the left hand by `gain` times the error, slowly, palm up."""
    room = mind.body.compute_hands_in_room()[0]
    step = gain * mind.belief.vector_to_own(error)
    length = float(np.linalg.norm(step))
    roll, pitch = mind.miss_level()
    level = quat_multiply(compute_palm_up(mind), quat_from_rpy(roll, pitch, 0))
    goal = make_pose(room[:3] + step + mind.scatter(0.3 * length), mind.belief.quat_to_own(level))
    duration = max(length / CARRY_SPEED, 0.6)
    mind.body.move(mind.body.with_hands_in_room(mind.body.posture, {"left": goal}), duration)
    yield from mind.settle("left_palm")


def meet_hand(mind: Mind) -> None:
    """Hold the left hand like the robot's before engaging."""
    posture = mind.eyes.first_look
    if posture is None:
        return
    wrists = mind.body.posture.hands.copy()
    wrists[0] = make_pose(posture[:3] * mind.person.eye_height, posture[3:])
    mind.body.hold(wrists)
