"""Intentions that touch two points: walk up, squat if they are low, reach, correct, hold."""

from __future__ import annotations

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.transforms import compute_heading, quat_from_yaw, quat_rotate
from xop_lerobot.tasks.person.body import SIDES
from xop_lerobot.tasks.person.hands import (
    compute_bend,
    compute_distance,
    compute_errors,
    compute_pointing,
    compute_wrist,
    is_stretched,
    lean,
    look_at_work,
    nudge,
    plan_posture,
    reach,
    take_posture,
)
from xop_lerobot.tasks.person.mind import Doing, Mind
from xop_lerobot.tasks.person.walking import compute_miss, find, go_to, set_mode

POINTS = ("left_point", "right_point")
APPROACHES = 6
"""Number of approaches before giving up."""
STANDOFF_STEP = 0.07
"""Change of the standing distance per approach: closer, or farther if arms were bent [m]."""
ENOUGH = 6.0
"""Time for which both palms seem to touch without success, until something must be wrong [s]."""
LEAN_AFTER = 2
"""Number of unsuccessful corrections after which the person leans, unless bent."""


def touch_two_points(mind: Mind) -> Doing:
    """Walk up to the points and hold both palms at them until the task succeeds."""
    yield from find(mind, *POINTS)
    closer, slide = 0.0, np.zeros(2)
    for approach in range(APPROACHES):
        place = plan_place(mind, closer)
        miss, turn = compute_miss(mind, place)
        # A coarse place suffices for the first approach, unless the person has to bend: a bent
        # trunk cannot lean. Later approaches follow a failure, so they must be precise.
        bends = compute_bend(mind, list(get_points(mind).values())) > 0
        near = mind.person.place_tolerance * (2.0 if not (approach or bends) else 0.5)
        walks = miss > near or abs(turn) > mind.person.heading_tolerance
        if walks:
            yield from set_mode(mind, Mode.MOBILE)
            place -= quat_rotate(quat_from_yaw(place[2]), np.array([*slide, 0.0]))
            yield from go_to(mind, place, tolerance=min(near, mind.person.place_tolerance))
        yield from set_mode(mind, Mode.STATIONARY)
        yield from get_ready(mind)
        if walks:  # a robot that drifts until it stands does so again: aim beyond next time
            slide = mind.surprise
            mind.note("it drifted by {:.0f}, {:.0f} cm".format(*100 * slide))
        yield from hold_points(mind)
        if mind.eyes.success:
            return
        points = get_points(mind)
        stretched = any(is_stretched(mind, side, point) for side, point in points.items())
        closer += STANDOFF_STEP if stretched else -STANDOFF_STEP


def reach_two_points(mind: Mind) -> Doing:
    """Hold both palms at points that are within reach, without walking."""
    yield from find(mind, *POINTS)
    for _ in range(APPROACHES):
        yield from get_ready(mind)
        yield from hold_points(mind)
        if mind.eyes.success:
            return


def get_points(mind: Mind) -> dict[str, np.ndarray]:
    """Seen position of each hand's point, by side. Shapes (3,)."""
    return {side: mind.eyes.pose(f"{side}_point")[:3] for side in SIDES}


def plan_place(mind: Mind, closer: float = 0.0) -> np.ndarray:
    """Plan the standing place: in front of the middle of both points, facing it squarely.

    Args:
        mind: The person.
        closer: Reduction of the comfortable distance [m].

    Returns:
        Place of the head and heading, x y yaw of the robot's world [m, m, rad]. Shape (3,).
    """
    points = get_points(mind)
    middle = (points["left"] + points["right"]) / 2
    across = (points["left"] - points["right"])[:2]
    head = mind.eyes.pose("head")
    if np.linalg.norm(across) > 0.15:
        heading = float(np.arctan2(-across[0], across[1]))
    elif np.linalg.norm(middle[:2] - head[:2]) > 0.3:
        heading = float(np.arctan2(*(middle[:2] - head[:2])[::-1]))
    else:
        heading = compute_heading(head[3:])
    ahead = compute_distance(mind, list(points.values())) - closer
    return np.array(
        [
            middle[0] - ahead * np.cos(heading),
            middle[1] - ahead * np.sin(heading),
            heading,
        ]
    )


def get_ready(mind: Mind) -> Doing:
    """Take the posture from which the hands reach both points."""
    yield from take_posture(mind, plan_posture(mind, list(get_points(mind).values())))


def hold_points(mind: Mind) -> Doing:
    """Reach both points and keep the palms there.

    Returns when the task succeeds, after `Person.corrections` corrections without progress, or if
    nothing happens although both palms seem to touch.
    """
    points = get_points(mind)
    mind.note("reach")
    wrists = {}
    for side, point in points.items():
        quat = compute_pointing(mind, side, point)
        wrists[side] = compute_wrist(mind, side, point, quat)
    yield from reach(mind, wrists)
    worst_ever, wasted, touching = np.inf, 0, np.inf
    while not mind.eyes.success:
        yield from mind.settle("left_palm", "right_palm")
        points = get_points(mind)
        yield from look_at_work(mind, points)
        errors = compute_errors(mind, points)
        worst = max(float(np.linalg.norm(error)) for error in errors.values())
        unseen = [side for side in SIDES if not mind.eyes.sees(f"{side}_palm")]
        mind.note(f"palms {100 * worst:.1f} cm off" + f", {unseen} not seen" * bool(unseen))
        if worst <= mind.person.hand_tolerance:
            touching = min(touching, mind.time)
            if mind.time - touching > ENOUGH:
                return
            yield from mind.pause(0.4)
            continue
        touching = np.inf
        wasted = 0 if worst < 0.8 * worst_ever else wasted + 1
        worst_ever = min(worst, worst_ever)
        if wasted >= mind.person.corrections:
            return
        if wasted == LEAN_AFTER and not mind.body.posture.bend:
            yield from lean(mind, errors)
            continue
        far = {
            side: error
            for side, error in errors.items()
            if np.linalg.norm(error) > 0.6 * mind.person.hand_tolerance
        }
        yield from nudge(mind, far)
