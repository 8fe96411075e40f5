"""The upright constraint: its formula, its derivative, and the levelled goal."""

from __future__ import annotations

import numpy as np
import pytest

from tests.retarget.test_costs import H, K, draw_poses, make_evaluation
from xop_lerobot.core.transforms import (
    make_pose,
    quat_exp,
    quat_from_rpy,
    quat_multiply,
    rotation_error,
)
from xop_lerobot.morphology.tuning import CostWeights
from xop_lerobot.retarget.costs import UprightCost
from xop_lerobot.retarget.costs.tracking import (
    compute_side,
    compute_upright,
    compute_upright_error,
    make_level,
)


def rotate_z(quat: np.ndarray) -> np.ndarray:
    """Third column of the rotation matrix, written out."""
    w, x, y, z = quat
    return np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])


def test_upright_equals_its_formula():
    e = make_evaluation(weights=CostWeights(upright=0.7), upright=("left_wrist",))
    up = np.array([0, 0, 1.0 if rotate_z(e.terminal_goals["left_wrist"][3:])[2] >= 0 else -1.0])
    expected = []
    for i in range(K):
        steps = [
            np.sum((rotate_z(e.poses["left_wrist"][i, k, 3:]) - up) ** 2) for k in range(1, H + 1)
        ]
        last = np.sum((rotate_z(e.terminal_poses["left_wrist"][i, 3:]) - up) ** 2)
        expected.append(0.7 * (np.mean(steps) + last))
    np.testing.assert_allclose(UprightCost().compute(e), expected)


def test_without_the_constraint_a_tilt_is_free():
    np.testing.assert_array_equal(UprightCost().compute(make_evaluation(upright=())), np.zeros(K))


@pytest.mark.parametrize("tilt", [0.0, 0.05, 0.5, np.pi])
def test_only_the_tilt_counts(tilt):
    tilted = quat_exp(np.array([tilt, 0, 0]))
    pose = make_pose(np.ones(3), quat_multiply(quat_from_rpy(0, 0, 1.2), tilted))
    assert compute_upright(pose) == pytest.approx(2 * (1 - np.cos(tilt)))
    assert compute_upright(pose) == pytest.approx(tilt**2, rel=0.1) or tilt == np.pi


def test_the_derivative_of_h_is_that_of_a_turned_vector():
    """dh/dω = -[R e_z]x for a turn ω in world axes, against central differences."""
    pose, step = draw_poses(np.random.default_rng(0)), 1e-6
    x, y, z = compute_upright_error(pose) + [0, 0, 1]
    expected = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    for axis in range(3):
        turns = [quat_exp(sign * step * np.eye(3)[axis]) for sign in (1, -1)]
        turned = [make_pose(pose[:3], quat_multiply(turn, pose[3:])) for turn in turns]
        ends = [compute_upright_error(each) for each in turned]
        np.testing.assert_allclose((ends[0] - ends[1]) / (2 * step), expected[:, axis], atol=1e-8)


def test_a_levelled_goal_is_the_nearest_upright_one():
    poses = draw_poses(np.random.default_rng(1), 50)
    level = make_level(poses)
    side = compute_side(poses)
    assert set(side) == {-1.0, 1.0}
    np.testing.assert_allclose(compute_upright(level, side), 0, atol=1e-20)
    np.testing.assert_array_equal(level[:, :3], poses[:, :3])
    # The least angle is that between the two verticals.
    up = compute_upright_error(poses)[:, 2] + 1
    turn = np.linalg.norm(rotation_error(level[:, 3:], poses[:, 3:]), axis=1)
    np.testing.assert_allclose(turn, np.arccos(side * up), atol=1e-7)
    np.testing.assert_allclose(make_level(level), level, atol=1e-9)


def test_an_open_palm_stays_up():
    """As under a tray: a tilt of 0.2 rad is levelled, the hand is not turned over."""
    pose = make_pose(np.zeros(3), quat_exp(np.array([np.pi - 0.2, 0, 0])))
    level = make_level(pose)
    assert compute_side(pose) == compute_side(level) == -1
    assert compute_upright(level, -1.0) == pytest.approx(0, abs=1e-12)
    assert np.linalg.norm(rotation_error(level[3:], pose[3:])) == pytest.approx(0.2)


def test_each_hand_is_kept_on_its_own_side():
    """Of two samples, one with the palm up and one down, the operator's side costs nothing."""
    down = make_pose(np.zeros(3), quat_from_rpy(0, 0, 0.7))
    up = make_pose(np.zeros(3), quat_multiply(down[3:], quat_exp(np.array([np.pi, 0, 0]))))
    poses = np.tile(np.stack([down, up])[:, None], (1, H + 1, 1))
    for goal, costs in ((down, [0, 8]), (up, [8, 0])):
        e = make_evaluation(
            weights=CostWeights(upright=1.0),
            upright=("left_wrist",),
            qpos=np.zeros((2, H + 1, 9)),
            poses={"left_wrist": poses},
            terminal_poses={"left_wrist": poses[:, -1]},
            terminal_goals={"left_wrist": goal},
        )
        np.testing.assert_allclose(UprightCost().compute(e), costs, atol=1e-12)
