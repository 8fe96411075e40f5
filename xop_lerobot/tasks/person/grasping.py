"""Grasping: hold a box between both palms, lift it, release it."""

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

BESIDE = 0.06
"""Palms come so far beside the box before they close [m]."""
WRIST_CLEAR = 0.025
"""Wrists stay so far before the box's near edge [m]."""
FARTHEST = 0.05
"""Palms that are not stopped end so far inside of the box's sides [m]."""
CLOSE_SPEED = 0.045
"""Mean speed of closing hands [m/s]."""
BEHIND = 0.015
"""A palm that far behind the own hand is stopped [m]."""
PRESSES = 4
"""How often the person presses on, while the palms still give way."""
ROBOT_LAG = 0.35
"""How much later than oneself a robot is known to move [s]."""
PRESS = 0.03
"""Hands that press go so far beyond where they were stopped, for who has not practised [m]."""
OUT_OF_REACH = 0.06
"""Palms that stay so far beside their places are out of reach [m]."""
LIFT = 0.06
"""How high the box is lifted [m]."""
LIFTED = 0.037
"""Rise from which the person is sure to have lifted it [m]."""
LIFTS = 3
"""How often a person lifts on, if the robot's arms come up less than the own."""
LEFT_BEHIND = 0.015
"""A box that rises so much less than the hands stays behind [m]."""
BESIDE_TOLERANCE = 0.02
"""How far beside their places the palms may be before they close [m]."""
LOST = 0.12
"""A box that far from the middle between the palms is not held [m]."""
CARRY_SPEED = 0.06
"""Mean speed of hands that hold something [m/s]."""


class OutOfReach(Exception):
    """The hands do not come to where they should be; the person has to stand elsewhere."""


class Slipped(Exception):
    """The box is no longer between the hands."""


def compute_ahead(heading: float) -> np.ndarray:
    """Unit vector along a heading. Shape (3,)."""
    return np.array([np.cos(heading), np.sin(heading), 0])


def get_half_extents(mind: Mind, heading: float) -> np.ndarray:
    """Half the box's extents along a heading, across it, and up [m]. Shape (3,)."""
    size = mind.eyes.size("box")
    across = abs(np.sin(heading - float(quat_yaw(mind.eyes.pose("box")[3:]))))
    return size[[1, 0, 2]] if across > 0.5 else size


def compute_sides(mind: Mind, outside: float, before: float = 0.0) -> dict[str, np.ndarray]:
    """Where the palms are beside the box. Shapes (3,).

    Args:
        mind: Who grasps.
        outside: Distance of the palms from the box's sides [m].
        before: How much nearer to the person they are than for the grasp [m].
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
    """Hand level along the box, its palm flat against a side. Shape (4,)."""
    heading = compute_heading(mind.eyes.pose("head")[3:])
    yaw = float(quat_yaw(mind.eyes.pose("box")[3:]))
    ahead = compute_ahead(float(yaw + np.pi / 2 * np.round((heading - yaw) / (np.pi / 2))))
    outwards = np.array([-ahead[1], ahead[0], 0]) * (1 if side == "left" else -1)
    return quat_from_matrix(np.column_stack([ahead, np.cross(outwards, ahead), outwards]))


def bring_beside(mind: Mind) -> Doing:
    """Bring both palms to the sides of the box, from the near side and outside."""
    for before, tries in ((0.15, 1), (0.0, mind.person.corrections)):
        sides = compute_sides(mind, BESIDE + (0.03 if before else 0.0), before)
        wrists = {}
        for side, point in sides.items():
            quat = compute_flat(mind, side)
            wrists[side] = compute_wrist(mind, side, point, quat)
        mind.note("hands beside the box" if not before else "hands before the box")
        yield from reach(mind, wrists)
        worst = math.inf
        for _ in range(tries):
            yield from mind.settle("left_palm", "right_palm")
            sides = compute_sides(mind, BESIDE + (0.03 if before else 0.0), before)
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

    Nobody feels what the robot touches: a hand is stopped when it is seen to fall behind the own
    one. A hand that is stopped waits for the other.
    """
    goals = compute_sides(mind, -FARTHEST)
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
    for _ in range(PRESSES):
        # From where the palms are seen, which is where the box stops them.
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
    """Whether a palm is behind the own hand of the moment that is seen now."""
    i = SIDES.index(side)
    went = mind.belief.scale * float(np.linalg.norm(own[i][:3] - first[i][:3]))
    came = float((mind.feel(f"{side}_palm")[:3] - start) @ inwards)
    return went - came > BEHIND


def lift(mind: Mind, rest: float) -> Generator[None, None, tuple[float, float]]:
    """Lift the box; further, if the robot's arms come up less than the own but with the box.

    Args:
        mind: Who lifts.
        rest: Height at which the box stood [m].

    Returns:
        Rise of the box as seen, and of the goals of the hands [m].
    """
    before, lifted, rise = _see_hands(mind), 0.0, 0.0
    for _ in range(LIFTS):
        mind.note("lift")
        step = LIFT - max(0.0, _see_hands(mind) - before)
        yield from shift_hands(mind, np.array([0, 0, step]), CARRY_SPEED)
        yield from mind.settle()
        lifted += step
        rise, hands = float(mind.eyes.pose("box")[2]) - rest, _see_hands(mind) - before
        mind.note(f"box rose {100 * rise:.0f} cm, hands {100 * hands:.0f} cm")
        if rise > LIFTED or hands - rise > LEFT_BEHIND or hands > LIFTED + LEFT_BEHIND:
            break
    return rise, lifted


def _see_hands(mind: Mind) -> float:
    """Mean height of both palms [m]."""
    return float(np.mean([mind.feel(f"{side}_palm")[2] for side in SIDES]))


def open_hands(mind: Mind) -> Doing:
    """Take the hands off the box, to the sides, then up and back."""
    body = mind.body
    room = body.compute_hands_in_room()
    across = room[0][:3] - room[1][:3]
    across[2] = 0
    across /= np.linalg.norm(across)
    way = (PRESS + BESIDE) / mind.belief.scale
    ends = {
        side: make_pose(room[i][:3] + (1 - 2 * i) * way * across, room[i][3:])
        for i, side in enumerate(SIDES)
    }
    body.move(body.with_hands_in_room(body.posture, ends), 1.5)
    yield from mind.settle("left_palm", "right_palm")


def check_held(mind: Mind) -> None:
    """Look whether the box is still between the hands, as far as it is in view.

    Raises:
        Slipped: If it is where it can be taken anew.
        GaveUp: If it lies on the floor.
    """
    if not mind.eyes.sees("box"):
        return
    box = mind.eyes.pose("box")[:3]
    palms = np.mean([mind.feel(f"{side}_palm")[:3] for side in SIDES], axis=0)
    if np.linalg.norm(box - palms) > LOST:
        if box[2] < palms[2] - 3 * LOST:
            raise GaveUp("the box was dropped")
        raise Slipped
