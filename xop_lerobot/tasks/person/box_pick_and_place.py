"""Intention that carries a box: squeeze it between both palms, lift, walk to the table, place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.transforms import (
    compute_heading,
    quat_conjugate,
    quat_rotate,
    quat_yaw,
    wrap_angle,
)
from xop_lerobot.tasks.person.body import SIDES, TRUNK, WRIST_TO_PALM, relaxed_hands, stand_upright
from xop_lerobot.tasks.person.grasping import (
    CARRY_SPEED,
    LIFTED,
    PRESS,
    OutOfReach,
    Slipped,
    bring_beside,
    check_held,
    close,
    compute_ahead,
    lift,
    open_hands,
)
from xop_lerobot.tasks.person.hands import (
    compute_distance,
    compute_draw,
    compute_reach,
    go_down,
    lean,
    plan_posture,
    shift_hands,
    take_posture,
    tip_hands,
)
from xop_lerobot.tasks.person.mind import Doing, GaveUp, Mind
from xop_lerobot.tasks.person.walking import compute_miss, find, glance, go_to, set_mode

PRESS_MORE = 0.01
"""Increase of the press depth after each slip [m]."""
APPROACHES = 4
"""Number of approaches to the box before giving up."""
BOX_STANDOFF = 0.055
"""Additional distance to the box compared with a touch, which keeps elbows and waist free [m,
robot]."""
HANDS_APART = 0.12
"""Additional distance of each hand from the middle while walking up to the box [m]. Hands are
also drawn in, as far as the robot's arms allow, so that a turn does not sweep the box off its
support."""
STAND_TOLERANCE = 0.04
"""Accepted error of the standing place in front of the box [m]."""
BEND_TOLERANCE = 0.05
"""Accepted excess of the distance to the box for a bent trunk [m]."""
GRASPS = 4
"""Number of grasps before giving up."""
HOLD_S = 3.6
"""Time the lifted box is held; the task asks for 3 s [s]."""
WALK_PRESS = 0.02
"""Additional inward offset of each hand's goal while walking with the box [m]."""
STRAIGHTEN_S = 2.5
"""Shortest time to stand up with the box [s]."""
STEP_BACK = 0.35
"""Distance of the step back from the support [m]."""
WALK_TOLERANCE = 0.06
"""Accepted distance of the box from its spot after walking; the hands do the rest [m]."""
PLACE_TOLERANCE = 0.04
"""Accepted distance of the box from the spot when it is put down [m]."""
OPENINGS, DONE_S = 3, 2.5
"""Number of times the hands are moved farther off the box, and time to look for success [s]."""
TABLE_CLEARANCE, RISE_CLEARANCE = 0.015, 0.06
"""Height of the box above the table needed to carry it there, and the height aimed for while
standing up with it [m]."""
LOWERINGS, KNEES_ABOVE, KNEES_SPEED = 6, 0.03, 0.08
"""Number of lowering movements before letting go anyway; height from which the knees are bent [m],
and the speed of that [m/s]."""
LEVEL_TILT, LEVELLINGS, TIP_SPEED = 0.08, 3, 0.15
"""Tilt up to which the box can be put down [rad], number of levelling movements, and their turn
rate [rad/s]."""


def carry_box(mind: Mind) -> Doing:
    """Carry the box from its support to the spot on the table; grasp it again if it slips."""
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
    """Heading that squarely faces the side of an object nearest to the line of approach [rad]."""
    pose, head = mind.eyes.pose(name), mind.eyes.pose("head")
    course = float(np.arctan2(*(pose[:2] - head[:2])[::-1]))
    yaw = float(quat_yaw(pose[3:]))
    sides = yaw + np.pi / 2 * np.arange(4)
    return float(sides[np.argmin(np.abs(wrap_angle(sides - course)))])


def walk_to_box(mind: Mind) -> Doing:
    """Walk to stand squarely in front of the box."""
    heading = choose_heading(mind, "box")
    box = mind.eyes.pose("box")[:3]
    ahead = compute_ahead(heading)
    distance = compute_distance(mind, [box], BOX_STANDOFF)
    place = np.array([*(box - distance * ahead)[:2], heading])
    miss, turn = compute_miss(mind, place)
    if miss > STAND_TOLERANCE or abs(turn) > mind.person.heading_tolerance:
        yield from set_mode(mind, Mode.MOBILE)
        yield from glance(mind, "spot")
        hands = relaxed_hands(mind.person.size)
        hands[:, 1] += [HANDS_APART, -HANDS_APART]
        hands[:, 0] -= mind.eyes.recall("draw_in", 0.0) / mind.belief.scale
        yield from go_to(mind, place, hands=hands, tolerance=STAND_TOLERANCE)
    yield from set_mode(mind, Mode.STATIONARY)


def pick_up(mind: Mind, harder: float = 0.0) -> Doing:
    """Grasp, lift and hold the box, pressing harder after each failure.

    Args:
        mind: The person.
        harder: Press depth beyond what the task's hint asks for [m].

    Raises:
        GaveUp: After `GRASPS` failures.
    """
    box = mind.eyes.pose("box")[:3]
    yield from take_posture(mind, plan_posture(mind, [box], BOX_STANDOFF))
    yield from keep_distance(mind)
    press = mind.eyes.recall("press", PRESS)
    for attempt in range(GRASPS):
        yield from bring_beside(mind)
        rest = float(mind.eyes.pose("box")[2])
        yield from close(mind, press + harder + attempt * PRESS_MORE)
        rise, lifted = yield from lift(mind, rest)
        if rise > LIFTED:
            yield from mind.pause(HOLD_S)
            check_held(mind)
            return
        yield from shift_hands(mind, np.array([0, 0, -lifted]), CARRY_SPEED)
        yield from open_hands(mind)
    raise GaveUp("the box slips out of the hands")


def keep_distance(mind: Mind) -> Doing:
    """Lean back or ahead to bring the box to the comfortable working distance.

    Raises:
        OutOfReach: If it is too far for a bent trunk, which cannot lean.
    """
    head, box = mind.eyes.pose("head"), mind.eyes.pose("box")
    ahead = compute_ahead(float(compute_heading(head[3:])))
    error = float((box - head)[:3] @ ahead) - compute_reach(mind) - BOX_STANDOFF
    error += compute_draw(mind, [box[:3]], BOX_STANDOFF)
    mind.note(f"box {100 * error:.0f} cm too far")
    if mind.body.posture.bend:
        if error > BEND_TOLERANCE:
            raise OutOfReach
    elif abs(error) > 0.5 * STAND_TOLERANCE:
        yield from lean(mind, {"both": error * ahead})


def walk_to_table(mind: Mind) -> Doing:
    """Step back, turn to the table and walk up to it with the box held in front."""
    yield from straighten_up(mind)
    hands = mind.body.posture.hands
    yield from set_mode(mind, Mode.MOBILE)
    head = mind.eyes.pose("head")
    heading = float(compute_heading(head[3:]))
    back = np.array([*(head[:3] - STEP_BACK * compute_ahead(heading))[:2], heading])
    yield from go_to(mind, back, hands=hands, laden=True, tolerance=0.15, tries=2)
    yield from find(mind, "spot")
    yield from lift_over_table(mind)
    for _ in range(3):
        check_held(mind)
        heading = choose_heading(mind, "spot")
        place = compute_carry_place(mind, heading)
        miss, _ = compute_miss(mind, place)
        if miss <= WALK_TOLERANCE:
            break
        yield from go_to(mind, place, hands=hands, laden=True, tolerance=WALK_TOLERANCE, tries=3)
    yield from set_mode(mind, Mode.STATIONARY)


def straighten_up(mind: Mind) -> Doing:
    """Stand upright with the box held in front, and squeeze it more firmly for walking."""
    body, last = mind.body, mind.body.posture
    room = body.compute_hands_in_room()
    across = room[0][:3] - room[1][:3]
    across /= np.linalg.norm(across)
    for i in range(2):
        room[i][:3] -= (1 - 2 * i) * WALK_PRESS / mind.belief.scale * across
    end = body.with_hands_in_room(stand_upright(last), dict(zip(SIDES, room, strict=True)))
    if last.bend:
        end = replace(end, hands=bring_up(mind, end.hands))
    body.move(end, max(STRAIGHTEN_S, (last.drop + TRUNK * last.bend) / mind.person.posture_speed))
    yield from mind.settle()
    check_held(mind)


def bring_up(mind: Mind, hands: np.ndarray) -> np.ndarray:
    """Raise and draw in hands that would hang low after standing up.

    The goal height is above the table by `RISE_CLEARANCE`, if the table was seen.

    Args:
        mind: The person.
        hands: Wrists relative to the head, along the body's heading. Shape (2, 7).
    """
    ahead = (compute_reach(mind) + BOX_STANDOFF) / mind.belief.scale - WRIST_TO_PALM
    height = -mind.person.reach_low * mind.person.size
    if mind.eyes.knows("spot"):
        middle = float(mind.eyes.pose("spot")[2] + mind.eyes.size("box")[2]) + RISE_CLEARANCE
        height = max(height, mind.belief.height_to_own(middle) - mind.person.eye_height)
    good = np.array([ahead, 0.0, height])
    way = good - hands[:, :3].mean(axis=0)
    raised = hands.copy()
    raised[:, :3] += np.array([min(way[0], 0.0), 0.0, max(way[2], 0.0)])
    return raised


def lift_over_table(mind: Mind) -> Doing:
    """Lift the box if it is not clear of the table."""
    lack = TABLE_CLEARANCE - compute_height_over_spot(mind)
    if lack > 0:
        mind.note(f"lift it over the table by {100 * lack:.0f} cm")
        yield from shift_hands(mind, np.array([0, 0, lack]), CARRY_SPEED)
        yield from mind.settle("left_palm", "right_palm")


def compute_carry_place(mind: Mind, heading: float) -> np.ndarray:
    """Standing place that puts the held box over the spot, x y yaw. Shape (3,)."""
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
    """Bring the box over the spot, lower it until it stands, let go, and withdraw the hands."""
    for _ in range(4):
        yield from mind.settle("left_palm", "right_palm")
        check_held(mind)
        error = compute_way_to_spot(mind)
        if np.linalg.norm(error) <= PLACE_TOLERANCE:
            break
        yield from shift_hands(mind, mind.person.hand_gain * error, CARRY_SPEED)
    yield from level(mind)
    for _ in range(LOWERINGS):
        yield from mind.settle("left_palm", "right_palm")
        check_held(mind)
        height = compute_height_over_spot(mind)
        mind.note(f"box {100 * height:.1f} cm over the table")
        if height < 0.012:
            break
        if height > KNEES_ABOVE:
            yield from bend_knees(mind, height)
            continue
        # Lowering arms also draws the box nearer, so the horizontal error is corrected again.
        way = mind.person.hand_gain * compute_way_to_spot(mind)
        way[2] = -height - 0.01
        yield from shift_hands(mind, way, CARRY_SPEED)
    mind.note("let go")
    yield from open_hands(mind)
    yield from shift_hands(mind, np.array([0, 0, 0.05]), 2 * CARRY_SPEED)
    for _ in range(OPENINGS):
        yield from mind.pause(DONE_S)
        if mind.eyes.success:
            return
        mind.note("a hand still touches it")
        yield from open_hands(mind)


def bend_knees(mind: Mind, way: float) -> Doing:
    """Lower the whole body, and the trunk if the knees do not suffice, by `way` [m, robot]."""
    last = mind.body.posture
    way /= mind.belief.scale
    drop = min(last.drop + way, mind.person.leg_bend)
    mind.note(f"bend the knees by {100 * (drop - last.drop):.0f} cm")
    end = replace(last, drop=drop)
    left = way - (drop - last.drop)
    if left > 0:
        end = go_down(mind, end, left)
    mind.body.move(end, max(1.0, way / KNEES_SPEED))
    yield from mind.finish()


def compute_way_to_spot(mind: Mind) -> np.ndarray:
    """Horizontal vector from the box to its spot [m]. Shape (3,)."""
    way = (mind.eyes.pose("spot") - mind.eyes.pose("box"))[:3]
    way[2] = 0
    mind.note(f"box {100 * float(np.linalg.norm(way)):.1f} cm beside the spot")
    return way


def level(mind: Mind) -> Doing:
    """Tip the hands until the box is level."""
    for _ in range(LEVELLINGS):
        yield from mind.settle("left_palm", "right_palm")
        pose = mind.eyes.pose("box")
        up = quat_rotate(pose[3:], np.array([0, 0, 1.0]))
        ahead = compute_ahead(float(compute_heading(mind.eyes.pose("head")[3:])))
        tilt = float(np.arcsin(up @ ahead))
        mind.note(f"box tilted by {np.degrees(tilt):.0f}°")
        if abs(tilt) < LEVEL_TILT:
            return
        yield from tip_hands(mind, -tilt, TIP_SPEED)


def compute_height_over_spot(mind: Mind) -> float:
    """Height of the box's lower side above the table [m]."""
    size = float(mind.eyes.size("box")[2])
    return float(mind.eyes.pose("box")[2] - mind.eyes.pose("spot")[2]) - size
