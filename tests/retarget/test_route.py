"""The way of a base on wheels to a goal: it arrives, within its limits, and goes on as planned."""

from __future__ import annotations

import math

import numpy as np
import pytest

from xop_lerobot.core.command import Mode
from xop_lerobot.core.state import Goal
from xop_lerobot.core.transforms import (
    make_pose,
    pose_multiply,
    quat_from_rpy,
    quat_from_yaw,
    quat_yaw,
)
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.retarget.guidance.guidance import Guidance, compute_times, find_waist_axis
from xop_lerobot.retarget.guidance.route import Footprint, RoutePlanner
from xop_lerobot.retarget.model.command_model import PlannerState
from xop_lerobot.retarget.model.kinematics import SiteKinematics
from xop_lerobot.retarget.mpc import MpcRetargeter
from xop_lerobot.retarget.obstacles import Obstacle

RESTING = 0.03  # how far the head is ahead of the base [m]
LEAN = 0.1  # what is left to the torso [m]


@pytest.fixture(scope="module")
def rby1():
    return make_morphology("rby1")


@pytest.fixture(scope="module")
def planner(rby1):
    return RoutePlanner(rby1, {"head": RESTING, "left_wrist": 0.3})


def place(rby1, x=0.0, y=0.0, yaw=0.0):
    """Configuration, and pose of the resting head, of a base somewhere."""
    world = make_pose(np.array([x, y, 0]), quat_from_yaw(yaw))
    qpos = rby1.standing_qpos()
    qpos[:7] = pose_multiply(world, qpos[:7])
    return qpos, pose_multiply(world, make_pose(np.array([RESTING, 0, 1.4]), quat_from_yaw(0)))


def go(planner, rby1, goal, speeds=(0.0, 0.0), duration=8.0, **start):
    qpos, head = place(rby1, **start)
    return planner.plan(qpos, speeds, "head", head, goal, duration)


def make_goal(x, y, yaw=0.0):
    return make_pose(np.array([x + RESTING, y, 1.4]), quat_from_yaw(yaw))


@pytest.mark.parametrize(
    "x, y, yaw",
    [(2, 0, 0), (0.8, 0.3, 0.4), (0, 1, 0), (0, -1, 0), (-0.6, 0, 0), (-1, -1, 2.5), (1, 1, -1.5)],
)
def test_it_arrives_and_stays(planner, rby1, x, y, yaw):
    route = go(planner, rby1, make_goal(x, y, yaw))
    far = np.hypot(*route.offsets.T)
    arrived = route.times[np.argmax(far == 0)]
    assert far[0] == pytest.approx(math.hypot(x, y) - LEAN)
    assert 0 < arrived < 2 + 2 * math.hypot(x, y)
    assert not far[route.times > arrived + 2].any()
    # The waist can turn to where the goal looks.
    assert abs(math.remainder(route.headings[-1] - yaw, math.tau)) < 1.95
    assert abs(route.headings[-1] - route.headings[-25]) < 0.02


def test_forwards_backwards_and_in_place(planner, rby1):
    """Straight ways need no turn, and what the torso reaches needs no way."""
    assert not go(planner, rby1, make_goal(2, 0)).headings.any()
    assert not go(planner, rby1, make_goal(-1, 0)).headings.any()
    still = go(planner, rby1, make_goal(0.05, 0.05))
    assert not still.offsets.any()
    assert still.share == 0
    assert np.abs(still.headings).max() < 0.01


def test_the_limits_of_a_tall_robot_hold(planner, rby1):
    """Speed, yaw rate, their changes, and their product: the acceleration across the heading."""
    for x, y in ((2, 0.5), (0, 1.5), (-1, 1), (1.5, -1.5)):
        route = go(planner, rby1, make_goal(x, y), duration=6.0)
        step = np.diff(route.times)[0]
        turn = np.diff(route.headings) / step
        assert np.abs(turn).max() < 1.41
        assert np.abs(np.diff(turn)).max() < 3.01 * step


def test_a_way_computed_anew_goes_on_as_before(planner, rby1):
    """From a state on the way the rest of the way is the same: nothing flickers."""
    goal = make_goal(0.5, 1.2, 0.3)
    whole = go(planner, rby1, goal, duration=4.0)
    # Drive the law by hand for half a second, with the planner's own step.
    x, y, yaw, v, w = rby1.pivot, 0.0, 0.0, 0.0, 0.0
    from xop_lerobot.retarget.guidance.route import _Aim, _clamp, _steer

    aim = _Aim(goal[0], goal[1], 0.3, 1.9, (-rby1.pivot, 0.0), RESTING, rby1.driving)
    for _ in range(12):
        wanted = _steer(aim, x, y, yaw)
        v += _clamp(wanted[0] - v, 1.5 * 0.04)
        w += _clamp(wanted[1] - w, 3.0 * 0.04)
        middle = yaw + w * 0.02
        x, y, yaw = x + v * 0.04 * math.cos(middle), y + v * 0.04 * math.sin(middle), yaw + w * 0.04
    base = (x - rby1.pivot * math.cos(yaw), y - rby1.pivot * math.sin(yaw))
    qpos, head = place(rby1, x=base[0], y=base[1], yaw=yaw)
    head[3:] = quat_from_yaw(0.3 + float(whole.turns[12]))  # the waist has turned meanwhile
    rest = planner.plan(qpos, (v, w), "head", head, goal, 3.0)
    np.testing.assert_allclose(
        rest.headings, whole.headings[12 : 12 + len(rest.headings)], atol=1e-9
    )
    np.testing.assert_allclose(rest.offsets, whole.offsets[12 : 12 + len(rest.offsets)], atol=1e-9)


def test_a_head_is_at_its_goal_however_its_waist_is_turned(rby1):
    """Against MuJoCo: it sits ahead of the axis that it goes round."""
    model, rng = build_model(rby1, "planning"), np.random.default_rng(0)
    kinematics = SiteKinematics(model, (rby1.frames["head"],))
    standing = rby1.standing_qpos()
    ahead = float(kinematics.compute_poses(standing)["head"][0])
    axis = find_waist_axis(rby1, model)
    from xop_lerobot.retarget.guidance.route import _Aim

    for _ in range(20):
        x, y, heading, look = rng.uniform(-1, 1), rng.uniform(-1, 1), *rng.uniform(-1.5, 1.5, 2)
        aim = _Aim(0.3, -0.7, look, 1.9, (axis - rby1.pivot, 0.0), ahead - axis, rby1.driving)
        across, along = aim.find_path(x, y, heading)
        base = np.array([x + across, y + along]) - rby1.pivot * np.array(
            [math.cos(heading), math.sin(heading)]
        )
        qpos = standing.copy()
        qpos[:2], qpos[3:7] = base, quat_from_yaw(heading)
        qpos[model.joint("torso_5").qposadr[0]] = look - heading
        head = kinematics.compute_poses(qpos)["head"]
        np.testing.assert_allclose(head[:2], [0.3, -0.7], atol=1e-6)


def test_where_the_world_lies_does_not_matter(planner, rby1):
    route = go(planner, rby1, make_goal(0.4, 1.0, 0.5))
    world = make_pose(np.array([3, -2, 0]), quat_from_yaw(2.0))
    goal = pose_multiply(world, make_goal(0.4, 1.0, 0.5))
    turned = go(planner, rby1, goal, x=3, y=-2, yaw=2.0)
    np.testing.assert_allclose(turned.headings - 2.0, route.headings, atol=1e-9)
    assert np.hypot(*turned.offsets.T) == pytest.approx(np.hypot(*route.offsets.T))


def test_a_hand_has_the_base_arrive_as_it_faces(planner, rby1):
    """A wrist looks nowhere: after the way the base faces as before."""
    qpos, _ = place(rby1)
    hand = make_pose(np.array([0.5, 0.3, 1.0]), quat_from_yaw(1.0))
    goal = make_pose(np.array([0.5, 1.3, 1.0]), quat_from_yaw(-1.0))
    route = planner.plan(qpos, (0.0, 0.0), "left_wrist", hand, goal, 12.0)
    assert not route.offsets[-25:].any()
    assert abs(route.headings[-1]) < 0.3


def test_offsets_and_facing_at_a_time(planner, rby1):
    route = go(planner, rby1, make_goal(0, 1))
    np.testing.assert_allclose(route.offsets_at(np.array([0.0, 99.0]))[0], [0, -0.9], atol=0.01)
    np.testing.assert_allclose(route.offsets_at(np.array([0.0, 99.0]))[1], 0)
    x, y = route.facing_at(1.0)
    assert math.hypot(x, y) == pytest.approx(1)
    assert abs(math.atan2(y, x)) > 0.5


def make_retargeter(bench_robot):
    from xop_lerobot.low_level.factory import make_policy

    policy = make_policy(bench_robot.policies[0], None)
    return MpcRetargeter(bench_robot, policy, build_model(bench_robot, "planning"))


def make_planner_state(retargeter: MpcRetargeter, qpos, poses) -> PlannerState:
    """At rest under the neutral command."""
    none = np.zeros(len(retargeter.space))
    neutral = retargeter.space.neutral
    return PlannerState(qpos, neutral, np.zeros(3), none, neutral, poses, time=0.0)


@pytest.mark.parametrize("name, led", [("rby1", True), ("g1", False)])
def test_who_is_led_along_a_way(name, led):
    """Wheels in mobile mode, to goals that stand; legs and moving goals keep theirs in reach."""
    robot = make_morphology(name)
    retargeter = make_retargeter(robot)
    guidance: Guidance = retargeter.references.guidance
    qpos = robot.standing_qpos()
    head = retargeter.problem.readings.compute_poses(qpos, retargeter.references.sites)["head"]
    target = head + [0, 1, 0, 0, 0, 0, 0]
    config = retargeter.configs[Mode.MOBILE]

    def lead(goal):
        return guidance.lead(make_planner_state(retargeter, qpos, {"head": head}), goal, config)

    goals, facing = lead(Goal({"head": target}, mode=Mode.MOBILE))
    assert goals["head"].shape == (len(compute_times(config)), 7)
    # A way begins where the head is, less what the torso reaches.
    assert (goals["head"][0, 1] - head[1] < LEAN + 0.01) == led
    assert bool(facing.any()) == led
    moving, _ = lead(Goal({"head": target}, {"head": np.array([0.5, 0, 0, 0, 0, 0])}, Mode.MOBILE))
    assert moving["head"][0, 1] - head[1] == pytest.approx(config.reach, abs=0.01)
    standing, facing = lead(Goal({"head": target}, mode=Mode.STATIONARY))
    assert not facing.any()
    assert quat_yaw(standing["head"][0, 3:]) == pytest.approx(quat_yaw(head[3:]))
    retargeter.close()


def test_a_base_that_may_not_be_moved_has_no_way():
    """Where an arm alone is free (variant V2), the goal stays the goal."""
    robot = make_morphology("rby1")
    retargeter = make_retargeter(robot)
    retargeter.configure(targets=("left_wrist",), body=robot.variants["v2"].body)
    qpos = robot.standing_qpos()
    hand = retargeter.problem.readings.compute_poses(qpos, retargeter.references.sites)[
        "left_wrist"
    ]
    target = hand + [0, 0.3, 0, 0, 0, 0, 0]
    goals, facing = retargeter.references.guidance.lead(
        make_planner_state(retargeter, qpos, {"left_wrist": hand}),
        Goal({"left_wrist": target}, mode=Mode.MOBILE),
        retargeter.configs[Mode.MOBILE],
    )
    np.testing.assert_allclose(goals["left_wrist"][:, 1], target[1])
    assert not facing.any()
    retargeter.close()


def make_wall(x, half_thickness=0.05, name="wall"):
    """A wall across X, endless in Y."""
    return Obstacle(
        name, np.array([x, 0, 1.0]), np.array([1.0, 0, 0, 0]), np.array([half_thickness, 9, 1])
    )


def test_the_footprint_is_that_of_the_hull(rby1):
    """Against the robot's own sites, turned and moved by MuJoCo."""
    model = build_model(rby1, "planning")
    obstacles = (make_wall(1.0), make_wall(-2.0))
    footprint = Footprint(rby1, model, obstacles)
    hull = {name: radius for name, radius in rby1.hull_points.items() if name.startswith("hull_")}
    kinematics = SiteKinematics(model, tuple(hull))
    for x, y, yaw in ((0, 0, 0), (0.3, -0.5, 1.0), (-1.2, 2.0, -2.5)):
        qpos, _ = place(rby1, x, y, yaw)
        sites = kinematics.compute_poses(qpos)
        expected = min(
            float(obstacle.compute_distance(sites[name][:3])) - radius
            for obstacle in obstacles
            for name, radius in hull.items()
        )
        axle = np.array([[x + rby1.pivot * math.cos(yaw), y + rby1.pivot * math.sin(yaw)]])
        clearance = footprint.compute_clearance(axle, np.array([yaw]))
        assert clearance == pytest.approx(expected, abs=1e-9)
    footprint.set_obstacles(())
    assert np.isinf(footprint.compute_clearance(axle, np.zeros(1)))


def test_beside_a_wall_it_drives_on_before_it_turns(rby1):
    """Turning on the spot would drive the tail into the wall: where it stands, nothing is free."""
    wall = make_wall(-0.40)  # parallel to a base that faces along Y, 3 cm from its side
    footprint = Footprint(rby1, build_model(rby1, "planning"), (wall,))
    barred = RoutePlanner(rby1, {"head": RESTING}, footprint)
    free = RoutePlanner(rby1, {"head": RESTING})
    start = {"x": 0.0, "y": 0.0, "yaw": math.pi / 2}
    goal = make_goal(3, 0.3)
    first = go(free, rby1, goal, duration=1.6, **start)
    other = go(barred, rby1, goal, duration=1.6, **start)

    def compute_clearance(route):
        cosine, sine = np.cos(route.headings), np.sin(route.headings)
        far = np.hypot(*route.offsets.T)[:, None]
        looks = quat_yaw(goal[3:]) + route.turns
        head = goal[:2] + route.offsets * (1 + LEAN / far)
        waist = head - RESTING * np.stack([np.cos(looks), np.sin(looks)], axis=-1)
        axle = waist + rby1.pivot * np.stack([cosine, sine], axis=-1)
        return footprint.compute_clearance(axle, route.headings)

    assert compute_clearance(first).min() < -0.02
    assert compute_clearance(other).min() > -0.01
    assert abs(other.headings[5] - math.pi / 2) < 0.05  # straight at first
    np.testing.assert_allclose(
        go(barred, rby1, make_goal(3, 0.3), x=2.0).headings,
        go(free, rby1, make_goal(3, 0.3), x=2.0).headings,
    )


def test_a_wall_behind_the_goal_makes_no_detour(rby1):
    """What bars the way ahead, with no turn to come, is left to the barrier."""
    footprint = Footprint(rby1, build_model(rby1, "planning"), (make_wall(1.0),))
    barred = RoutePlanner(rby1, {"head": RESTING}, footprint)
    route = go(barred, rby1, make_goal(1.5, 0), duration=3.0)
    free = go(RoutePlanner(rby1, {"head": RESTING}), rby1, make_goal(1.5, 0), duration=3.0)
    np.testing.assert_allclose(route.offsets, free.offsets)


def test_the_waist_goes_round_by_its_front(rby1, planner):
    """From one limit to beyond the other the head has to turn all the way back."""
    qpos, head = place(rby1)
    head = pose_multiply(head, make_pose(np.array([0, 0, 0]), quat_from_yaw(2.1)))
    goal = make_pose(head[:3], quat_from_yaw(-2.0))  # 2.2 rad on in the barred direction
    route = planner.plan(qpos, (0.0, 0.0), "head", head, goal, 4.0)
    looks = -2.0 + route.turns
    twists = np.unwrap(looks) - route.headings
    twists -= math.tau * np.round(twists[0] / math.tau)
    assert twists[0] == pytest.approx(2.1)
    assert np.abs(twists).max() < 2.21
    assert np.abs(np.diff(twists)).max() < 1.51 * 0.04
    assert route.turns[-1] == pytest.approx(0, abs=1e-9)
    # A turn that is free is not held up: at its speed it is there.
    goal = make_pose(head[:3], quat_from_yaw(1.5))
    route = planner.plan(qpos, (0.0, 0.0), "head", head, goal, 1.0)
    assert not route.turns[11:].any()


def test_a_goal_behind_the_back_is_waited_for(rby1, planner):
    """Beyond both limits the waist stays on its side until the base has turned."""
    qpos, head = place(rby1)
    head = pose_multiply(head, make_pose(np.array([0, 0, 0]), quat_from_yaw(2.2)))
    goal = make_pose(head[:3], quat_from_yaw(-3.0))
    route = planner.plan(qpos, (0.0, 0.0), "head", head, goal, 6.0)
    assert route.share == 1
    assert route.turns[0] == pytest.approx(2.2 - (math.tau - 3.0), abs=1e-6)
    assert route.turns[-1] == pytest.approx(0, abs=1e-9)


def test_the_base_turns_with_a_goal_that_turns(rby1, planner):
    """A waist twisted by 1 rad may stay so at rest; behind a person who turns it may not."""
    qpos, head = place(rby1)
    head = pose_multiply(head, make_pose(np.array([0, 0, 0]), quat_from_yaw(1.0)))
    turned = [
        planner.plan(qpos, (0.0, 0.0), "head", head, head, 2.0, turn_rate=rate).headings[-1]
        for rate in (0.0, 0.25, 0.35, 1.0)
    ]
    assert turned[0] == 0
    assert turned[-1] > 0.3
    assert sorted(turned) == turned


@pytest.mark.parametrize("roll", [-0.4, 0.0, 0.4])
def test_a_goal_that_looks_straight_down_has_a_heading(planner, rby1, roll):
    """It is that of the crown: the base neither turns round nor away from it."""
    qpos, head = place(rby1)
    ends = []
    for pitch in np.linspace(1.2, 1.9, 8):
        goal = make_pose(np.array([2.0 + RESTING, 0, 0.7]), quat_from_rpy(roll, pitch, 0.0))
        pose = make_pose(head[:3], quat_from_rpy(roll, pitch - 0.1, 0.0))
        ends.append(planner.plan(qpos, (0.0, 0.0), "head", pose, goal, 4.0).headings[-1])
    assert np.abs(np.diff(ends)).max() < 0.2
    assert np.abs(ends).max() < 0.9
