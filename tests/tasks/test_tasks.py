"""The tasks: where things are placed, that robots can reach them, and what counts."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from grasp import Grasp
from reachability import find_posture

from xop_lerobot.core.transforms import make_pose, quat_from_rpy
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.tasks import box_pick_and_place as box_task
from xop_lerobot.tasks import dual_point_touch as touch
from xop_lerobot.tasks.furniture import Touching, compute_tilt
from xop_lerobot.tasks.layout import (
    DRAW_IN,
    find_room,
    make_direction,
    measure_draw_in,
    measure_reach,
)
from xop_lerobot.tasks.stage import Stage
from xop_lerobot.tasks.task import Hold

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


def draw_points(
    robot: str, seeds: range, task: str = "dual_point_touch"
) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Left point, right point [m] and the heading that faces them, by seed."""
    stage = Stage(make_morphology(robot), task)
    assert isinstance(stage.task, touch.DualPointTouch)
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


def measure_room(stage: Stage) -> np.ndarray:
    room = find_room(stage.plant.model)
    assert room is not None
    return room


def test_some_points_are_near_a_wall_and_all_inside():
    low, high = measure_room(Stage(make_morphology("rby1"), "dual_point_touch"))
    gaps = []
    for left, right, _ in draw_points("rby1", range(100)):
        points = np.stack([left, right])[:, :2]
        gaps.append(np.minimum(points - low, high - points).min())
    gaps = np.array(gaps)
    assert gaps.min() > touch.NEAR_WALL[0] - 1e-9
    assert 30 < (gaps <= touch.NEAR_WALL[1]).sum() < 70


@pytest.mark.slow
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


# dual-point reach


@pytest.mark.parametrize("robot", ROBOTS)
def test_near_points_are_within_an_arms_length(robot):
    """From the shoulders of a robot that stays where it is; 5 cm beside is touched."""
    morphology = make_morphology(robot)
    model = morphology.build_spec("full").compile()
    data = mujoco.MjData(model)
    data.qpos[:] = morphology.standing_qpos()
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    shoulders = [data.xanchor[model.joint(arm.joints[0]).id] for arm in morphology.arms]
    reach = measure_reach(morphology)
    for left, right, _ in draw_points(robot, range(60), "dual_point_reach"):
        for shoulder, point in zip(shoulders, (left, right), strict=True):
            assert np.linalg.norm(point - shoulder) < reach.arm + 0.05


@pytest.mark.parametrize("robot", ROBOTS)
def test_near_points_are_in_the_head_cameras_picture(robot):
    """Their middles are, at the start: who sees them need not look about."""
    stage = Stage(make_morphology(robot), "dual_point_reach")
    model, data = stage.plant.model, stage.plant.data
    camera = model.camera("head").id
    edge = np.tan(np.radians(model.cam_fovy[camera]) / 2) * np.array([4 / 3, 1])
    for seed in range(60):
        stage.reset(seed)
        for point in ("left_point", "right_point"):
            offset = stage.task.objects[point].pose[:3] - data.cam_xpos[camera]
            right, up, back = data.cam_xmat[camera].reshape(3, 3).T @ offset
            assert (np.abs([right, up]) < -back * edge).all(), seed


# box pick-and-place


def make_box_stage(robot: str, seed: int = 0) -> Stage:
    stage = Stage(make_morphology(robot), "box_pick_and_place")
    stage.plant.reset(seed)
    stage.reset(seed)
    return stage


def put_box(stage: Stage, position: np.ndarray, tilt: float = 0.0) -> None:
    pose = make_pose(position, quat_from_rpy(tilt, 0, 0))
    stage.plant.set_object_pose("box", pose)


def run(stage: Stage, seconds: float) -> None:
    for _ in range(round(seconds / 0.02)):
        stage.plant.step(0.02)
        stage.update()


@pytest.mark.parametrize("robot", ROBOTS)
def test_furniture_stands_free_of_the_robot_and_of_each_other(robot):
    stage = make_box_stage(robot)
    for seed in range(30):
        stage.plant.reset(seed)
        stage.reset(seed)
        assert stage.plant.measure().contacts == ()
        columns = [stage.plant.model.geom(f"{name}_top").id for name in ("support", "table")]
        gap = mujoco.mj_geomDistance(stage.plant.model, stage.plant.data, *columns, 3.0, None)
        assert gap > 0.2
        seen = stage.task.objects
        distance = np.linalg.norm(seen["spot"].pose[:2])
        assert box_task.TABLE_DISTANCE[0] <= distance <= box_task.TABLE_DISTANCE[1]
        # The spot is marked where a box fits onto the top.
        assert abs(seen["spot"].pose[2] - seen["table"].pose[2] - box_task.TOP) < 1e-9


@pytest.mark.parametrize("robot", ROBOTS)
def test_box_rests_on_its_support_and_stays_there(robot):
    stage = make_box_stage(robot)
    before = stage.plant.get_object_pose("box")
    touching = Touching(stage.plant, "box")
    run(stage, 0.4)  # without a policy, a biped falls soon after
    assert touching.find() == {"support"}
    assert np.linalg.norm(stage.plant.get_object_pose("box") - before) < 0.003
    assert not stage.status.picked_up


def test_furniture_is_in_the_room_with_space_for_the_robot():
    stage = make_box_stage("rby1")
    low, high = measure_room(stage)
    for seed in range(50):
        stage.reset(seed)
        for name in ("table", "support"):
            seen = stage.task.objects[name]
            reach = np.linalg.norm(seen.size[:2])
            assert (seen.pose[:2] - reach > low).all()
            assert (seen.pose[:2] + reach < high).all()


def test_planner_is_told_of_columns_not_of_tops():
    names = {obstacle.name for obstacle in make_box_stage("rby1").obstacles}
    assert names >= {"support_column", "table_column", "wall_front"}
    assert not names & {"support_top", "table_top", "box"}


def test_box_on_the_floor_is_lost():
    stage = make_box_stage("g1")
    put_box(stage, np.array([2.0, 0, box_task.BOX[2]]))
    run(stage, 0.1)
    assert stage.status.failure == "the box was dropped"
    assert stage.status.done
    assert not stage.status.success


def test_box_on_the_table_counts_only_after_it_was_picked_up():
    stage = make_box_stage("g1")
    spot = stage.task.objects["spot"].pose[:3] + [0, 0, box_task.BOX[2]]
    put_box(stage, spot)
    run(stage, 1.5)
    assert not stage.status.success
    assert isinstance(stage.task, box_task.BoxPickAndPlace)
    stage.task._picked_up = True
    run(stage, 0.9)
    assert not stage.status.success
    run(stage, 0.3)
    assert stage.status.success


def test_box_that_floats_is_not_picked_up():
    """Held up by nobody: only the robot may bear it."""
    stage = make_box_stage("g1")
    stage.plant.model.opt.gravity[:] = 0
    put_box(stage, np.array([0.6, 0, 1.4]))
    run(stage, 3.5)
    assert not stage.status.picked_up
    assert stage.status.figures["lift_m"] > 0.3


def test_hands_may_touch_the_table_and_other_parts_may_not():
    stage = make_box_stage("rby1")
    stage.plant.take_touches = lambda: {
        ("ee_left", "table"), ("ee_finger_r1", "support"), ("link_left_arm_3", "table"),
        ("left_hand", "floor"), ("ee_left", "box"), ("ee_left", "wall_left"),
    }  # fmt: skip
    stage.update()
    assert set(stage.status.collisions) == {("link_left_arm_3", "table"), ("ee_left", "wall_left")}


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS)
def test_robot_squeezes_lifts_and_holds_the_box(robot):
    """By arm kinematics alone, through policy and physics: five seconds without slipping."""
    grasp = Grasp(robot)
    log = grasp.take(hold_s=6.0)  # held hands follow their goals up to a second late
    held = slice(-250, None)
    assert grasp.stage.status.picked_up
    assert all(touched == {"robot"} for touched in log.touched[held])
    boxes = np.stack(log.box[held])
    assert (boxes[:, 2] - grasp.middle[2]).min() > box_task.LIFT
    assert max(compute_tilt(box[3:]) for box in boxes) < np.radians(20)
    assert np.median(log.speed[held]) < 0.02
    assert grasp.stage.status.collisions == ()
    assert not grasp.loop.state.fallen
    # Hands do not sink into it.
    contact = grasp.stage.plant.data.contact
    assert contact.dist.min() > -0.015


def test_hands_that_do_not_press_lift_nothing():
    grasp = Grasp("rby1", press=-0.02)
    grasp.take(hold_s=1.0)
    assert not grasp.stage.status.picked_up
    assert grasp.stage.status.figures["lift_m"] < 0.005


def test_how_far_hands_can_be_drawn_in():
    """G1's elbows rest as bent as they may be (`arm_limits`); RB-Y1's do not."""
    assert measure_draw_in(make_morphology("g1")) == 0
    assert measure_draw_in(make_morphology("rby1")) == pytest.approx(DRAW_IN)
