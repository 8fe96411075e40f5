"""The collision cost: against a slow reference, its derivative and monotonicity, clearances."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.retarget.test_costs import BOX, NV, H, K, make_evaluation
from xop_lerobot.core.transforms import quat_rotate
from xop_lerobot.morphology.tuning import CostWeights
from xop_lerobot.retarget.costs import CollisionCost
from xop_lerobot.retarget.obstacles import Obstacle

WALL = Obstacle("wall", np.array([0.0, 2, 0]), np.array([1.0, 0, 0, 0]), np.array([3.0, 0.1, 3]))
POST = Obstacle(
    "post", np.array([-0.5, 0, 0]), np.array([1.0, 0, 0, 0]), np.array([0.2, 0.2, 1]), "cylinder"
)
FAR = Obstacle("far", np.array([50.0, 0, 0]), np.array([1.0, 0, 0, 0]), np.ones(3))
RADII = {"a": 0.1, "b": 0.2}


@pytest.mark.parametrize("cut_off", [1.0, 0.4, math.inf])
def test_collision_equals_its_formula(cut_off):
    alpha, beta = 4.0, 6.0
    weights = CostWeights(
        collision=0.7,
        collision_velocity=1.9,
        collision_decay=alpha,
        collision_velocity_decay=beta,
        collision_range=cut_off,
    )
    e = make_evaluation(weights=weights)
    boxes = (BOX, WALL, POST, FAR)

    def compute_barrier(points: dict[str, np.ndarray], speed: float) -> float:
        total = 0.0
        for box in boxes:
            d = min(float(box.compute_distance(points[s])) - r for s, r in RADII.items())
            if d < cut_off:
                total += 0.7 * (math.exp(-alpha * d) - math.exp(-alpha * cut_off))
                total += 1.9 * speed * (math.exp(-beta * d) - math.exp(-beta * cut_off))
        return total

    expected = []
    for i in range(K):
        total = speed = 0.0
        for k in range(1, H + 1):
            speed = e.qvel[i, k, 0] ** 2 + e.qvel[i, k, 1] ** 2
            total += compute_barrier({s: e.points[s][i, k] for s in RADII}, speed) / H
        # And once more at the end of the extrapolation.
        total += compute_barrier({s: e.terminal_points[s][i] for s in RADII}, speed)
        expected.append(total)
    np.testing.assert_allclose(CollisionCost(boxes, RADII).compute(e), expected)


def cost_at(distance: float, speed: float = 0.0, weights: CostWeights | None = None) -> float:
    """Barrier of a circle of 0.1 m that is `distance` off a face of the box."""
    place = BOX.position + quat_rotate(BOX.quat, np.array([0.3 + 0.1 + distance, 0, 0]))
    qvel = np.zeros((1, H + 1, NV))
    qvel[..., 1] = speed
    e = make_evaluation(
        qpos=np.zeros((1, H + 1, 7)),
        points={"a": np.tile(place, (1, H + 1, 1))},
        terminal_points={"a": place[None]},
        qvel=qvel,
        weights=weights or CostWeights(),
    )
    return float(CollisionCost((BOX,), {"a": 0.1}).compute(e)[0]) / 2  # on the way and at its end


def test_collision_is_nothing_far_away_and_grows_on_approach():
    costs = [cost_at(distance) for distance in (1.2, 1.0, 0.5, 0.2, 0.0, -0.05)]
    assert costs[0] == 0
    assert costs[1] == pytest.approx(0, abs=1e-12)
    assert (np.diff(costs[1:]) > 0).all()
    assert costs[-2] == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("distance", [-0.04, 0.05, 0.3, 0.9])
@pytest.mark.parametrize("speed", [0.0, 0.8])
def test_the_slope_is_that_of_the_barriers(distance, speed):
    r"""dl/dd = -α w_c exp(-αd) - β w_v v² exp(-βd), by central differences."""
    weights = CostWeights(
        collision=0.7,
        collision_velocity=1.9,
        collision_decay=3.0,
        collision_velocity_decay=7.0,
    )
    step = 1e-6
    low, high = (cost_at(distance + sign * step, speed, weights) for sign in (-1, 1))
    expected = -3.0 * 0.7 * math.exp(-3.0 * distance)
    expected -= 7.0 * 1.9 * speed**2 * math.exp(-7.0 * distance)
    assert (high - low) / (2 * step) == pytest.approx(expected, rel=1e-5)


def test_speed_costs_more_the_nearer_an_obstacle_is():
    extra = [cost_at(d, speed=1.0) - cost_at(d) for d in (1.5, 0.5, 0.1)]
    assert extra[0] == 0
    assert 0 < extra[1] < extra[2]


def test_without_obstacles_collision_is_free():
    np.testing.assert_array_equal(CollisionCost((), {"a": 1.0}).compute(make_evaluation()), 0)
    np.testing.assert_array_equal(CollisionCost((BOX,), {}).compute(make_evaluation()), 0)
    np.testing.assert_array_equal(CollisionCost((FAR,), {"a": 1.0}).compute(make_evaluation()), 0)


def test_obstacles_can_be_changed():
    cost = CollisionCost((), RADII)
    cost.set_obstacles((BOX, WALL))
    expected = CollisionCost((BOX, WALL), RADII).compute(make_evaluation())
    np.testing.assert_array_equal(cost.compute(make_evaluation()), expected)


def test_a_sample_that_diverged_is_not_a_number_alone():
    e = make_evaluation()
    whole = CollisionCost((BOX,), RADII).compute(e)
    for points in e.points.values():
        points[2] = np.nan
    cost = CollisionCost((BOX,), RADII).compute(e)
    assert np.isnan(cost[2])
    others = np.arange(K) != 2
    np.testing.assert_array_equal(cost[others], whole[others])


def test_clearance_is_the_least_distance_on_the_way():
    e, cost = make_evaluation(), CollisionCost((BOX, WALL, POST), RADII)
    expected = [
        min(
            float(box.compute_distance(e.points[site][i, k])) - radius
            for site, radius in RADII.items()
            for box in (BOX, WALL, POST)
            for k in range(H + 1)
        )
        for i in range(K)
    ]
    np.testing.assert_allclose(cost.compute_clearance(e.points), expected)
    np.testing.assert_array_equal(CollisionCost((), RADII).compute_clearance(e.points), np.inf)
    np.testing.assert_array_equal(CollisionCost((BOX,), {}).compute_clearance(e.points), np.inf)


def test_hands_come_near_to_what_they_work_at():
    e = make_evaluation(weights=CostWeights())
    table = replace(BOX, handled=True)

    def compute(obstacle: Obstacle, *hands: str) -> np.ndarray:
        return CollisionCost((obstacle, WALL), RADII, hands).compute(e)

    expected = CollisionCost((table,), {"b": RADII["b"]}).compute(e)
    expected = expected + CollisionCost((WALL,), RADII).compute(e)
    np.testing.assert_allclose(compute(table, "a"), expected)
    assert (compute(table, "a") < compute(table)).any()
    # What hands do not work at they keep clear of, and so does all else of what is handled.
    np.testing.assert_array_equal(compute(BOX, "a"), compute(BOX))
    np.testing.assert_array_equal(compute(table), compute(BOX))


def test_base_that_stands_keeps_clear_of_nothing():
    e = make_evaluation(weights=CostWeights(), drives=False)
    expected = CollisionCost((BOX, WALL), {"a": RADII["a"]}).compute(e)
    cost = CollisionCost((BOX, WALL), RADII, base=("b",))
    np.testing.assert_array_equal(cost.compute(e), expected)
    whole = CollisionCost((BOX, WALL), RADII)
    np.testing.assert_array_equal(cost.compute(replace(e, drives=True)), whole.compute(e))
