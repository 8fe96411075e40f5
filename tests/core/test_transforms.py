"""Quaternions and poses: group axioms, inverses, and agreement with MuJoCo's own functions."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from xop_lerobot.core.transforms import (
    IDENTITY_POSE,
    compute_heading,
    compute_heading_squares,
    heading_error,
    make_pose,
    pose_inverse,
    pose_multiply,
    quat_conjugate,
    quat_exp,
    quat_from_matrix,
    quat_from_rpy,
    quat_from_yaw,
    quat_log,
    quat_multiply,
    quat_rotate,
    quat_to_rpy,
    quat_yaw,
    rotation_error,
    wrap_angle,
)

IDENTITY = np.array([1.0, 0, 0, 0])
vectors = st.tuples(*[st.floats(-10, 10)] * 3).map(np.array)
# Rotation vectors inside the ball of radius pi, where the logarithm is unique.
turns = st.tuples(vectors, st.floats(0, 3.1)).map(
    lambda drawn: drawn[0] / max(np.linalg.norm(drawn[0]), 1e-6) * drawn[1]
)
quats = turns.map(quat_exp)
poses = st.tuples(vectors, quats).map(lambda drawn: make_pose(*drawn))
angles = st.floats(-3.1, 3.1)
pitches = st.floats(-1.5, 1.5)


def to_matrix(quat: np.ndarray) -> np.ndarray:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def assert_same_rotation(a: np.ndarray, b: np.ndarray, atol: float = 1e-9) -> None:
    """Quaternions of either sign are the same rotation."""
    assert min(np.abs(a - b).max(), np.abs(a + b).max()) < atol


# -- group axioms --------------------------------------------------------------------------


@given(quats, quats, quats)
def test_multiplication_is_associative(a, b, c):
    left = quat_multiply(quat_multiply(a, b), c)
    np.testing.assert_allclose(left, quat_multiply(a, quat_multiply(b, c)), atol=1e-12)


@given(quats)
def test_identity_and_inverse_of_rotations(q):
    np.testing.assert_array_equal(quat_multiply(q, IDENTITY), q)
    np.testing.assert_array_equal(quat_multiply(IDENTITY, q), q)
    np.testing.assert_allclose(quat_multiply(q, quat_conjugate(q)), IDENTITY, atol=1e-12)


@given(poses, poses, poses)
def test_poses_are_a_group(a, b, c):
    left = pose_multiply(pose_multiply(a, b), c)
    np.testing.assert_allclose(left, pose_multiply(a, pose_multiply(b, c)), atol=1e-10)
    np.testing.assert_allclose(pose_multiply(a, pose_inverse(a)), IDENTITY_POSE, atol=1e-10)
    np.testing.assert_allclose(pose_multiply(pose_inverse(a), a), IDENTITY_POSE, atol=1e-10)
    np.testing.assert_allclose(pose_multiply(IDENTITY_POSE, a), a, atol=1e-12)


@given(poses, poses, vectors)
def test_composition_acts_as_one_after_the_other(a, b, point):
    def act(pose: np.ndarray, x: np.ndarray) -> np.ndarray:
        return pose[:3] + quat_rotate(pose[3:], x)

    np.testing.assert_allclose(act(pose_multiply(a, b), point), act(a, act(b, point)), atol=1e-9)


def test_the_identity_cannot_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        IDENTITY_POSE[0] = 1


# -- exponential and logarithm -------------------------------------------------------------


@given(turns)
def test_log_undoes_exp(turn):
    np.testing.assert_allclose(quat_log(quat_exp(turn)), turn, atol=1e-7)


@given(quats)
def test_exp_undoes_log_for_either_sign(q):
    assert_same_rotation(quat_exp(quat_log(q)), q)
    np.testing.assert_allclose(quat_log(-q), quat_log(q), atol=1e-12)


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e-12, 1e-9, 1e-8, 1e-4])
def test_exp_and_log_are_smooth_through_zero(size):
    turn = size * np.array([1.0, -2.0, 0.5])
    q = quat_exp(turn)
    np.testing.assert_allclose(q[1:], turn / 2, rtol=1e-6)
    np.testing.assert_allclose(quat_log(q), turn, rtol=1e-6)


@given(quats, quats)
def test_rotation_error_leads_from_one_to_the_other_in_world_axes(goal, q):
    error = rotation_error(goal, q)
    assert np.linalg.norm(error) <= np.pi + 1e-9
    assert_same_rotation(quat_multiply(quat_exp(error), q), goal)


def test_rotation_error_of_a_yaw_is_about_z_whatever_the_tilt():
    tilted = quat_from_rpy(0.4, -0.3, 1.0)
    goal = quat_multiply(quat_from_yaw(0.2), tilted)
    np.testing.assert_allclose(rotation_error(goal, tilted), [0, 0, 0.2], atol=1e-12)


@given(quats, st.tuples(*[st.floats(-1e-4, 1e-4)] * 3).map(np.array))
def test_a_small_heading_error_is_the_rotation_error(q, turn):
    """Also of a head that looks straight up or down, and of a hand in any pose."""
    goal = quat_multiply(quat_exp(turn), q)
    np.testing.assert_allclose(heading_error(goal, q), rotation_error(goal, q), atol=1e-7)


@given(quats, st.floats(-2.5, 2.5), st.floats(-2.0, 2.0), angles)
def test_a_heading_error_is_a_tilt_and_then_a_turn(q, turn, tilt, axis):
    leaned = tilt * np.array([np.cos(axis), np.sin(axis), 0.0])
    goal = quat_multiply(quat_from_yaw(turn), quat_multiply(quat_exp(leaned), q))
    np.testing.assert_allclose(heading_error(goal, q), [*leaned[:2], turn], atol=1e-6)


@given(angles, angles, st.floats(-np.pi, np.pi), st.floats(-1.5, 1.5))
def test_who_leans_the_same_way_in_another_heading_has_no_error_of_tilt(yaw, other, roll, pitch):
    goal, q = quat_from_rpy(roll, pitch, yaw), quat_from_rpy(roll, pitch, other)
    error = heading_error(goal, q)
    np.testing.assert_allclose(error[:2], 0, atol=1e-7)
    assert wrap_angle(error[2] - (yaw - other)) == pytest.approx(0, abs=1e-7)


@given(quats, quats)
def test_heading_error_of_itself_is_nothing_and_is_bounded(a, b):
    np.testing.assert_allclose(heading_error(a, a), 0, atol=1e-7)
    assert np.abs(heading_error(a, b)).max() <= np.pi + 1e-9


# -- agreement with MuJoCo -----------------------------------------------------------------


@given(quats, quats, vectors)
def test_agrees_with_mujoco(a, b, v):
    product, rotated = np.empty(4), np.empty(3)
    mujoco.mju_mulQuat(product, a, b)
    mujoco.mju_rotVecQuat(rotated, v, a)
    np.testing.assert_allclose(quat_multiply(a, b), product, atol=1e-12)
    np.testing.assert_allclose(quat_rotate(a, v), rotated, atol=1e-11)
    difference = np.empty(3)
    mujoco.mju_subQuat(difference, a, b)  # in the axes of b; ours is in the world's
    world = quat_rotate(b, difference)
    # Half a turn may go either way round.
    if np.linalg.norm(difference) < 3.1:
        np.testing.assert_allclose(rotation_error(a, b), world, atol=1e-7)


@given(quats)
def test_quat_from_matrix_undoes_mujocos_matrix(q):
    got = quat_from_matrix(to_matrix(q))
    assert got[0] >= 0
    assert np.linalg.norm(got) == pytest.approx(1, abs=1e-12)
    assert_same_rotation(got, q)


@pytest.mark.parametrize("axis", np.vstack([np.eye(3), -np.eye(3), np.ones((1, 3)) / np.sqrt(3)]))
@pytest.mark.parametrize("angle", [np.pi, np.pi - 1e-7, np.pi / 2, 1e-9, 0.0])
def test_quat_from_matrix_where_other_formulas_lose_digits(axis, angle):
    q = quat_exp(angle * axis)
    assert_same_rotation(quat_from_matrix(to_matrix(q)), q, atol=1e-8)


def test_functions_broadcast_over_leading_dimensions():
    rng = np.random.default_rng(0)
    batch = quat_exp(rng.normal(size=(4, 5, 3)))
    points = rng.normal(size=(5, 3))
    rotated, logs = quat_rotate(batch, points), quat_log(batch)
    matrices = np.stack([[to_matrix(q) for q in row] for row in batch])
    from_matrices = quat_from_matrix(matrices)
    for i in range(4):
        for j in range(5):
            np.testing.assert_array_equal(rotated[i, j], quat_rotate(batch[i, j], points[j]))
            np.testing.assert_array_equal(logs[i, j], quat_log(batch[i, j]))
            np.testing.assert_array_equal(from_matrices[i, j], quat_from_matrix(matrices[i, j]))


# -- angles --------------------------------------------------------------------------------


@given(angles, pitches, angles)
def test_rpy_round_trip(roll, pitch, yaw):
    q = quat_from_rpy(roll, pitch, yaw)
    np.testing.assert_allclose(quat_to_rpy(q), [roll, pitch, yaw], atol=1e-6)
    assert quat_yaw(q) == pytest.approx(yaw, abs=1e-6)


@given(angles, pitches, angles)
def test_rpy_is_z_then_y_then_x(roll, pitch, yaw):
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    cy, sy = np.cos(yaw), np.sin(yaw)
    rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    np.testing.assert_allclose(to_matrix(quat_from_rpy(roll, pitch, yaw)), rz @ ry @ rx, atol=1e-12)


@given(angles)
def test_yaw_round_trip(yaw):
    assert quat_yaw(quat_from_yaw(yaw)) == pytest.approx(yaw, abs=1e-9)


@given(angles, angles, pitches, angles)
def test_turning_about_the_vertical_adds_to_the_heading(turn, roll, pitch, yaw):
    q = quat_multiply(quat_from_yaw(turn), quat_from_rpy(roll, pitch, yaw))
    assert wrap_angle(quat_yaw(q) - yaw - turn) == pytest.approx(0, abs=1e-6)


def test_pitch_of_a_nose_dive_is_a_right_angle_not_nan():
    q = quat_from_rpy(0, np.pi / 2, 0) * (1 + 1e-12)
    assert quat_to_rpy(q)[1] == pytest.approx(np.pi / 2)


@given(st.floats(-1e3, 1e3), st.integers(-5, 5))
def test_wrap_angle_keeps_the_direction_and_the_range(angle, turns):
    wrapped = wrap_angle(angle + 2 * np.pi * turns)
    assert -np.pi < wrapped <= np.pi
    assert np.exp(1j * wrapped) == pytest.approx(np.exp(1j * angle), abs=1e-9)


@pytest.mark.parametrize("angle, wrapped", [(np.pi, np.pi), (-np.pi, np.pi), (0.0, 0.0)])
def test_wrap_angle_closes_at_plus_pi(angle, wrapped):
    assert wrap_angle(angle) == wrapped


@given(st.integers(0, 2**32 - 1))
def test_squares_of_heading_errors_equal_those_of_the_vector(seed):
    rng = np.random.default_rng(seed)
    goal, quat = quat_exp(2 * rng.normal(size=(2, 5, 3)))
    error = np.square(heading_error(goal, quat))
    turn, tilt = compute_heading_squares(goal, quat)
    np.testing.assert_allclose(turn, error[..., 2], atol=1e-9)
    np.testing.assert_allclose(tilt, error[..., :2].sum(-1), atol=1e-9)


# -- heading of a head ---------------------------------------------------------------------

looks = st.tuples(  # everything a person does with the head, between the feet included
    st.floats(-np.pi / 4, np.pi / 4), st.floats(-np.pi / 2, np.radians(150)), angles
).map(lambda drawn: quat_from_rpy(*drawn))


def compute_angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(rotation_error(a, b)))


@given(st.floats(-np.pi, np.pi), angles)
def test_a_nod_of_any_size_leaves_the_heading_alone(pitch, yaw):
    assert compute_heading(quat_from_rpy(0.0, pitch, yaw)) == pytest.approx(yaw, abs=1e-9)


@given(st.floats(-1.5, 1.5), angles)
def test_a_tilt_to_the_side_leaves_the_heading_of_a_level_gaze_alone(roll, yaw):
    assert compute_heading(quat_from_rpy(roll, 0.0, yaw)) == pytest.approx(yaw, abs=1e-9)


@given(st.floats(-1.0, 1.0), angles)
def test_straight_down_the_heading_is_where_the_crown_points(roll, yaw):
    quat = quat_from_rpy(roll, np.pi / 2, yaw)
    crown = quat_rotate(quat, np.array([0, 0, 1.0]))
    heading = compute_heading(quat)
    np.testing.assert_allclose([np.cos(heading), np.sin(heading)], crown[:2], atol=1e-9)


@given(angles, quats)
def test_a_turn_about_the_vertical_adds_to_the_heading(turn, quat):
    turned = compute_heading(quat_multiply(quat_from_yaw(turn), quat))
    assert wrap_angle(turned - compute_heading(quat) - turn) == pytest.approx(0, abs=1e-6)


@given(quats)
def test_either_sign_and_any_length_of_a_quaternion_is_the_same_heading(quat):
    assert compute_heading(-1.5 * quat) == pytest.approx(compute_heading(quat), abs=1e-9)


@given(looks, st.tuples(*[st.floats(-1e-3, 1e-3)] * 3).map(np.array))
def test_the_heading_never_turns_by_twice_as_much_as_the_head(quat, turn):
    turned = quat_multiply(quat_exp(turn), quat)
    change = abs(wrap_angle(compute_heading(turned) - compute_heading(quat)))
    assert change <= 2 * compute_angle(turned, quat) + 1e-9


def test_the_heading_of_a_head_that_goes_from_the_zenith_to_the_feet_has_no_step():
    for roll in np.radians([-45, -20, 0, 20, 45]):
        nods = np.radians(np.arange(-90, 151))
        headings = [compute_heading(quat_from_rpy(roll, nod, 0.5)) for nod in nods]
        assert np.abs(np.diff(np.unwrap(headings))).max() < np.radians(1.0)


def test_headings_of_a_batch_are_those_of_each():
    quats = quat_exp(np.random.default_rng(0).normal(size=(4, 5, 3)))
    headings = compute_heading(quats)
    assert headings.shape == (4, 5)
    assert headings[2, 3] == compute_heading(quats[2, 3])
