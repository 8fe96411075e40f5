"""Heights that are asked for: places follow them, all else stays, and mistakes are named."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from reachability import find_posture

from lerobot_robot_xop import XopG1Config
from lerobot_robot_xop.xop_robot import XopG1
from xop_lerobot.collect.config import CollectConfig
from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.evaluation.cli import main
from xop_lerobot.evaluation.study import compute_key
from xop_lerobot.evaluation.trial import TrialSetup
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.tasks.dual_point_touch import DualPointTouch
from xop_lerobot.tasks.heights import parse_heights
from xop_lerobot.tasks.layout import make_direction
from xop_lerobot.tasks.stage import Stage

ROBOTS = ("g1", "rby1")
TOUCH, BOX = "dual_point_touch", "box_pick_and_place"

USUAL = {
    ("g1", TOUCH): {
        "left_point": (-0.9861896832565744, 0.6405454489036277, 1.1159353314764937),
        "right_point": (-0.9255075263994252, 0.946239985863512, 1.0238354281574011),
    },
    ("rby1", TOUCH): {
        "left_point": (1.2693493938616403, 0.6420950201481626, 0.6084418223976134),
        "right_point": (1.5051632541781435, 0.3991013928571463, 0.7683431854833249),
    },
    ("g1", BOX): {
        "box": (0.6442371921013325, 0.15345794904668156, 0.850758747428785),
        "spot": (0.22580581687363943, 1.0842999080614633, 0.7069113027819337),
    },
    ("rby1", BOX): {
        "box": (0.8522095488438757, 0.20299717421934987, 0.9541311465083381),
        "spot": (0.22580581687363943, 1.0842999080614633, 0.8102837018614868),
    },
}
"""Where things are with seed 0 since these tasks are there [m]: published tables stand on it."""


def get_places(stage: Stage, seed: int) -> dict[str, np.ndarray]:
    stage.reset(seed)
    return {name: seen.pose.copy() for name, seen in stage.task.objects.items()}


@pytest.mark.parametrize(("robot", "task"), USUAL)
def test_usual_places_are_those_of_published_tables(robot, task):
    places = get_places(Stage(make_morphology(robot), task), 0)
    for name, position in USUAL[robot, task].items():
        assert places[name][:3] == pytest.approx(position, abs=1e-9)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_support_that_is_asked_for_moves_nothing_else(robot):
    morphology = make_morphology(robot)
    usual, low = Stage(morphology, BOX), Stage(morphology, BOX, heights="support=0.35")
    for seed in range(5):
        before, after = get_places(usual, seed), get_places(low, seed)
        assert after["box"][2] == pytest.approx(0.45)
        for name, pose in before.items():
            same = slice(None) if name in ("table", "spot") else [0, 1, 3, 4, 5, 6]
            assert np.array_equal(after[name][same], pose[same])


def test_tops_are_drawn_from_the_range_that_is_asked_for():
    stage = Stage(make_morphology("g1"), BOX, heights="support=0.4:0.5,table=0.6")
    tops = []
    for seed in range(30):
        places = get_places(stage, seed)
        tops.append(places["box"][2] - 0.1)
        assert places["spot"][2] == pytest.approx(0.6)
    assert 0.4 <= min(tops) < 0.42 and 0.48 < max(tops) <= 0.5


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize(("low", "high"), [(0.3, 0.5), (0.3, 0.34), (0.3, 0.3)])
def test_both_points_are_within_the_range(robot, low, high):
    heights = f"points={low}:{high}"
    usual = Stage(make_morphology(robot), TOUCH)
    stage = Stage(make_morphology(robot), TOUCH, heights=heights)
    drawn = []
    for seed in range(30):
        before, after = get_places(usual, seed), get_places(stage, seed)
        for name, pose in before.items():
            assert np.array_equal(after[name][[0, 1, 3, 6]], pose[[0, 1, 3, 6]])
        drawn += [pose[2] for pose in after.values()]
    assert low - 1e-9 <= min(drawn) < low + 0.2 * (high - low) + 1e-9
    assert high - 0.2 * (high - low) - 1e-9 < max(drawn) <= high + 1e-9


@pytest.mark.parametrize("robot", ROBOTS)
def test_every_height_that_may_be_asked_for_is_in_reach(robot):
    morphology = make_morphology(robot)
    task = Stage(morphology, TOUCH).task
    assert isinstance(task, DualPointTouch)
    for height in task.height_limits["points"]:
        middle = task.reach.forward * make_direction(0.0) + [0, 0, height]
        points = {"left_palm": middle + [0, 0.18, 0], "right_palm": middle - [0, 0.18, 0]}
        assert find_posture(morphology, points, np.zeros(3), 0.0)[0] < 0.01


def test_heights_are_read():
    assert parse_heights("") == {}
    assert parse_heights(" support = 0.35 , table=0.6:0.7 ") == {
        "support": (0.35, 0.35), "table": (0.6, 0.7)
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("heights", "fault"),
    [
        ("support", "heights must be NAME=HEIGHT or NAME=LOW:HIGH [m], comma-separated, got "
         "'support'"),
        ("support=low", "heights must be NAME=HEIGHT or NAME=LOW:HIGH [m], comma-separated, "
         "got 'support=low'"),
        ("support=nan", "heights must be NAME=HEIGHT or NAME=LOW:HIGH [m], comma-separated, "
         "got 'support=nan'"),
        ("support=0.5:0.4", "heights of 'support' must go from low to high, got 0.5:0.4"),
        ("table=0.5,table=0.5", "heights give 'table' twice"),
        ("shelf=0.5", "unknown height of box_pick_and_place 'shelf'. Known: support, table"),
        ("support=0.1", "height of the support in box_pick_and_place must be within 0.3 to 1.1 m, "
         "where g1 can work, got 0.1"),
        ("table=0.35:2", "height of the table in box_pick_and_place must be within 0.3 to 1.1 m, "
         "where g1 can work, got 0.35:2"),
    ],
)  # fmt: skip
def test_mistakes_are_named(heights, fault, capsys):
    command = [*("--robot", "g1", "--task", BOX, "--no-run"), f"--heights={heights}"]
    assert main(command) == 2
    assert capsys.readouterr().err == f"error: {fault}\n"
    with pytest.raises((BadValue, UnknownName)) as error:
        XopG1(XopG1Config(task=BOX, task_heights=heights))
    assert str(error.value) == fault
    with pytest.raises((BadValue, UnknownName)) as error:
        CollectConfig("g1", BOX, heights=heights).check()
    assert str(error.value) == fault


def test_tasks_without_heights_say_so():
    for task in ("dual_point_reach", "non_prehensile_transport"):
        with pytest.raises(UnknownName, match=rf"height of {task} 'points'\. Known: \(none\)"):
            Stage(make_morphology("rby1"), task, heights="points=0.5")


def test_heights_without_a_task_are_none():
    fault = r"robot\.task_heights=points=0\.4 needs a task\. Pass --robot\.task"
    with pytest.raises(BadValue, match=fault):
        XopG1Config(task_heights="points=0.4")
    assert XopG1Config(task_heights="none").task_heights == ""


def test_trials_and_collections_of_before_are_known_again():
    setup = TrialSetup("g1", BOX).resolved
    low = dataclasses.replace(setup, heights="support=0.35")
    assert compute_key(setup, 0) == "g1-box_pick_and_place-mpc-default-0-0384f8ce89"
    assert compute_key(low, 0) != compute_key(setup, 0)
    config = CollectConfig("g1", BOX)
    assert "heights" not in config.to_settings()
    assert dataclasses.replace(config, heights="table=0.5").to_settings()["heights"] == "table=0.5"
