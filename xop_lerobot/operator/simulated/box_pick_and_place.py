"""Carry a box: squeeze it between both palms, lift it, walk to the table, put it down."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator
from dataclasses import replace

import numpy as np

from xop_lerobot.command import Mode
from xop_lerobot.operator.interpolation import compute_heading
from xop_lerobot.operator.simulated.body import SIDES, relaxed_hands
from xop_lerobot.operator.simulated.hands import (
    compute_distance,
    compute_errors,
    compute_reach,
    compute_wrist,
    lean,
    look_at_work,
    move_hands,
    nudge,
    plan_posture,
    reach,
    shift_hands,
    take_posture,
    tip_hands,
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
SURE = 0.0
"""How much more than is just enough a person presses, to be sure [m]."""
PRESS_MORE = 0.01
"""How much more they press after a box has slipped [m]."""
APPROACHES = 4
"""How often a person walks up to the box before giving up."""
FARTHER = 0.055
"""So much farther than for a touch the person stands from a box, to have elbows and waist free [m,
robot]."""
APART = 0.12
"""So much farther apart than else the hands are when one walks up to a box [m]."""
STAND_NEAR = 0.04
"""How far beside where it wants to stand before the box is good enough [m]."""
OUT_OF_REACH = 0.06
"""Palms that stay so far beside their places are out of reach [m]."""
GRASPS = 4
"""How often a person takes hold anew before giving up."""
LIFT = 0.06
"""How high the box is lifted [m]."""
LIFTED = 0.037
"""Rise from which the person is sure to have lifted it [m]."""
LIFTS = 3
"""How often a person lifts on, if the robot's arms come up less than the own."""
LEFT_BEHIND = 0.015
"""A box that rises so much less than the hands stays behind [m]."""
HOLD_S = 3.6
"""How long the lifted box is held [s]."""
BESIDE_TOLERANCE = 0.02
"""How far beside their places the palms may be before they close [m]."""
LOST = 0.12
"""A box that far from the middle between the palms is not held [m]."""
CARRY_SPEED = 0.06
"""Mean speed of hands that hold something [m/s]."""
FIRMER = 0.02
"""How much further in hands are that hold a box while walking [m]."""
STRAIGHTEN_S = 2.5
"""Time to stand up straight with a box [s]."""
BACK = 0.35
"""How far the person steps back from the support [m]."""
WALK_NEAR = 0.06
"""How far beside its spot the box may be when one has walked there; the hands do the rest [m]."""
PLACE_NEAR = 0.04
"""How far beside the spot the box may be put down [m]."""

LEVEL, LEVELLINGS, TIP_SPEED = 0.08, 3, 0.15
"""Tilt at which a box is level enough to be put down [rad], how often a person tips it, and how
fast [rad/s]."""


class OutOfReach(Exception):
    """The hands do not come to where they should be; the person has to stand elsewhere."""


class Slipped(Exception):
    """The box is no longer between the hands."""


def carry_box(mind: Mind) -> Doing:
    """Take the box from its support to the spot on the table; who loses it takes it again."""
    yield from find(mind, "box")
    for attempt in range(APPROACHES):
        try:
            yield from walk_to_box(mind)
            yield from pick_up(mind, attempt * PRESS_MORE)
            yield from walk_to_table(mind)
            yield from put_down(mind)
            return
        except OutOfReach:
            mind.note("the hands do not get there")
        except Slipped:
            mind.note("the box slipped out")
            yield from open_hands(mind)
    raise GaveUp("does not get the box to the table")


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
    distance = compute_distance(mind, [box]) + FARTHER
    place = np.array([*(box - distance * ahead)[:2], heading])
    miss, turn = compute_miss(mind, place)
    if miss > STAND_NEAR or abs(turn) > mind.person.heading_tolerance:
        yield from set_mode(mind, Mode.MOBILE)
        yield from glance(mind, "spot")
        hands = relaxed_hands(mind.person.size)
        hands[:, 1] += [APART, -APART]
        yield from go_to(mind, place, hands=hands, tolerance=STAND_NEAR)
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


def pick_up(mind: Mind, harder: float = 0.0) -> Doing:
    """Take hold of the box, lift it and hold it; who fails presses harder.

    Args:
        mind: Who does.
        harder: How much more than is known to be enough the hands press [m].
    """
    box = mind.eyes.pose("box")[:3]
    yield from take_posture(mind, plan_posture(mind, [box]))
    yield from keep_distance(mind)
    press = mind.eyes.recall("press", PRESS)
    for attempt in range(GRASPS):
        yield from bring_beside(mind)
        rest = float(mind.eyes.pose("box")[2])
        yield from close(mind, press + SURE + harder + attempt * PRESS_MORE)
        rise, lifted = yield from lift(mind, rest)
        if rise > LIFTED:
            yield from mind.pause(HOLD_S)
            check_held(mind)
            return
        yield from shift_hands(mind, np.array([0, 0, -lifted]), CARRY_SPEED)
        yield from open_hands(mind)
    raise GaveUp("the box slips out of the hands")


def lift(mind: Mind, rest: float) -> Generator[None, None, tuple[float, float]]:
    """Lift the box; further, if the robot's arms come up less than the own but with the box.

    Args:
        mind: Who lifts.
        rest: Height at which the box stood [m].

    Returns:
        Rise of the box as seen, and of the goals of the hands [m].
    """
    before, lifted = _see_hands(mind), 0.0
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


def keep_distance(mind: Mind) -> Doing:
    """Lean back, or ahead, to have the box at the distance at which arms work well."""
    head, box = mind.eyes.pose("head"), mind.eyes.pose("box")
    ahead = compute_ahead(compute_heading(head[3:]))
    error = float((box - head)[:3] @ ahead) - compute_reach(mind) - FARTHER
    mind.note(f"box {100 * error:.0f} cm too far")
    if abs(error) > 0.5 * STAND_NEAR:
        yield from lean(mind, {"both": error * ahead})


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
    yield from straighten_up(mind)
    hands = mind.body.posture.hands
    yield from set_mode(mind, Mode.MOBILE)
    head = mind.eyes.pose("head")
    heading = compute_heading(head[3:])
    back = np.array([*(head[:3] - BACK * compute_ahead(heading))[:2], heading])
    yield from go_to(mind, back, hands=hands, laden=True, tolerance=0.15, tries=2)
    yield from find(mind, "spot")
    for _ in range(3):
        check_held(mind)
        heading = choose_heading(mind, "spot")
        place = compute_carry_place(mind, heading)
        miss, _ = compute_miss(mind, place)
        if miss <= WALK_NEAR:
            break
        yield from go_to(mind, place, hands=hands, laden=True, tolerance=WALK_NEAR, tries=3)
    yield from set_mode(mind, Mode.STATIONARY)


def straighten_up(mind: Mind) -> Doing:
    """Stand upright with the box before oneself, and hold it more firmly, before walking."""
    body, last = mind.body, mind.body.posture
    room = body.compute_hands_in_room()
    across = room[0][:3] - room[1][:3]
    across /= np.linalg.norm(across)
    for i in range(2):
        room[i][:3] -= (1 - 2 * i) * FIRMER / mind.belief.scale * across
    end = replace(last, drop=0.0, lean=np.zeros(2), look=np.zeros(2))
    body.move(body.with_hands_in_room(end, dict(zip(SIDES, room, strict=True))), STRAIGHTEN_S)
    yield from mind.settle()
    check_held(mind)


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
    yield from level(mind)
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


def level(mind: Mind) -> Doing:
    """Tip the hands until the box is level."""
    for _ in range(LEVELLINGS):
        yield from mind.settle("left_palm", "right_palm")
        pose = mind.eyes.pose("box")
        up = quat_rotate(pose[3:], np.array([0, 0, 1.0]))
        tilt = float(np.arcsin(up @ compute_ahead(compute_heading(mind.eyes.pose("head")[3:]))))
        mind.note(f"box tilted by {np.degrees(tilt):.0f}°")
        if abs(tilt) < LEVEL:
            return
        yield from tip_hands(mind, -tilt, TIP_SPEED)


def compute_height_over_spot(mind: Mind) -> float:
    """Height of the box's lower side over the table [m]."""
    size = float(mind.eyes.size("box")[2])
    return float(mind.eyes.pose("box")[2] - mind.eyes.pose("spot")[2]) - size


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
