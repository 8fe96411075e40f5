"""Carry a box: squeeze it between both palms, lift it, walk to the table, put it down."""

from __future__ import annotations

import numpy as np

from xop_lerobot.command import Mode
from xop_lerobot.operator.interpolation import compute_heading
from xop_lerobot.operator.simulated.body import SIDES
from xop_lerobot.operator.simulated.hands import (
    compute_distance,
    compute_errors,
    compute_pointing,
    compute_wrist,
    look_at_work,
    nudge,
    plan_posture,
    reach,
    shift_hands,
    take_posture,
)
from xop_lerobot.operator.simulated.mind import Doing, GaveUp, Mind
from xop_lerobot.operator.simulated.walking import compute_miss, find, glance, go_to, set_mode
from xop_lerobot.transforms import (
    make_pose,
    quat_conjugate,
    quat_from_matrix,
    quat_rotate,
    quat_yaw,
    wrap_angle,
)

BESIDE = 0.08
"""Palms come so far beside the box before they close [m]."""
WRIST_CLEAR = 0.025
"""Wrists stay so far before the box's near edge [m]."""
PRESS = 0.07
"""Hands that press go so far beyond where they were stopped [m]."""
PRESS_MORE = 0.03
"""How much more they press after a box has slipped [m]."""
GRASPS = 4
"""How often a person takes hold anew before giving up."""
LIFT = 0.12
"""How high the box is lifted [m]."""
LIFTED = 0.05
"""Rise from which the person is sure to have lifted it [m]."""
HOLD_S = 3.6
"""How long the lifted box is held [s]."""
CARRY_SPEED = 0.12
"""Mean speed of hands that hold something [m/s]."""
BACK = 0.35
"""How far the person steps back from the support [m]."""
PLACE_NEAR = 0.03
"""How far beside the spot the box may be put down [m]."""


def carry_box(mind: Mind) -> Doing:
    """Take the box from its support to the spot on the table."""
    yield from find(mind, "box")
    yield from walk_to_box(mind)
    yield from pick_up(mind)
    yield from walk_to_table(mind)
    yield from put_down(mind)


def choose_heading(mind: Mind, name: str) -> float:
    """Heading that faces a side of a thing squarely: the side that one comes upon [rad]."""
    pose, head = mind.eyes.pose(name), mind.eyes.pose("head")
    course = float(np.arctan2(*(pose[:2] - head[:2])[::-1]))
    yaw = float(quat_yaw(pose[3:]))
    sides = yaw + np.pi / 2 * np.arange(4)
    return float(sides[np.argmin(np.abs(wrap_angle(sides - course)))])


def compute_ahead(heading: float) -> np.ndarray:
    """Unit vector along a heading. Shape (3,)."""
    return np.array([np.cos(heading), np.sin(heading), 0])


def walk_to_box(mind: Mind) -> Doing:
    """Stand before the box, squarely."""
    heading = choose_heading(mind, "box")
    box = mind.eyes.pose("box")[:3]
    ahead = compute_ahead(heading)
    place = np.array([*(box - compute_distance(mind, [box]) * ahead)[:2], heading])
    miss, turn = compute_miss(mind, place)
    if miss > mind.person.place_tolerance or abs(turn) > mind.person.heading_tolerance:
        yield from set_mode(mind, Mode.MOBILE)
        yield from glance(mind, "spot")
        yield from go_to(mind, place)
    yield from set_mode(mind, Mode.STATIONARY)


def get_half_extents(mind: Mind, heading: float) -> np.ndarray:
    """Half the box's extents along a heading, across it, and up [m]. Shape (3,)."""
    size = mind.eyes.size("box")
    across = abs(np.sin(heading - float(quat_yaw(mind.eyes.pose("box")[3:]))))
    return size[[1, 0, 2]] if across > 0.5 else size  # noqa: PLR2004


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
    middle = mind.eyes.pose("box")[:3] + (hand - half[0] - WRIST_CLEAR - before) * ahead
    across = (half[1] + outside) * left
    return {"left": middle + across, "right": middle - across}


def compute_flat(mind: Mind, side: str, point: np.ndarray) -> np.ndarray:
    """Hand on the forearm, but its palm flat against a side of the box. Shape (4,)."""
    heading = compute_heading(mind.eyes.pose("head")[3:])
    yaw = float(quat_yaw(mind.eyes.pose("box")[3:]))
    heading = yaw + np.pi / 2 * np.round((heading - yaw) / (np.pi / 2))
    ahead = compute_ahead(float(heading))
    outwards = np.array([-ahead[1], ahead[0], 0]) * (1 if side == "left" else -1)
    forearm = quat_rotate(compute_pointing(mind, side, point), np.array([1.0, 0, 0]))
    forearm = forearm - (forearm @ outwards) * outwards
    forearm /= np.linalg.norm(forearm)
    return quat_from_matrix(np.column_stack([forearm, np.cross(outwards, forearm), outwards]))


def pick_up(mind: Mind) -> Doing:
    """Take hold of the box and lift it; who fails presses harder."""
    box = mind.eyes.pose("box")[:3]
    yield from take_posture(mind, plan_posture(mind, [box]))
    for attempt in range(GRASPS):
        yield from bring_beside(mind)
        rest = float(mind.eyes.pose("box")[2])
        yield from close(mind, PRESS + attempt * PRESS_MORE)
        mind.note("lift")
        yield from shift_hands(mind, np.array([0, 0, LIFT]), CARRY_SPEED)
        yield from mind.settle()
        rise = float(mind.eyes.pose("box")[2]) - rest
        mind.note(f"box rose {100 * rise:.0f} cm")
        if rise > LIFTED:
            yield from mind.pause(HOLD_S)
            return
        yield from shift_hands(mind, np.array([0, 0, -LIFT]), CARRY_SPEED)
        yield from open_hands(mind)
    raise GaveUp("the box slips out of the hands")


def bring_beside(mind: Mind) -> Doing:
    """Bring both palms to the sides of the box, from the near side and outside."""
    for before, tries in ((0.15, 1), (0.0, mind.person.corrections)):
        sides = compute_sides(mind, BESIDE + (0.03 if before else 0.0), before)
        wrists = {}
        for side, point in sides.items():
            quat = compute_flat(mind, side, point)
            wrists[side] = compute_wrist(mind, side, point, quat)
        mind.note("hands beside the box" if not before else "hands before the box")
        yield from reach(mind, wrists)
        for _ in range(tries):
            yield from mind.settle("left_palm", "right_palm")
            sides = compute_sides(mind, BESIDE + (0.03 if before else 0.0), before)
            yield from look_at_work(mind, sides)
            errors = compute_errors(mind, sides)
            worst = max(float(np.linalg.norm(error)) for error in errors.values())
            mind.note(f"palms {100 * worst:.1f} cm off")
            if worst <= mind.person.hand_tolerance or before:
                break
            yield from nudge(mind, errors)


def close(mind: Mind, press: float) -> Doing:
    """Close the hands on the box until they are stopped, then press.

    Nobody feels what the robot touches; that the hands are stopped is seen.
    """
    body = mind.body
    goals = compute_sides(mind, -press)
    room = body.compute_hands_in_room()
    left = mind.belief.vector_to_own(goals["left"] - goals["right"])
    inwards = -left / np.linalg.norm(left)
    gap = {side: mind.feel(f"{side}_palm")[:3] - goals[side] for side in SIDES}
    ends = {}
    for i, side in enumerate(SIDES):
        sign = 1.0 if side == "left" else -1.0
        way = abs(float(mind.belief.vector_to_own(gap[side]) @ left)) / np.linalg.norm(left)
        ends[side] = make_pose(room[i][:3] + sign * way * inwards, room[i][3:])
    mind.note(f"squeeze by {100 * press:.0f} cm")
    end = body.with_hands_in_room(body.posture, ends)
    body.move(end, 1.6)
    yield from mind.settle("left_palm", "right_palm")


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


def walk_to_table(mind: Mind) -> Doing:
    """Step back, turn to the table and walk up to it, the box before oneself."""
    hands = mind.body.posture.hands
    yield from set_mode(mind, Mode.MOBILE)
    head = mind.eyes.pose("head")
    heading = compute_heading(head[3:])
    back = np.array([*(head[:3] - BACK * compute_ahead(heading))[:2], heading])
    yield from go_to(mind, back, hands=hands, tolerance=0.15, tries=2)
    yield from find(mind, "spot")
    for _ in range(3):
        check_held(mind)
        heading = choose_heading(mind, "spot")
        place = compute_carry_place(mind, heading)
        miss, _ = compute_miss(mind, place)
        if miss <= PLACE_NEAR:
            break
        yield from go_to(mind, place, hands=hands, tolerance=PLACE_NEAR, tries=3)
    yield from set_mode(mind, Mode.STATIONARY)


def compute_carry_place(mind: Mind, heading: float) -> np.ndarray:
    """Where to stand so that the box that one holds is over the spot, x y yaw. Shape (3,)."""
    head, box = mind.eyes.pose("head"), mind.eyes.pose("box")
    now = compute_heading(head[3:])
    offset = quat_rotate(
        quat_conjugate(np.array([np.cos(now / 2), 0, 0, np.sin(now / 2)])), box[:3] - head[:3]
    )
    ahead = compute_ahead(heading)
    left = np.array([-ahead[1], ahead[0], 0])
    spot = mind.eyes.pose("spot")[:3]
    return np.array([*(spot - offset[0] * ahead - offset[1] * left)[:2], heading])


def put_down(mind: Mind) -> Doing:
    """Bring the box over the spot, lower it until it stands, let go, take the hands away."""
    for _ in range(4):
        yield from mind.settle("left_palm", "right_palm")
        check_held(mind)
        error = (mind.eyes.pose("spot") - mind.eyes.pose("box"))[:3]
        error[2] = 0
        off = float(np.linalg.norm(error))
        mind.note(f"box {100 * off:.1f} cm beside the spot")
        if off <= PLACE_NEAR:
            break
        yield from shift_hands(mind, mind.person.hand_gain * error, CARRY_SPEED)
    for _ in range(4):
        yield from mind.settle("left_palm", "right_palm")
        check_held(mind)
        height = compute_height_over_spot(mind)
        mind.note(f"box {100 * height:.1f} cm over the table")
        if height < 0.012:  # noqa: PLR2004
            break
        yield from shift_hands(mind, np.array([0, 0, -height - 0.01]), CARRY_SPEED)
    mind.note("let go")
    yield from open_hands(mind)
    yield from shift_hands(mind, np.array([0, 0, 0.05]), 2 * CARRY_SPEED)
    yield from mind.pause(3.0)


def compute_height_over_spot(mind: Mind) -> float:
    """Height of the box's lower side over the table [m]."""
    size = float(mind.eyes.size("box")[2])
    return float(mind.eyes.pose("box")[2] - mind.eyes.pose("spot")[2]) - size


def check_held(mind: Mind) -> None:
    """Stop when the box lies on the floor.

    Raises:
        GaveUp: If the box has been dropped.
    """
    palms = [mind.feel(f"{side}_palm")[2] for side in SIDES]
    if mind.eyes.sees("box") and mind.eyes.pose("box")[2] < min(palms) - 0.3:  # noqa: PLR2004
        raise GaveUp("the box was dropped")
