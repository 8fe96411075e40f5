"""Goals over the horizon: held within reach, carried on, and levelled."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from xop_lerobot.core.command import Mode
from xop_lerobot.core.state import Goal
from xop_lerobot.core.transforms import (
    make_pose,
    quat_exp,
    quat_from_rpy,
    quat_from_yaw,
    quat_multiply,
    quat_rotate,
    rotation_error,
)
from xop_lerobot.retarget.horizon_goals import TILT_PREVIEW_S, hold_level, hold_near, preview

HERE = make_pose(np.array([1.0, 2.0, 1.4]), quat_from_yaw(0.3))


def make_goal(offset, rpy=(0, 0, 0), velocity=None) -> Goal:
    pose = make_pose(HERE[:3] + offset, quat_from_rpy(*rpy))
    return Goal(
        {"head": pose, "left_wrist": pose.copy()},
        {} if velocity is None else {"head": np.array(velocity, dtype=float)},
        Mode.MOBILE,
    )


# -- held within reach -----------------------------------------------------------------------


def test_a_goal_within_reach_stays():
    goal = make_goal((0.3, -0.4, -0.6))
    held = hold_near(goal, {"head": HERE}, 0.51)
    np.testing.assert_allclose(held.poses["head"], goal.poses["head"], atol=1e-12)


def test_a_goal_far_away_is_held_on_the_way_to_it():
    goal = make_goal((3.0, 4.0, -0.2), rpy=(0.1, 0.2, 0.3))
    held = hold_near(goal, {"head": HERE}, 0.5).poses["head"]
    # At the reach on the same line, at its own height and orientation.
    np.testing.assert_allclose(held[:3], HERE[:3] + [0.3, 0.4, -0.2])
    np.testing.assert_array_equal(held[3:], goal.poses["head"][3:])


@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(-2, 2))
def test_what_is_held_is_never_further_than_the_reach(x, y, z):
    held = hold_near(make_goal((x, y, z)), {"head": HERE}, 0.4).poses["head"]
    assert np.hypot(*(held[:2] - HERE[:2])) <= 0.4 + 1e-12
    assert held[2] == pytest.approx(HERE[2] + z)


def test_an_infinite_reach_holds_nothing():
    goal = make_goal((300.0, 400.0, 0))
    held = hold_near(goal, {"head": HERE}, np.inf)
    np.testing.assert_allclose(held.poses["head"], goal.poses["head"])


def test_frames_that_are_not_followed_keep_their_goals():
    goal = make_goal((5.0, 0, 0), velocity=[1, 0, 0, 0, 0, 0])
    held = hold_near(goal, {"head": HERE, "right_wrist": HERE}, 0.5)
    np.testing.assert_array_equal(held.poses["left_wrist"], goal.poses["left_wrist"])
    assert set(held.poses) == set(goal.poses)
    assert held.velocities is goal.velocities
    assert held.mode is Mode.MOBILE
    assert goal.poses["head"][0] == HERE[0] + 5.0  # the goal itself is left alone


# -- carried on ------------------------------------------------------------------------------


def test_a_goal_is_carried_on_up_to_the_preview():
    velocity = np.array([0.5, -0.2, 0.1, 0.3, -0.4, 0.8])
    goal = make_goal((0, 0, 0), rpy=(0.2, -0.1, 1.0), velocity=velocity)
    times = np.array([0.0, 0.1, 0.3, 2.0])
    poses = preview(goal, ("head",), times, preview_s=0.3)["head"]
    start = goal.poses["head"]
    for time, pose in zip(np.minimum(times, 0.3), poses, strict=True):
        np.testing.assert_allclose(pose[:3], start[:3] + time * velocity[:3])
        tilt = quat_exp(min(time, TILT_PREVIEW_S) * velocity[3:] * [1, 1, 0])
        turned = quat_multiply(quat_from_yaw(time * velocity[5]), quat_multiply(tilt, start[3:]))
        np.testing.assert_allclose(rotation_error(turned, pose[3:]), 0, atol=1e-12)


@pytest.mark.parametrize("velocity", [None, np.zeros(6)])
def test_a_goal_whose_velocity_is_not_known_stands(velocity):
    goal = make_goal((0.1, 0, 0), velocity=velocity)
    poses = preview(goal, ("head",), np.array([0.0, 0.2]), 0.3)["head"]
    np.testing.assert_array_equal(poses, np.tile(goal.poses["head"], (2, 1)))


def test_without_a_preview_a_goal_stands():
    goal = make_goal((0, 0, 0), velocity=[1, 1, 1, 0, 0, 1])
    poses = preview(goal, ("head",), np.array([0.0, 0.5]), 0.0)["head"]
    np.testing.assert_allclose(poses, np.tile(goal.poses["head"], (2, 1)))


def test_a_frame_without_a_goal_is_left_out():
    assert preview(make_goal((0, 0, 0)), ("right_wrist",), np.zeros(1), 0.3) == {}


# -- levelled --------------------------------------------------------------------------------


def test_hands_are_levelled_with_the_least_turn_and_turn_about_the_vertical_alone():
    goal = make_goal((0, 0, 0), rpy=(0.4, -0.3, 0.9), velocity=[1, 2, 3, 4, 5, 6])
    level = hold_level(goal, ["head"])
    pose = level.poses["head"]
    np.testing.assert_array_equal(pose[:3], goal.poses["head"][:3])
    np.testing.assert_allclose(quat_rotate(pose[3:], np.array([0, 0, 1.0])), [0, 0, 1], atol=1e-12)
    tilt = np.arccos(np.cos(0.4) * np.cos(0.3))
    turn = rotation_error(goal.poses["head"][3:], pose[3:])
    assert np.linalg.norm(turn) == pytest.approx(tilt)
    np.testing.assert_array_equal(level.velocities["head"], [1, 2, 3, 0, 0, 6])
    np.testing.assert_array_equal(level.poses["left_wrist"], goal.poses["left_wrist"])
    np.testing.assert_array_equal(goal.velocities["head"], [1, 2, 3, 4, 5, 6])


def test_nothing_to_level_changes_nothing():
    goal = make_goal((0, 0, 0), rpy=(0.4, 0, 0))
    level = hold_level(goal, ["right_wrist"])
    for frame, pose in goal.poses.items():
        np.testing.assert_array_equal(level.poses[frame], pose)
