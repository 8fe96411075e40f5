"""Bimanual grasping skills: squeeze a box between both palms, lift it, release it."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Generator

import numpy as np

from xop_lerobot.core.transforms import compute_heading, make_pose, quat_from_matrix, quat_yaw
from xop_lerobot.tasks.person.body import SIDES
from xop_lerobot.tasks.person.hands import (
    compute_errors,
    compute_wrist,
    look_at_work,
    move_hands,
    nudge,
    reach,
    shift_hands,
)
from xop_lerobot.tasks.person.mind import Doing, GaveUp, Mind

PREGRASP_GAP = 0.06
"""Distance of the palms from the box's sides before they close [m]."""
WRIST_CLEAR = 0.025
"""Clearance between the wrists and the box's near edge [m]."""
CLOSE_DEPTH = 0.05
"""Goal of unobstructed palms, inside the box's sides [m]."""
CLOSE_SPEED = 0.045
"""Mean speed of closing hands [m/s]."""
STOPPED_LAG = 0.015
"""Lag of a palm behind the person's own hand from which it counts as stopped [m]."""
MAX_PRESSES = 4
"""Number of presses while the palms still give way."""
ROBOT_LAG = 0.35
"""Expected lag of the robot behind the person's own motion [s]."""
PRESS = 0.03
"""Depth of the press goal beyond where the hands were stopped, without practice [m]."""
OUT_OF_REACH = 0.06
"""Remaining error from which the pregrasp poses count as out of reach [m]."""
LIFT_HEIGHT = 0.06
"""Height by which the box is lifted [m]."""
LIFTED = 0.037
"""Seen rise from which the box counts as lifted [m]."""
MAX_LIFTS = 3
"""Number of lifts if the robot's arms rise less than the person's."""
LEFT_BEHIND = 0.015
"""Rise of the hands over that of the box from which the box is left behind [m]."""
BESIDE_TOLERANCE = 0.02
"""Accepted position error of the palms before they close [m]."""
LOST_DISTANCE = 0.12
"""Distance of the box from the middle of the palms from which it is not held [m]."""
CARRY_SPEED = 0.06
"""Mean speed of hands that hold an object [m/s]."""


class OutOfReach(Exception):
    """Raised when the hands cannot reach their goals and the person must stand elsewhere."""


class Slipped(Exception):
    """Raised when the box is no longer between the hands."""


def compute_ahead(heading: float) -> np.ndarray:
    """Unit vector along a heading [rad]. Shape (3,)."""
    return np.array([np.cos(heading), np.sin(heading), 0])


def get_half_extents(mind: Mind, heading: float) -> np.ndarray:
    """Half extents of the box along the heading, across it, and up [m]. Shape (3,)."""
    size = mind.eyes.size("box")
    across = abs(np.sin(heading - float(quat_yaw(mind.eyes.pose("box")[3:]))))
    return size[[1, 0, 2]] if across > 0.5 else size


def compute_sides(mind: Mind, outside: float, before: float = 0.0) -> dict[str, np.ndarray]:
    """Compute palm positions at the sides of the box. Shapes (3,).

    Args:
        mind: The person.
        outside: Distance of the palms from the box's sides [m].
        before: Offset of the palms towards the person, from where they grasp [m].
    """
    head = mind.eyes.pose("head")
    yaw = float(quat_yaw(mind.eyes.pose("box")[3:]))
    turns = np.pi / 2 * np.round((compute_heading(head[3:]) - yaw) / (np.pi / 2))
    heading = float(yaw + turns)
    half = get_half_extents(mind, heading)
    ahead = compute_ahead(heading)
    left = np.array([-ahead[1], ahead[0], 0])
    wrist = mind.feel("left_wrist")[:3] - mind.feel("left_palm")[:3]
    hand = float(np.linalg.norm(wrist))
    forward = mind.eyes.recall("palm_forward", hand - half[0] - WRIST_CLEAR)
    middle = mind.eyes.pose("box")[:3] + (forward - before) * ahead
    across = (half[1] + mind.eyes.recall("palm_outside", 0.0) + outside) * left
    return {"left": middle + across, "right": middle - across}


def compute_flat(mind: Mind, side: str) -> np.ndarray:
    """Orientation of a level hand along the box, palm flat against its side. Shape (4,)."""
    heading = compute_heading(mind.eyes.pose("head")[3:])
    yaw = float(quat_yaw(mind.eyes.pose("box")[3:]))
    ahead = compute_ahead(float(yaw + np.pi / 2 * np.round((heading - yaw) / (np.pi / 2))))
    outwards = np.array([-ahead[1], ahead[0], 0]) * (1 if side == "left" else -1)
    return quat_from_matrix(np.column_stack([ahead, np.cross(outwards, ahead), outwards]))


def bring_beside(mind: Mind) -> Doing:
    """Bring both palms to the sides of the box: first in front of it and wider, then beside it.

    Raises:
        OutOfReach: If the palms do not reach the sides.
    """
    for before, tries in ((0.15, 1), (0.0, mind.person.corrections)):
        sides = compute_sides(mind, PREGRASP_GAP + (0.03 if before else 0.0), before)
        wrists = {}
        for side, point in sides.items():
            quat = compute_flat(mind, side)
            wrists[side] = compute_wrist(mind, side, point, quat)
        mind.note("hands beside the box" if not before else "hands before the box")
        yield from reach(mind, wrists)
        worst = math.inf
        for _ in range(tries):
            yield from mind.settle("left_palm", "right_palm")
            sides = compute_sides(mind, PREGRASP_GAP + (0.03 if before else 0.0), before)
            yield from look_at_work(mind, sides)
            errors = compute_errors(mind, sides)
            worst = max(float(np.linalg.norm(error)) for error in errors.values())
            mind.note(f"palms {100 * worst:.1f} cm off")
            if worst <= BESIDE_TOLERANCE or before:
                break
            yield from nudge(mind, errors)
        if worst > OUT_OF_REACH and not before:
            raise OutOfReach


def close(mind: Mind, press: float) -> Doing:
    """Close the hands on the box until they are stopped, then press.

    Without haptic feedback a hand counts as stopped when the robot's palm is seen to fall behind
    the person's own. A stopped hand waits for the other.

    Args:
        mind: The person.
        press: Depth of the goals beyond where the palms are stopped [m].
    """
    goals = compute_sides(mind, -CLOSE_DEPTH)
    across = (goals["left"] - goals["right"]) / np.linalg.norm(goals["left"] - goals["right"])
    inwards = {"left": -across, "right": across}
    own = {side: mind.belief.vector_to_own(way) for side, way in inwards.items()}
    start = {side: mind.feel(f"{side}_palm")[:3] for side in SIDES}
    ways = {s: float((goals[s] - start[s]) @ inwards[s]) for s in SIDES}
    first = mind.body.compute_hands_in_room()
    closing, trail = set(SIDES), deque([(mind.time, first)])
    mind.note("close the hands")
    while closing:
        room = mind.body.compute_hands_in_room()
        ends = {}
        for side in closing:
            i = SIDES.index(side)
            end = first[i][:3] + max(ways[side], 0.0) * own[side]
            ends[side] = make_pose(end, room[i][3:])
        longest = max(
            float(np.linalg.norm(e[:3] - room[SIDES.index(s)][:3])) for s, e in ends.items()
        )
        mind.body.move(mind.body.with_hands_in_room(mind.body.posture, ends), longest / CLOSE_SPEED)
        while mind.body.is_moving:
            yield
            trail.append((mind.time, mind.body.compute_hands_in_room()))
            while trail[0][0] < mind.time - mind.person.delay - ROBOT_LAG:
                trail.popleft()
            stopped = {
                s for s in closing if _is_stopped(mind, s, start[s], trail[0][1], first, inwards[s])
            }
            if stopped:
                closing -= stopped
                break
        else:
            break
    for _ in range(MAX_PRESSES):
        # Relative to where the palms are seen, which is where the box stops them.
        came = {s: float((mind.feel(f"{s}_palm")[:3] - start[s]) @ inwards[s]) for s in SIDES}
        mind.note(f"press by {100 * press:.0f} cm")
        room = mind.body.compute_hands_in_room()
        ends = {
            side: make_pose(first[i][:3] + (came[side] + press) * own[side], room[i][3:])
            for i, side in enumerate(SIDES)
        }
        yield from move_hands(mind, ends, slowness=2.0)
        yield from mind.settle("left_palm", "right_palm")
        if all(
            float((mind.feel(f"{s}_palm")[:3] - start[s]) @ inwards[s]) - came[s] < 0.5 * press
            for s in SIDES
        ):
            return


def _is_stopped(
    mind: Mind,
    side: str,
    start: np.ndarray,
    own: np.ndarray,
    first: np.ndarray,
    inwards: np.ndarray,
) -> bool:
    """Whether a palm lags behind the person's own hand at the time that is seen now."""
    i = SIDES.index(side)
    went = mind.belief.scale * float(np.linalg.norm(own[i][:3] - first[i][:3]))
    came = float((mind.feel(f"{side}_palm")[:3] - start) @ inwards)
    return went - came > STOPPED_LAG


def lift(mind: Mind, rest: float) -> Generator[None, None, tuple[float, float]]:
    """Lift the box, and again while the robot's arms rise less than the person's.

    Args:
        mind: The person.
        rest: Height of the box before the lift [m].

    Returns:
        Seen rise of the box, and total rise of the hand goals [m].
    """
    before, lifted, rise = _see_hands(mind), 0.0, 0.0
    for _ in range(MAX_LIFTS):
        mind.note("lift")
        step = LIFT_HEIGHT - max(0.0, _see_hands(mind) - before)
        yield from shift_hands(mind, np.array([0, 0, step]), CARRY_SPEED)
        yield from mind.settle()
        lifted += step
        rise, hands = float(mind.eyes.pose("box")[2]) - rest, _see_hands(mind) - before
        mind.note(f"box rose {100 * rise:.0f} cm, hands {100 * hands:.0f} cm")
        if rise > LIFTED or hands - rise > LEFT_BEHIND or hands > LIFTED + LEFT_BEHIND:
            break
    return rise, lifted


def _see_hands(mind: Mind) -> float:
    """Mean seen height of both palms [m]."""
    return float(np.mean([mind.feel(f"{side}_palm")[2] for side in SIDES]))


def open_hands(mind: Mind) -> Doing:
    """Move the hands apart, off the box."""
    body = mind.body
    room = body.compute_hands_in_room()
    across = room[0][:3] - room[1][:3]
    across[2] = 0
    across /= np.linalg.norm(across)
    way = (PRESS + PREGRASP_GAP) / mind.belief.scale
    ends = {
        side: make_pose(room[i][:3] + (1 - 2 * i) * way * across, room[i][3:])
        for i, side in enumerate(SIDES)
    }
    body.move(body.with_hands_in_room(body.posture, ends), 1.5)
    yield from mind.settle("left_palm", "right_palm")


def check_held(mind: Mind) -> None:
    """Check by sight, if the box is in view, that it is still between the hands.

    Raises:
        Slipped: If it has slipped but can be grasped again.
        GaveUp: If it has fallen.
    """
    if not mind.eyes.sees("box"):
        return
    box = mind.eyes.pose("box")[:3]
    palms = np.mean([mind.feel(f"{side}_palm")[:3] for side in SIDES], axis=0)
    if np.linalg.norm(box - palms) > LOST_DISTANCE:
        if box[2] < palms[2] - 3 * LOST_DISTANCE:
            raise GaveUp("the box was dropped")
        raise Slipped
