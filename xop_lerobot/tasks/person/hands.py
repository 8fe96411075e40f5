"""Reaching skills: the body posture for target points, and movements of the hands.

Points and poses are in the robot's world unless marked *own*, which is the person's room.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from xop_lerobot.core.transforms import (
    make_pose,
    pose_inverse,
    pose_multiply,
    quat_exp,
    quat_from_matrix,
    quat_from_yaw,
    quat_multiply,
    quat_rotate,
    quat_to_rpy,
)
from xop_lerobot.tasks.person.body import (
    HIPS_BACK,
    NECK,
    SIDES,
    TRUNK,
    WRIST_TO_PALM,
    Posture,
    compute_sinking,
)
from xop_lerobot.tasks.person.mind import Doing, Mind

VIEW_MARGIN = 0.08
"""Margin of target points to the edge of the field of view [rad]."""
MIN_EXTRA_NOD = 0.08
"""Smallest additional nod when a hand is out of view [rad]."""
LARGEST_NOD = 0.45
"""Largest nod without bending the trunk [rad]."""
LARGEST_BEND = 0.60
"""Largest bend of the trunk [rad]."""
LOW_REACH = 0.85
"""Usable share of the arm's length when bending down to low targets [1]."""
REACH_PER_SQUAT = 0.1
"""Increase of the working distance per metre of squatting: the knees are ahead [m/m]."""
STRETCHED_SHARE = 0.8
"""Share of the arm's length from which an arm counts as stretched [1]."""
LARGEST_LEAN = 0.12
"""Largest lean without a step [m]."""
SHOULDER = (-0.08, 0.18, -0.28)
"""Left shoulder relative to the eyes: forward, left, up, for eyes at 1.6 m [m]."""
ARM = (0.30, 0.26)
"""Lengths of upper arm and forearm, for eyes at 1.6 m [m]."""


def compute_reach_time(mind: Mind, distance: float) -> float:
    r"""Compute the time of a reach over `distance` [m] by Fitts's law [s].

    T = c (a + b log2(D/W + 1)) with the care factor c, but at least 0.25 s, and with a mean speed
    of at most `Person.hand_speed`.
    """
    person = mind.person
    bits = np.log2(distance / person.hand_width + 1)
    fitts = person.care * (person.fitts_a + person.fitts_b * bits)
    return float(max(fitts, distance / person.hand_speed, 0.25))


def plan_posture(mind: Mind, points: list[np.ndarray], farther: float = 0.0) -> Posture:
    """Plan the posture that brings the points into the comfortable range of the hands.

    Within the comfortable range below the eyes the person stands upright. For lower points it
    squats, and nods to see them; below that it also bends the trunk.

    Args:
        mind: The person.
        points: Targets of the hands. Shapes (3,).
        farther: Additional working distance compared with a touch; above 0 for a grasp [m].
    """
    look = np.array([0.0, compute_nod(mind, points, farther)])
    drop, bend = compute_drop(mind, points), compute_bend(mind, points, farther)
    return replace(mind.body.posture, drop=drop, lean=np.zeros(2), look=look, bend=bend)


def compute_nod(mind: Mind, points: list[np.ndarray], farther: float = 0.0) -> float:
    """Compute the nod that keeps the points well in view from the working distance [rad]."""
    bend = compute_bend(mind, points, farther)
    eyes = compute_eyes(mind, points, farther)
    lowest = eyes - mind.belief.height_to_own(float(min(point[2] for point in points)))
    ahead = compute_reach(mind) - compute_draw(mind, points, farther)
    angle = np.arctan2(mind.belief.scale * lowest, ahead)
    nod = angle - mind.person.view_half_angles[1] + VIEW_MARGIN
    return float(np.clip(nod, bend, max(LARGEST_NOD, bend)))


def compute_drop(mind: Mind, points: list[np.ndarray]) -> float:
    """Compute how far the person squats for the points [m, own]."""
    return float(np.clip(_compute_lack(mind, points), 0.0, mind.person.leg_bend))


def compute_bend(mind: Mind, points: list[np.ndarray], farther: float = 0.0) -> float:
    """Compute the bend of the trunk for points too low for a squat [rad].

    For a grasp (`farther` > 0) it is either zero or the largest: the knees must stay clear of the
    support under the object, and the arms stay bent.
    """
    lack = _compute_lack(mind, points) - mind.person.leg_bend
    if lack <= 0 or farther:
        return LARGEST_BEND if lack > 0 else 0.0
    return min(float(np.arccos(1 - min(lack / (TRUNK * mind.person.size), 1))), LARGEST_BEND)


def compute_eyes(mind: Mind, points: list[np.ndarray], farther: float = 0.0) -> float:
    """Compute the eye height after squatting and bending for the points [m, own]."""
    eyes = mind.person.eye_height
    sunk = compute_sinking(compute_bend(mind, points, farther), eyes)
    return eyes - compute_drop(mind, points) - sunk


def compute_draw(mind: Mind, points: list[np.ndarray], farther: float = 0.0) -> float:
    """Compute how much a bend shortens the working distance [m, robot].

    A bending trunk brings the eyes ahead of the shoulders, and arms that reach down reach less far
    ahead.

    Args:
        mind: The person.
        points: Targets of the hands. Shapes (3,).
        farther: Additional working distance compared with a touch [m].
    """
    bend, size = compute_bend(mind, points, farther), mind.person.size
    if not bend:
        return 0.0
    ahead, up = _turn_down(SHOULDER[0], SHOULDER[2], bend)
    point = mind.belief.height_to_own(float(np.mean(points, axis=0)[2]))
    depth = compute_eyes(mind, points, farther) + size * up - point
    # A robot whose hands rest farther ahead than a person's is taken to have longer arms.
    longer = mind.eyes.rest_reach / (mind.belief.scale * mind.person.reach * size)
    length = LOW_REACH * size * (sum(ARM) + WRIST_TO_PALM) * max(longer, 1.0)
    farthest = size * ahead + float(np.sqrt(max(length**2 - depth**2, 0.0)))
    usual = compute_reach(mind) + mind.belief.scale * REACH_PER_SQUAT * compute_drop(mind, points)
    return max(usual + farther - mind.belief.scale * farthest, 0.0)


def _compute_lack(mind: Mind, points: list[np.ndarray]) -> float:
    """Distance of the points below the comfortable range of who stands upright [m, own]."""
    person, middle = mind.person, np.mean(points, axis=0)
    below = person.eye_height - mind.belief.height_to_own(float(middle[2]))
    return below - person.reach_low * person.size


def _turn_down(ahead: float, up: float, bend: float) -> tuple[float, float]:
    """Rotate (ahead, up) of the eyes [m] by a forward bend of the trunk [rad]."""
    cos, sin = float(np.cos(bend)), float(np.sin(bend))
    return ahead * cos + up * sin, up * cos - ahead * sin


def compute_reach(mind: Mind) -> float:
    """Compute the comfortable working distance ahead of the robot's head [m].

    It is the mean of the person's own working distance, scaled, and that of the robot's resting
    hands: the former is familiar, the latter suits the robot's arms.
    """
    own = mind.person.reach * mind.person.size
    return (mind.belief.scale * own + mind.eyes.rest_reach) / 2


def compute_distance(mind: Mind, points: list[np.ndarray], farther: float = 0.0) -> float:
    """Compute the distance from the standing place to the targets, in the robot's world [m].

    Nodding brings the eyes forward; squatting puts the knees ahead, so the hands work farther out.

    Args:
        mind: The person.
        points: Targets of the hands. Shapes (3,).
        farther: Additional working distance compared with a touch [m].
    """
    knees = mind.belief.scale * REACH_PER_SQUAT * compute_drop(mind, points)
    nod, bend = compute_nod(mind, points, farther), compute_bend(mind, points, farther)
    eyes = NECK * float(np.sin(nod)) - HIPS_BACK * float(np.sin(bend))
    return compute_reach(mind) - compute_draw(mind, points, farther) + knees + eyes + farther


def is_stretched(mind: Mind, side: str, point: np.ndarray) -> bool:
    """Whether the arm is nearly stretched when the palm is at `point`."""
    frame = mind.body.posture.compute_frame(mind.person.eye_height)
    target = mind.belief.point_to_own(point, mind.body.compute_head())
    shoulder = _apply(frame, mind.person.size * _compute_shoulder(mind, side))
    reach = float(np.linalg.norm(target - shoulder))
    share = LOW_REACH if mind.body.posture.bend else STRETCHED_SHARE
    return reach > share * mind.person.size * (sum(ARM) + WRIST_TO_PALM)


def _compute_shoulder(mind: Mind, side: str) -> np.ndarray:
    """Shoulder relative to the eyes along the body's heading, for eyes at 1.6 m. Shape (3,)."""
    ahead, up = _turn_down(SHOULDER[0], SHOULDER[2], mind.body.posture.bend)
    return np.array([ahead, SHOULDER[1] * (1.0 if side == "left" else -1.0), up])


def take_posture(mind: Mind, posture: Posture) -> Doing:
    """Move to a posture (squat, rise, bend or nod) and wait until the robot's head settles."""
    last = mind.body.posture
    way = abs(posture.drop - last.drop) + float(np.linalg.norm(posture.lean - last.lean))
    way += TRUNK * abs(posture.bend - last.bend)
    turn = float(np.linalg.norm(posture.look - last.look))
    duration = max(way / mind.person.posture_speed, 1.875 * turn / mind.person.turn_speed)
    mind.body.move(posture, max(duration, 0.4))
    yield from mind.settle("head")


def go_down(mind: Mind, posture: Posture, way: float) -> Posture:
    """Bend the trunk of a squatting posture, lowering the hands equally in the room.

    Args:
        mind: The person.
        posture: Start posture, with the hands held in front.
        way: Distance by which the hands are lowered [m, own].
    """
    eye_height = mind.person.eye_height
    trunk = TRUNK * mind.person.size
    sunk = compute_sinking(posture.bend, eye_height)
    bend = float(np.arccos(1 - min((sunk + way) / trunk, 1)))
    bend = max(min(bend, LARGEST_BEND), posture.bend)
    room = mind.body.compute_hands_in_room(posture)
    room[:, 2] -= way
    look = np.array([posture.look[0], max(posture.look[1], bend)])
    lower = replace(posture, bend=bend, look=look)
    return mind.body.with_hands_in_room(lower, dict(zip(SIDES, room, strict=True)))


def look_at_work(mind: Mind, points: Mapping[str, np.ndarray]) -> Doing:
    """Nod until hands and points are in view, keeping the hands fixed in the room."""
    head = mind.eyes.pose("head")
    angles = []
    for side, point in points.items():
        for each in (point, mind.feel(f"{side}_palm")[:3]):
            way = each - head[:3]
            angles.append(np.arctan2(-way[2], np.hypot(way[0], way[1])))
    pitch = float(quat_to_rpy(head[3:])[1])
    more = max(angles) - pitch - mind.person.view_half_angles[1] + VIEW_MARGIN / 2
    if not all(mind.eyes.sees(f"{side}_palm") for side in points):
        more = max(more, MIN_EXTRA_NOD)
    body, last = mind.body, mind.body.posture
    nod = float(np.clip(last.look[1] + more, last.look[1], LARGEST_NOD))
    if nod - last.look[1] < 0.02:  # not worth a movement
        return
    mind.note(f"nod by {np.degrees(nod - last.look[1]):.0f}°")
    room = body.compute_hands_in_room()
    posture = replace(last, look=np.array([0.0, nod]))
    keep = dict(zip(SIDES, room, strict=True))
    yield from take_posture(mind, body.with_hands_in_room(posture, keep))


def lean(mind: Mind, errors: Mapping[str, np.ndarray]) -> Doing:
    """Lean towards targets out of the hands' reach, keeping the hands fixed in the room.

    Args:
        mind: The person.
        errors: Position errors of the palms, robot's world [m]. Shapes (3,).
    """
    body, last = mind.body, mind.body.posture
    missed = np.mean(list(errors.values()), axis=0)
    way = quat_rotate(quat_from_yaw(-mind.belief.turn - float(last.place[2])), missed)[:2]
    way = np.clip(last.lean + way, -LARGEST_LEAN, LARGEST_LEAN)
    mind.note(f"lean to {100 * way[0]:.0f} cm ahead, {100 * way[1]:.0f} cm left")
    keep = dict(zip(SIDES, body.compute_hands_in_room(), strict=True))
    yield from take_posture(mind, body.with_hands_in_room(replace(last, lean=way), keep))


def compute_wrist(mind: Mind, side: str, palm: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """Compute the wrist pose that puts the palm at a point with this orientation. Shape (7,).

    The offset from wrist to palm is that of the robot's hand as seen.
    """
    if mind.eyes.sees(f"{side}_wrist") and mind.eyes.sees(f"{side}_palm"):
        wrist, seen = mind.eyes.pose(f"{side}_wrist"), mind.eyes.pose(f"{side}_palm")
    else:
        wrist, seen = mind.feel(f"{side}_wrist"), mind.feel(f"{side}_palm")
    offset = pose_multiply(pose_inverse(wrist), seen)[:3]
    return make_pose(palm - quat_rotate(quat, offset), quat)


def compute_pointing(mind: Mind, side: str, point: np.ndarray) -> np.ndarray:
    """Orientation of a hand that reaches for a point, palm inwards. Shape (4,).

    The hand is aligned with the forearm, and the forearm follows from the person's arm: two links
    from shoulder to wrist, elbow down and slightly out.
    """
    left, size = (1.0 if side == "left" else -1.0), mind.person.size
    body, belief = mind.body, mind.belief
    frame = body.posture.compute_frame(mind.person.eye_height)
    back = pose_inverse(frame)
    target = _apply(back, belief.point_to_own(point, body.compute_head())) / size
    shoulder = _compute_shoulder(mind, side)
    pole = np.array([-0.2, 0.35 * left, -1.0])
    forearm = np.array([1.0, 0, 0])
    # Fixed point: the wrist lies WRIST_TO_PALM before the point, along the forearm.
    for _ in range(5):
        elbow = _place_elbow(shoulder, target - WRIST_TO_PALM * forearm, pole)
        forearm = _unit(target - elbow)
    outwards = np.array([0, left, 0])
    up = _unit(outwards - (outwards @ forearm) * forearm)
    quat = quat_from_matrix(np.column_stack([forearm, np.cross(up, forearm), up]))
    return quat_multiply(quat_from_yaw(belief.turn + float(body.posture.place[2])), quat)


def _place_elbow(shoulder: np.ndarray, wrist: np.ndarray, pole: np.ndarray) -> np.ndarray:
    """Elbow of a two-link arm from shoulder to wrist, on the pole's side. Shape (3,)."""
    upper, fore = ARM
    line = wrist - shoulder
    length = float(np.clip(np.linalg.norm(line), 0.1, 0.99 * (upper + fore)))
    along = _unit(line)
    down = _unit(pole - (pole @ along) * along)
    share = (length**2 + upper**2 - fore**2) / (2 * length)
    return shoulder + share * along + np.sqrt(max(upper**2 - share**2, 0.0)) * down


def reach(mind: Mind, wrists: Mapping[str, np.ndarray], slowness: float = 1.0) -> Doing:
    """Move hands to wrist poses of the robot's world, as believed; both arrive together.

    Args:
        mind: The person.
        wrists: Wrist poses by side. Shapes (7,).
        slowness: Factor on the duration [1].
    """
    body = mind.body
    own = body.compute_head()
    room, goals = body.compute_hands_in_room(), {}
    for side, pose in wrists.items():
        position = mind.belief.point_to_own(pose[:3], own)
        way = float(np.linalg.norm(position - room[SIDES.index(side)][:3]))
        goals[side] = make_pose(position + mind.scatter(way), mind.belief.quat_to_own(pose[3:]))
    yield from move_hands(mind, goals, slowness)


def nudge(mind: Mind, errors: Mapping[str, np.ndarray], slowness: float = 1.0) -> Doing:
    """Correct hand positions by a share of their seen errors.

    Args:
        mind: The person.
        errors: Position errors of the palms by side, robot's world [m]. Shapes (3,).
        slowness: Factor on the duration [1].
    """
    body, gain = mind.body, mind.person.hand_gain
    room, goals = body.compute_hands_in_room(), {}
    for side, error in errors.items():
        step = gain * mind.belief.vector_to_own(error)
        last = room[SIDES.index(side)]
        way = float(np.linalg.norm(step))
        goals[side] = make_pose(last[:3] + step + mind.scatter(way), last[3:])
    yield from move_hands(mind, goals, slowness)


def shift_hands(mind: Mind, way: np.ndarray, speed: float) -> Doing:
    """Translate both hands equally, so that a held object stays held.

    Args:
        mind: The person.
        way: Translation in the robot's world [m]. Shape (3,).
        speed: Mean speed of the hands [m/s].
    """
    own = mind.belief.vector_to_own(way)
    length = float(np.linalg.norm(own))
    own = own + mind.scatter(length)
    room = mind.body.compute_hands_in_room()
    goals = {side: np.array([*(room[i][:3] + own), *room[i][3:]]) for i, side in enumerate(SIDES)}
    duration = max(length / speed, compute_reach_time(mind, length))
    mind.body.move(mind.body.with_hands_in_room(mind.body.posture, goals), duration)
    yield from mind.finish()


def tip_hands(mind: Mind, angle: float, speed: float) -> Doing:
    """Rotate both hands, and what they hold, about the line between the palms.

    Args:
        mind: The person.
        angle: Rotation; positive tips the far side down [rad].
        speed: Mean turn rate [rad/s].
    """
    room = mind.body.compute_hands_in_room()
    palms = [pose[:3] + quat_rotate(pose[3:], np.array([WRIST_TO_PALM, 0, 0])) for pose in room]
    turn = quat_exp(angle * _unit(palms[0] - palms[1]))
    middle = (palms[0] + palms[1]) / 2
    goals = {}
    for side, pose in zip(SIDES, room, strict=True):
        place = middle + quat_rotate(turn, pose[:3] - middle)
        goals[side] = make_pose(place, quat_multiply(turn, pose[3:]))
    mind.body.move(
        mind.body.with_hands_in_room(mind.body.posture, goals), max(1.0, abs(angle) / speed)
    )
    yield from mind.finish()


def move_hands(mind: Mind, goals: Mapping[str, np.ndarray], slowness: float = 1.0) -> Doing:
    """Move hands to wrist poses of the person's room in one movement."""
    body = mind.body
    room = body.compute_hands_in_room()
    ways = [np.linalg.norm(pose[:3] - room[SIDES.index(s)][:3]) for s, pose in goals.items()]
    duration = slowness * compute_reach_time(mind, float(max(ways)))
    body.move(body.with_hands_in_room(body.posture, goals), duration)
    yield from mind.finish()


def compute_errors(mind: Mind, points: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Compute each palm's seen position error, robot's world [m]. Shapes (3,)."""
    return {side: point - mind.feel(f"{side}_palm")[:3] for side, point in points.items()}


def _apply(pose: np.ndarray, point: np.ndarray) -> np.ndarray:
    return pose[:3] + quat_rotate(pose[3:], point)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-9)
