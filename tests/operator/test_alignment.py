"""Alignment and goal velocity: no step at engage, scales, invariance, loss of tracking."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.state import FRAMES
from xop_lerobot.core.transforms import (
    compute_heading,
    make_pose,
    pose_inverse,
    pose_multiply,
    quat_exp,
    quat_from_rpy,
    quat_from_yaw,
    quat_multiply,
    quat_rotate,
    rotation_error,
)
from xop_lerobot.operator.alignment import (
    Alignment,
    AlignmentConfig,
    EngageRefused,
    NotEngaged,
    is_lost,
)
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.goal import GoalVelocity, GoalVelocityConfig

ROBOT_HEIGHT = 1.27
angles = st.floats(-3.0, 3.0)
tilts = st.floats(-0.6, 0.6)
lengths = st.floats(-3.0, 3.0)
seeds = st.integers(0, 2**32 - 1)


def make_frame(rng: np.random.Generator, head: np.ndarray, **fields: object) -> OperatorFrame:
    """A person with the head at `head` and the hands anywhere near."""
    wrists = [
        make_pose(head[:3] + rng.uniform(-0.7, 0.7, 3), quat_exp(rng.normal(size=3)))
        for _ in range(2)
    ]
    return OperatorFrame(0.0, head, *wrists, pinch=np.full(2, 0.08), **fields)


def make_head(rng: np.random.Generator) -> np.ndarray:
    roll, pitch = rng.uniform(-0.5, 0.5, 2)
    turn = quat_from_rpy(roll, pitch, rng.uniform(-3, 3))
    return make_pose(np.array([*rng.uniform(-3, 3, 2), rng.uniform(1, 1.9)]), turn)


def make_robot(rng: np.random.Generator) -> dict[str, np.ndarray]:
    head = make_head(rng)
    head[2] = ROBOT_HEIGHT
    wrists = [make_pose(head[:3] + rng.uniform(-0.4, 0.4, 3), head[3:]) for _ in range(2)]
    return dict(zip(FRAMES, (head, *wrists), strict=True))


def move(frame: OperatorFrame, world: np.ndarray) -> OperatorFrame:
    """The same frame seen from another world: every pose multiplied by `world`."""
    return dataclasses.replace(
        frame, **{name: pose_multiply(world, frame.pose(name)) for name in FRAMES}
    )


def assert_same_pose(actual: np.ndarray, expected: np.ndarray, atol: float = 1e-9) -> None:
    np.testing.assert_allclose(actual[:3], expected[:3], atol=atol)
    assert np.linalg.norm(rotation_error(actual[3:], expected[3:])) < atol * 10


@settings(max_examples=50, deadline=None)
@given(seeds)
def test_engage_gives_exactly_the_robots_head(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frame, robot = make_frame(rng, make_head(rng)), make_robot(rng)
    alignment = Alignment()
    alignment.engage(frame, robot, ROBOT_HEIGHT)
    assert_same_pose(alignment.goal_poses(frame)["head"], robot["head"])
    # Again later, elsewhere: aligned anew, and again without a step.
    later, robot = make_frame(rng, make_head(rng)), make_robot(rng)
    alignment.engage(later, robot, ROBOT_HEIGHT)
    assert_same_pose(alignment.goal_poses(later)["head"], robot["head"])


@settings(max_examples=50, deadline=None)
@given(seeds, angles, lengths, lengths)
def test_turning_and_moving_the_operators_world_changes_no_goal(
    seed: int, yaw: float, x: float, y: float
) -> None:
    rng = np.random.default_rng(seed)
    start, robot = make_frame(rng, make_head(rng)), make_robot(rng)
    now = make_frame(rng, make_head(rng))
    world = make_pose(np.array([x, y, 0.0]), quat_from_yaw(yaw))
    goals = []
    for transform in (make_pose(np.zeros(3), quat_from_yaw(0.0)), world):
        alignment = Alignment()
        alignment.engage(move(start, transform), robot, ROBOT_HEIGHT)
        goals.append(alignment.goal_poses(move(now, transform)))
    for name in FRAMES:
        assert_same_pose(goals[1][name], goals[0][name], atol=1e-7)


@settings(max_examples=50, deadline=None)
@given(seeds, st.floats(-1, 1))
def test_a_lifted_world_changes_no_goal_when_the_scale_is_given(seed: int, lift: float) -> None:
    rng = np.random.default_rng(seed)
    start, robot = make_frame(rng, make_head(rng)), make_robot(rng)
    now = make_frame(rng, make_head(rng))
    goals = []
    for z in (0.0, lift):
        world = make_pose(np.array([0, 0, z]), quat_from_yaw(0.0))
        alignment = Alignment(AlignmentConfig(height_scale=0.8, reach_scale=0.7))
        alignment.engage(move(start, world), robot, ROBOT_HEIGHT)
        goals.append(alignment.goal_poses(move(now, world)))
    for name in FRAMES:
        assert_same_pose(goals[1][name], goals[0][name], atol=1e-9)


@settings(max_examples=50, deadline=None)
@given(seeds, lengths, lengths)
def test_walking_is_one_to_one_along_the_robots_heading(
    seed: int, ahead: float, aside: float
) -> None:
    rng = np.random.default_rng(seed)
    start, robot = make_frame(rng, make_head(rng)), make_robot(rng)
    alignment = Alignment()
    alignment.engage(start, robot, ROBOT_HEIGHT)
    steps = np.array([ahead, aside, 0.0])
    operator = quat_rotate(quat_from_yaw(compute_heading(start.head[3:])), steps)
    walked = move(start, make_pose(operator, quat_from_yaw(0.0)))
    goals = alignment.goal_poses(walked)
    expected = quat_rotate(quat_from_yaw(compute_heading(robot["head"][3:])), steps)
    np.testing.assert_allclose(goals["head"][:3] - robot["head"][:3], expected, atol=1e-9)
    # The hands come along.
    before = alignment.goal_poses(start)
    for name in FRAMES[1:]:
        np.testing.assert_allclose(goals[name][:3] - before[name][:3], expected, atol=1e-9)


@settings(max_examples=50, deadline=None)
@given(seeds, tilts, tilts, angles)
def test_head_turns_about_the_same_body_axes(
    seed: int, roll: float, pitch: float, yaw: float
) -> None:
    """A level person and robot: a turn, nod and tilt of one is the same of the other."""
    rng = np.random.default_rng(seed)
    robot = make_robot(rng)
    robot["head"][3:] = quat_from_yaw(rng.uniform(-3, 3))
    start = make_frame(rng, make_pose(np.array([1.0, 2, 1.7]), quat_from_yaw(rng.uniform(-3, 3))))
    alignment = Alignment()
    alignment.engage(start, robot, ROBOT_HEIGHT)
    turn = quat_from_rpy(roll, pitch, yaw)
    head = make_pose(start.head[:3], quat_multiply(start.head[3:], turn))
    goal = alignment.goal_poses(dataclasses.replace(start, head=head))["head"]
    assert_same_pose(goal, make_pose(robot["head"][:3], quat_multiply(robot["head"][3:], turn)))


def test_heights_and_reach_scale_by_the_ratio_of_heights() -> None:
    rng = np.random.default_rng(0)
    robot = make_robot(rng)
    head = make_pose(np.array([0, 0, 1.65]), quat_from_yaw(0.0))
    start = make_frame(rng, head)
    alignment = Alignment()
    alignment.engage(start, robot, ROBOT_HEIGHT)
    ratio = ROBOT_HEIGHT / 1.65
    assert alignment.scales == pytest.approx(
        {"height_scale": ratio, "reach_scale": ratio, "walk_scale": 1.0}
    )
    squat = dataclasses.replace(start, head=head - np.array([0, 0, 0.3, 0, 0, 0, 0]))
    drop = robot["head"][2] - alignment.goal_poses(squat)["head"][2]
    assert drop == pytest.approx(0.3 * ratio)
    goals = alignment.goal_poses(start)
    reach = np.linalg.norm(goals["left_wrist"][:3] - goals["head"][:3])
    assert reach == pytest.approx(ratio * np.linalg.norm(start.left_wrist[:3] - head[:3]))


def test_palms_down_and_fingers_forward_is_so_for_the_robot() -> None:
    """Canonical wrist frames agree: person facing 1 rad, robot facing −0.5 rad."""
    rng = np.random.default_rng(1)
    robot = make_robot(rng)
    robot["head"][3:] = quat_from_yaw(-0.5)
    start = make_frame(rng, make_pose(np.array([0, 0, 1.6]), quat_from_yaw(1.0)))
    hand = make_pose(start.left_wrist[:3], quat_from_yaw(1.0))
    alignment = Alignment()
    alignment.engage(start, robot, ROBOT_HEIGHT)
    goal = alignment.goal_poses(dataclasses.replace(start, left_wrist=hand))["left_wrist"]
    np.testing.assert_allclose(rotation_error(goal[3:], quat_from_yaw(-0.5)), 0, atol=1e-12)


def test_looking_straight_down_keeps_the_heading() -> None:
    for yaw in np.linspace(-3, 3, 13):
        for pitch in np.radians([-90, -80, -60, 0, 30, 72, 73, 89, 90]):
            quat = quat_from_rpy(0.0, pitch, yaw)
            assert compute_heading(quat) == pytest.approx(yaw, abs=1e-9)


def test_lost_wrist_stays_where_it_was_seen_from_the_head() -> None:
    rng = np.random.default_rng(2)
    robot = make_robot(rng)
    start = make_frame(rng, make_head(rng))
    alignment = Alignment()
    alignment.engage(start, robot, ROBOT_HEIGHT)
    before = alignment.goal_poses(start)
    walk = make_pose(np.array([0.5, 0.2, 0.0]), quat_from_yaw(0.7))
    walked = move(start, walk)
    lost = dataclasses.replace(
        walked, left_wrist=np.zeros(7), tracked=np.array([True, False, True])
    )
    after = alignment.goal_poses(lost)

    def from_head(goals: dict[str, np.ndarray]) -> np.ndarray:
        level = quat_from_yaw(compute_heading(goals["head"][3:]))
        return pose_multiply(pose_inverse(make_pose(goals["head"][:3], level)), goals["left_wrist"])

    assert_same_pose(from_head(after), from_head(before))
    # Nodding does not swing it.
    nod = np.concatenate([lost.head[:3], quat_multiply(lost.head[3:], quat_from_rpy(0, 0.4, 0))])
    nodded = alignment.goal_poses(dataclasses.replace(lost, head=nod))
    np.testing.assert_allclose(nodded["left_wrist"][2], after["left_wrist"][2], atol=1e-9)


def test_wrist_not_seen_at_engage_is_wanted_where_the_robot_has_it() -> None:
    rng = np.random.default_rng(3)
    robot = make_robot(rng)
    frame = make_frame(rng, make_head(rng), tracked=np.array([True, True, False]))
    alignment = Alignment()
    alignment.engage(frame, robot, ROBOT_HEIGHT)
    assert_same_pose(alignment.goal_poses(frame)["right_wrist"], robot["right_wrist"])


def test_lost_head_holds_every_goal_and_is_told() -> None:
    rng = np.random.default_rng(4)
    start = make_frame(rng, make_head(rng))
    alignment = Alignment()
    alignment.engage(start, make_robot(rng), ROBOT_HEIGHT)
    before = alignment.goal_poses(start)
    lost = make_frame(rng, make_head(rng), tracked=np.array([False, True, True]))
    assert is_lost(lost)
    assert not is_lost(start)
    for name, pose in alignment.goal_poses(lost).items():
        np.testing.assert_array_equal(pose, before[name])
    alignment.disengage()
    assert not alignment.is_engaged
    with pytest.raises(NotEngaged, match="the operator is not engaged"):
        alignment.goal_poses(start)


def test_any_subset_of_frames_can_be_bound() -> None:
    rng = np.random.default_rng(5)
    robot, start = make_robot(rng), make_frame(rng, make_head(rng))
    whole, part = Alignment(), Alignment(AlignmentConfig(frames=("left_wrist",)))
    whole.engage(start, robot, ROBOT_HEIGHT)
    part.engage(start, {name: robot[name] for name in FRAMES[:2]}, ROBOT_HEIGHT)
    now = make_frame(rng, make_head(rng))
    goals = part.goal_poses(now)
    assert list(goals) == ["left_wrist"]
    np.testing.assert_array_equal(goals["left_wrist"], whole.goal_poses(now)["left_wrist"])


def test_faults_are_named() -> None:
    rng = np.random.default_rng(6)
    robot, start = make_robot(rng), make_frame(rng, make_head(rng))
    alignment = Alignment()
    lost = dataclasses.replace(start, tracked=np.array([False, True, True]))
    with pytest.raises(EngageRefused, match="the operator's head is not tracked"):
        alignment.engage(lost, robot, ROBOT_HEIGHT)
    low = dataclasses.replace(start, head=make_pose(np.array([0, 0, 0.02]), start.head[3:]))
    with pytest.raises(EngageRefused, match=r"head is 0\.02 m over the device's floor, less"):
        alignment.engage(low, robot, ROBOT_HEIGHT)
    assert not alignment.is_engaged
    with pytest.raises(UnknownName) as error:
        alignment.engage(start, {"head": robot["head"], "left_wrist": robot["head"]}, 1.0)
    assert str(error.value) == "unknown robot frame 'right_wrist'. Known: head, left_wrist"
    with pytest.raises(BadValue) as value_error:
        AlignmentConfig(height_scale=0.0)
    assert str(value_error.value) == ("alignment.height_scale must be finite and above 0, got 0.0")
    with pytest.raises(UnknownName, match="unknown alignment frame 'foot'. Known: head, left"):
        AlignmentConfig(frames=("foot",))


# Goal velocity.

VELOCITY = np.array([0.4, -0.2, 0.1])
OMEGA = np.array([0.1, -0.3, 0.6])


def pose_at(time: float) -> dict[str, np.ndarray]:
    """Head at rest until 0, then at constant linear and angular velocity."""
    time = max(time, 0.0)
    quat = quat_multiply(quat_exp(OMEGA * time), quat_from_rpy(0.2, 0.3, 2.0))
    return {"head": make_pose(np.array([1.0, 2, 1.2]) + VELOCITY * time, quat)}


@pytest.mark.parametrize("rate", [10, 25, 90])
def test_velocity_follows_a_first_order_lag_at_any_rate(rate: int) -> None:
    estimator = GoalVelocity(GoalVelocityConfig(time_constant=0.1))
    for i in range(-rate, 2 * rate + 1):
        time = i / rate
        velocity = estimator.update(time, pose_at(time))["head"]
        if time <= 0:
            np.testing.assert_allclose(velocity, 0, atol=1e-12)
        else:
            share = 1 - np.exp(-time / 0.1)
            expected = share * np.concatenate([VELOCITY, OMEGA])
            np.testing.assert_allclose(velocity, expected, atol=1e-6)


def test_repeated_stamps_gaps_and_resets() -> None:
    estimator, velocity = GoalVelocity(), np.zeros(6)
    for i in range(50):
        velocity = estimator.update(i / 25, pose_at(i / 25))["head"]
        again = estimator.update(i / 25, pose_at(i / 25))["head"]
        np.testing.assert_array_equal(again, velocity)
    assert np.linalg.norm(velocity[:3]) > 0.4
    # Nothing is known across a gap, nor after a reset, nor when the clock goes back.
    assert not estimator.update(3.0, pose_at(3.0))["head"].any()
    assert estimator.update(3.04, pose_at(3.04))["head"].any()
    assert not estimator.update(0.0, pose_at(0.0))["head"].any()
    estimator.update(0.04, pose_at(0.04))
    estimator.reset()
    assert not estimator.update(0.08, pose_at(0.08))["head"].any()


def test_a_jump_is_bounded_and_fades() -> None:
    estimator = GoalVelocity()
    pose = pose_at(0.0)["head"]
    estimator.update(0.0, {"head": pose})
    jumped = make_pose(pose[:3] + [5.0, 0, 0], quat_multiply(quat_from_yaw(2.0), pose[3:]))
    velocity = estimator.update(0.04, {"head": jumped})["head"]
    assert np.linalg.norm(velocity[:3]) <= 2.0
    assert np.linalg.norm(velocity[3:]) <= 4.0
    for i in range(2, 27):
        velocity = estimator.update(0.04 * i, {"head": jumped})["head"]
    assert np.linalg.norm(velocity) < 1e-3


def test_velocity_settings_are_checked() -> None:
    with pytest.raises(BadValue, match=r"goal_velocity\.time_constant must be finite and above 0"):
        GoalVelocityConfig(time_constant=0.0)
