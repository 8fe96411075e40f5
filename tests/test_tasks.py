"""The tasks: where things are placed, that robots can reach them, and what counts."""

from __future__ import annotations

import numpy as np
import pytest
from reachability import find_posture

from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.tasks import dual_point_touch as touch
from xop_lerobot.tasks.hold import Hold
from xop_lerobot.tasks.layout import find_room, make_direction, measure_reach
from xop_lerobot.tasks.stage import Stage

ROBOTS = ("g1", "rby1")


def test_hold_needs_its_time_without_a_break():
    hold = Hold(0.1)
    met = [True, True, False, *[True] * 6, False]
    said = [hold.update(0.02 * i, each) for i, each in enumerate(met)]
    assert said == [False] * 8 + [True, False]


@pytest.mark.parametrize("robot", ROBOTS)
def test_reach_is_where_the_palms_are(robot):
    reach = measure_reach(make_morphology(robot))
    assert 0.2 < reach.forward < 0.6
    assert reach.shoulder - reach.arm < reach.height < reach.shoulder
    assert 0.4 < reach.arm < 0.9


# dual-point touch


def draw_points(robot: str, seeds: range) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Left point, right point [m] and the heading that faces them, by seed."""
    stage = Stage(make_morphology(robot), "dual_point_touch")
    drawn = []
    for seed in seeds:
        stage.reset(seed)
        left, right = (stage.task.objects[f"{side}_point"].pose[:3] for side in ("left", "right"))
        drawn.append((left.copy(), right.copy(), stage.task.facing))
    return drawn


@pytest.mark.parametrize("robot", ROBOTS)
def test_points_are_outside_the_first_workspace(robot):
    reach = measure_reach(make_morphology(robot))
    for left, right, facing in draw_points(robot, range(60)):
        middle = (left + right) / 2
        assert np.linalg.norm(middle[:2]) > reach.forward + touch.BEYOND - 1e-9
        apart = np.linalg.norm((left - right)[:2])
        assert touch.APART[0] - 1e-9 < apart < np.hypot(touch.APART[1], 2 * touch.DEPTH_SPREAD)
        # Who faces them has the left point to the left.
        assert (left - right) @ make_direction(facing + np.pi / 2) > 0


def test_some_points_are_near_a_wall_and_all_inside():
    stage = Stage(make_morphology("rby1"), "dual_point_touch")
    low, high = find_room(stage.plant.model)
    gaps = []
    for left, right, _ in draw_points("rby1", range(100)):
        points = np.stack([left, right])[:, :2]
        gaps.append(np.minimum(points - low, high - points).min())
    gaps = np.array(gaps)
    assert gaps.min() > touch.NEAR_WALL[0] - 1e-9
    assert 30 < (gaps <= touch.NEAR_WALL[1]).sum() < 70


@pytest.mark.parametrize("robot", ROBOTS)
def test_every_pair_of_points_is_in_reach_of_a_sensible_posture(robot):
    morphology = make_morphology(robot)
    reach = measure_reach(morphology)
    for left, right, facing in draw_points(robot, range(12)):
        stance = (left + right) / 2 - reach.forward * make_direction(facing)
        points = {"left_palm": left, "right_palm": right}
        error, _, _ = find_posture(morphology, points, stance, facing)
        assert error < 0.01


def test_reachability_tells_what_is_out_of_reach():
    morphology = make_morphology("g1")
    points = {"left_palm": np.array([0.4, 0.15, 1.9]), "right_palm": np.array([0.4, -0.15, 1.9])}
    assert find_posture(morphology, points, np.zeros(3), 0.0)[0] > 0.2


def test_low_points_ask_for_a_squat():
    """Some are under what G1's arms reach from an upright stance."""
    reach = measure_reach(make_morphology("g1"))
    lowest = min(left[2] for left, _, _ in draw_points("g1", range(40)))
    # From the shoulder down and forward to where the palms are at rest.
    assert lowest < reach.shoulder - np.sqrt(reach.arm**2 - 0.2**2)
