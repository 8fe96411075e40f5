"""The stage: a plant with a task's furniture, its episodes, and how LeRobot's robot runs it."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from toy_robot import make_teleop, make_toy, observe

from lerobot_robot_xop import XopG1Config, XopRby1, XopRby1Config
from lerobot_teleoperator_xop import Xop, XopConfig
from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import UnknownName
from xop_lerobot.core.state import Goal
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.operator.display import View
from xop_lerobot.plant.config import SimulationConfig
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.factory import make_retargeter
from xop_lerobot.retarget.obstacles import Obstacle
from xop_lerobot.retarget.plan import Retargeter
from xop_lerobot.retarget.plan_follower import BackgroundPlanner
from xop_lerobot.session import Session, TaskStatus, Tick, get_session
from xop_lerobot.tasks.dual_point_touch import TOLERANCE
from xop_lerobot.tasks.furniture import place
from xop_lerobot.tasks.stage import Stage

TASK = "dual_point_touch"


@pytest.fixture(scope="module")
def rby1():
    stage = Stage(make_morphology("rby1"), TASK)
    yield stage
    stage.close()


def reset(stage: Stage, seed: int) -> None:
    stage.plant.reset(seed)
    stage.reset(seed)


def put_points_on_palms(stage: Stage) -> None:
    for side in ("left", "right"):
        palm = stage.plant.get_site_pose(f"{side}_palm")
        place(stage.plant, f"{side}_point", palm[:3], palm[3:])
    stage.plant.rearrange()


def run(stage: Stage, seconds: float) -> None:
    for _ in range(round(seconds / 0.02)):
        stage.plant.step(0.02)
        stage.update()


def get_places(stage: Stage) -> np.ndarray:
    return np.stack([seen.pose for seen in stage.task.objects.values()])


def test_scene_is_the_tasks_own_unless_one_is_asked_for():
    morphology = make_morphology("rby1")
    assert Stage(morphology, TASK).scene == "small_room"
    assert Stage(morphology, TASK, SimulationConfig(scene="")).scene == "small_room"
    assert Stage(morphology, TASK, SimulationConfig(scene="room")).scene == "room"
    assert Stage(make_morphology("g1"), TASK).scene == "empty"


def test_unknown_task():
    with pytest.raises(UnknownName, match=r"unknown task 'dance'\. Known: .*dual_point_touch"):
        Stage(make_morphology("g1"), "dance")


def test_same_seed_same_places(rby1):
    places = []
    for seed in (4, 5, 4):
        reset(rby1, seed)
        places.append(get_places(rby1))
    assert np.array_equal(places[0], places[2])
    assert not np.allclose(places[0], places[1])


def test_placement_does_not_hang_on_the_plants_own_draws(rby1):
    reset(rby1, 4)
    first = get_places(rby1)
    rby1.plant.reset(99)
    rby1.reset(4)
    assert np.array_equal(get_places(rby1), first)


def test_view_shows_palms_head_and_objects(rby1):
    loop = PolicyLoop(rby1.morphology, rby1.plant, make_policy("diff_drive"))
    loop.reset(0)
    rby1.reset(0)
    view = rby1.view(loop.state)
    assert set(view.frames) == {"head", "left_wrist", "right_wrist", "left_palm", "right_palm"}
    assert set(view.objects) == {"left_point", "right_point"}
    assert view.time == loop.state.time
    assert view.task == TASK
    assert np.allclose(view.frames["head"], rby1.plant.get_site_pose("head"))


def test_success_then_one_second_more(rby1):
    reset(rby1, 0)
    put_points_on_palms(rby1)
    run(rby1, 2.9)
    assert not rby1.status.success
    run(rby1, 0.2)
    assert rby1.status.success
    assert not rby1.status.done
    run(rby1, 1.0)
    assert rby1.status.done


def test_success_stays_after_it_was_reached(rby1):
    reset(rby1, 0)
    put_points_on_palms(rby1)
    run(rby1, 3.1)
    place(rby1.plant, "left_point", np.zeros(3), np.array([1.0, 0, 0, 0]))
    run(rby1, 0.1)
    assert rby1.status.success


def test_a_break_starts_the_three_seconds_anew(rby1):
    reset(rby1, 0)
    put_points_on_palms(rby1)
    run(rby1, 2.0)
    palm = rby1.plant.get_site_pose("left_palm")
    place(rby1.plant, "left_point", palm[:3] + [0, 0, TOLERANCE + 0.005], palm[3:])
    run(rby1, 0.04)
    put_points_on_palms(rby1)
    run(rby1, 2.0)
    assert not rby1.status.success
    run(rby1, 1.1)
    assert rby1.status.success


def test_over_when_time_is_up(rby1, monkeypatch):
    monkeypatch.setattr(rby1, "time_limit", 0.5)
    reset(rby1, 0)
    run(rby1, 0.46)
    assert not rby1.status.done
    run(rby1, 0.06)
    assert rby1.status.done
    assert not rby1.status.success


def test_a_fall_loses():
    stage = Stage(make_morphology("g1"), TASK)
    reset(stage, 0)
    lying = stage.morphology.standing_qpos()
    lying[2] = 0.2
    stage.plant.set_state(lying)
    status = stage.update()
    assert (status.done, status.success, status.failure) == (True, False, "the robot fell")


def test_walls_that_are_touched_are_collisions(rby1):
    reset(rby1, 0)
    qpos = rby1.morphology.standing_qpos()
    qpos[0] = 2.0
    rby1.plant.set_state(qpos)
    run(rby1, 0.02)
    assert ("base", "wall_front") in rby1.status.collisions
    reset(rby1, 0)
    assert rby1.status.collisions == ()


def test_obstacles_are_the_walls(rby1):
    names = {obstacle.name for obstacle in rby1.obstacles}
    assert names == {"wall_front", "wall_back", "wall_left", "wall_right"}


def test_hands_work_at_the_furniture_of_their_task_alone():
    morphology = make_morphology("rby1")
    stage = Stage(morphology, "box_pick_and_place")
    handled = {obstacle.name for obstacle in stage.obstacles if obstacle.handled}
    stage.close()
    assert handled == {"support_column", "table_column"}
    stage = Stage(morphology, "non_prehensile_transport")
    free = {obstacle.name for obstacle in stage.obstacles if not obstacle.handled}
    stage.close()
    assert free == {f"wall_{side}" for side in ("front", "back", "left", "right")}


def test_task_camera_shows_something(rby1):
    picture = rby1.plant.render("task")
    assert picture.std() > 5


# What the planner keeps clear of


def make_obstacle(name: str, x: float) -> Obstacle:
    return Obstacle(name, np.array([x, 0, 0.5]), np.array([1.0, 0, 0, 0]), np.full(3, 0.2))


def test_mpc_takes_other_obstacles():
    morphology = make_morphology("rby1")
    model = build_model(morphology, "planning")
    retargeter = make_retargeter(
        RetargeterConfig(), morphology, make_policy("diff_drive"), model, ()
    )
    stage = Stage(morphology, TASK)
    loop = PolicyLoop(morphology, stage.plant, make_policy("diff_drive"))
    loop.reset(0)
    goal = Goal({"head": stage.plant.get_site_pose("head")}, mode=Mode.MOBILE)
    retargeter.reset(loop.state)
    assert retargeter.plan(loop.state, goal).cost["collision"] == 0
    retargeter.set_obstacles((make_obstacle("post", 0.65),))
    assert retargeter.plan(loop.state, goal).cost["collision"] > 0
    retargeter.set_obstacles(())
    assert retargeter.plan(loop.state, goal).cost["collision"] == 0
    retargeter.close()


class Listening(Retargeter):
    """Takes down in which thread it was told what."""

    def __init__(self) -> None:
        self.heard = []

    def reset(self, state) -> None:
        pass

    def plan(self, state, goal):
        self.heard.append("plan")
        raise RuntimeError("enough")

    def control_period(self, mode) -> float:
        return 0.02

    def set_obstacles(self, obstacles) -> None:
        self.heard.append((threading.current_thread().name, obstacles))


def test_background_planner_hands_obstacles_over_between_solves():
    retargeter = Listening()
    planner = BackgroundPlanner(retargeter, threaded=False)
    obstacles = (make_obstacle("post", 1.0),)
    planner.set_obstacles(obstacles)
    assert retargeter.heard == []
    toy = make_toy("stage_background")
    toy.connect()
    planner.submit(observe(toy), Goal({}), 0)
    planner.run_once()
    assert retargeter.heard == [("MainThread", obstacles), "plan"]
    toy.disconnect()


# The robot of LeRobot


def test_robot_without_a_task_publishes_no_outcome():
    robot = make_toy("stage_none")
    robot.connect()
    robot.get_observation()
    session = get_session("stage_none")
    tick = get_tick(session)
    assert tick.view is None
    assert tick.outcome is None
    assert session.obstacles is None
    robot.disconnect()


def get_tick(session: Session) -> Tick:
    assert session.tick is not None
    return session.tick


def see(session: Session) -> View:
    view = get_tick(session).view
    assert view is not None
    return view


def test_robot_publishes_view_outcome_and_obstacles():
    robot, teleop = make_toy("stage_toy", task=TASK), make_teleop("stage_toy")
    robot.connect()
    teleop.connect()
    session = get_session("stage_toy")
    robot.get_observation()
    assert see(session).task == TASK
    first = see(session).objects["left_point"].pose
    robot.send_action(teleop.get_action())
    outcome = get_tick(session).outcome
    assert isinstance(outcome, TaskStatus)
    assert outcome.done is False
    assert outcome.figures["left_palm_distance"] > TOLERANCE
    assert session.obstacles == ()
    session.begin_episode(1)
    robot.get_observation()
    assert not np.allclose(see(session).objects["left_point"].pose, first)
    session.begin_episode(0)
    robot.get_observation()
    assert np.array_equal(see(session).objects["left_point"].pose, first)
    teleop.disconnect()
    robot.disconnect()


def test_robot_config_takes_the_tasks_scene():
    assert XopRby1Config(task=TASK).scene == "small_room"
    assert XopG1Config(task=TASK).scene == "empty"
    assert XopRby1Config().scene == "empty"
    with pytest.raises(UnknownName, match=r"unknown task 'dance'\. Known: "):
        XopG1Config(task="dance")


def test_teleoperator_learns_of_obstacles(monkeypatch):
    robot = XopRby1(XopRby1Config(session="stage_rby1", task=TASK, cameras=[]))
    teleop = Xop(XopConfig(session="stage_rby1"))
    robot.connect()
    teleop.connect()
    robot.get_observation()
    teleop.get_action()
    teleoperation = teleop._teleoperation
    assert teleoperation is not None
    told: list[tuple[Obstacle, ...]] = []
    monkeypatch.setattr(teleoperation.retargeter, "set_obstacles", told.append)
    get_session("stage_rby1").begin_episode(1)
    robot.get_observation()
    teleop.get_action()
    assert [each.name for each in told[0]] == [
        "wall_front", "wall_back", "wall_left", "wall_right",
    ]  # fmt: skip
    teleop.disconnect()
    robot.disconnect()
