"""Wrist goals when the robot's head is not where the operator's is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from xop_lerobot.core.transforms import (
    make_pose,
    pose_inverse,
    pose_multiply,
    quat_exp,
    quat_from_rpy,
    quat_from_yaw,
    rotation_error,
)
from xop_lerobot.retarget.arms.driver import compute_wrist_goals

HEAD = make_pose(np.array([0.1, 0.2, 1.2]), quat_from_rpy(0.1, 0.2, 0.3))
LEFT = make_pose(np.array([0.5, 0.4, 0.9]), quat_from_rpy(0.5, -0.2, 0.4))
RIGHT = make_pose(np.array([0.4, -0.1, 1.0]), quat_from_rpy(-0.5, 0.1, 0.2))
GOALS = {"head": HEAD, "left_wrist": LEFT, "right_wrist": RIGHT}

offsets = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array)
yaws = st.floats(-2.0, 2.0)


def move(pose: np.ndarray, offset: np.ndarray, yaw: float = 0.0) -> np.ndarray:
    """Move a pose and turn it in place about the vertical."""
    turned = pose_multiply(make_pose(np.zeros(3), quat_from_yaw(yaw)), pose)
    return make_pose(pose[:3] + offset, turned[3:])


def carry(pose: np.ndarray, head: np.ndarray) -> np.ndarray:
    """Where the wrist goal is when it stays at its place from the head, on the level."""
    yaw_robot = np.arctan2(*_forward(head)[[1, 0]])
    yaw_goal = np.arctan2(*_forward(HEAD)[[1, 0]])
    robot, goal = (
        make_pose(p[:3], quat_from_yaw(yaw)) for p, yaw in ((head, yaw_robot), (HEAD, yaw_goal))
    )
    return pose_multiply(robot, pose_multiply(pose_inverse(goal), pose))


def _forward(pose: np.ndarray) -> np.ndarray:
    return pose_multiply(pose, np.array([1, 0, 0, 1, 0, 0, 0]))[:3] - pose[:3]


def test_at_the_goal_the_wrists_are_where_the_operator_has_them():
    wrists = compute_wrist_goals(GOALS, HEAD)
    assert set(wrists) == {"left_wrist", "right_wrist"}
    np.testing.assert_allclose(wrists["left_wrist"], LEFT, atol=1e-12)
    np.testing.assert_allclose(wrists["right_wrist"], RIGHT, atol=1e-12)


@given(st.tuples(*[st.floats(-0.06, 0.06)] * 3).map(np.array), st.floats(-0.05, 0.05))
def test_a_swaying_head_does_not_move_the_hands(offset, yaw):
    wrists = compute_wrist_goals(GOALS, move(HEAD, offset, yaw))
    for name in wrists:
        np.testing.assert_allclose(wrists[name][:3], GOALS[name][:3], atol=1e-9)
        np.testing.assert_allclose(rotation_error(GOALS[name][3:], wrists[name][3:]), 0, atol=1e-9)


@given(offsets, yaws)
def test_wrists_stay_near_both_places(offset, yaw):
    """Within the bounds of the body's goal, and never further from the world's than that is."""
    head = move(HEAD, offset, yaw)
    wrists = compute_wrist_goals(GOALS, head)
    for name, wrist in wrists.items():
        body = carry(GOALS[name], head)
        assert np.linalg.norm(wrist[:3] - body[:3]) <= 0.15 + 1e-9
        assert np.linalg.norm(rotation_error(wrist[3:], body[3:])) <= 0.4 + 1e-9
        away = np.linalg.norm(wrist[:3] - GOALS[name][:3])
        assert away <= np.linalg.norm(body[:3] - GOALS[name][:3]) + 1e-9


def test_far_behind_the_goal_the_hands_come_along():
    head = move(HEAD, np.array([-2.0, 0, 0]))
    wrists = compute_wrist_goals(GOALS, head)
    np.testing.assert_allclose(wrists["left_wrist"][:3], LEFT[:3] + [-1.85, 0, 0], atol=1e-9)


def test_a_nodding_robot_does_not_swing_its_hands():
    """Only place and heading of the head count, its tilt does not."""
    nodding = make_pose(HEAD[:3], quat_from_rpy(-0.3, 0.6, 0.3))
    for name, wrist in compute_wrist_goals(GOALS, nodding).items():
        np.testing.assert_allclose(wrist, GOALS[name], atol=1e-9)


@given(offsets, yaws, st.integers(0, 2**32 - 1))
def test_the_change_is_continuous(offset, yaw, seed):
    rng = np.random.default_rng(seed)
    small = 1e-5 * rng.normal(size=3)
    before = compute_wrist_goals(GOALS, move(HEAD, offset, yaw))
    after = compute_wrist_goals(GOALS, move(HEAD, offset + small, yaw + small[0]))
    for name in before:
        assert np.linalg.norm(after[name][:3] - before[name][:3]) < 1e-3
        assert np.linalg.norm(rotation_error(after[name][3:], before[name][3:])) < 1e-3


def test_without_a_head_goal_the_wrists_are_taken_as_they_are():
    wrists = compute_wrist_goals({"left_wrist": LEFT}, HEAD)
    assert list(wrists) == ["left_wrist"]
    np.testing.assert_array_equal(wrists["left_wrist"], LEFT)


@pytest.mark.parametrize("max_offset", [0.0, 0.3])
def test_the_distance_can_be_chosen(max_offset):
    head = move(HEAD, np.array([0, 1.0, 0]))
    wrist = compute_wrist_goals(GOALS, head, max_offset=max_offset)["right_wrist"]
    assert wrist[1] - RIGHT[1] == pytest.approx(1.0 - max_offset)


def test_goals_are_left_untouched():
    copies = {name: pose.copy() for name, pose in GOALS.items()}
    compute_wrist_goals(GOALS, make_pose(np.array([1, 1, 1]), quat_exp(np.array([0.1, 0.2, 0.3]))))
    for name, pose in copies.items():
        np.testing.assert_array_equal(GOALS[name], pose)


@pytest.mark.parametrize("roll", [0.0, 0.35, 0.6])
def test_a_head_that_bends_down_past_the_vertical_makes_no_hand_jump(roll):
    """The head of the robot is behind that of the operator, in its place and in its nod."""
    before = None
    for nod in np.linspace(0.0, 2.2, 111):
        head = make_pose(HEAD[:3], quat_from_rpy(roll, nod, 0.3))
        robot = make_pose(np.array([0.0, 0.0, 1.1]), quat_from_rpy(roll, 0.9 * nod, 0.3))
        wrists = compute_wrist_goals({**GOALS, "head": head}, robot)
        if before is not None:
            for name, wrist in wrists.items():
                assert np.linalg.norm(wrist[:3] - before[name][:3]) < 0.02  # at 1 m, in 0.02 rad
        before = wrists
