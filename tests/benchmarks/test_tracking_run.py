"""The tracking benchmark in closed loop: its device, its file, its tables and its script."""

import dataclasses
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from benchmarks import run_tracking as script
from benchmarks import tracking
from benchmarks.tracking import (
    GoalDevice,
    WorldAlignment,
    get_scenario,
    make_loaded_model,
    run_scenario,
    run_trial,
)
from benchmarks.tracking_documents import ASKED, ROBOTS, make_blocks, write_documents
from benchmarks.tracking_report import (
    Results,
    compute_median_and_worst,
    describe_run,
    fill_document,
    format_number,
    make_ablation_table,
    make_scenario_table,
    read_runs,
)
from benchmarks.tracking_scenarios import (
    SCENARIO_GROUPS,
    SCENARIOS,
    GoalStep,
    GoalTrack,
    Scenario,
    Tolerance,
)
from benchmarks.tracking_setup import ABLATIONS, TrackingSetup, resolve_configs
from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.transforms import make_pose, pose_inverse, pose_multiply, quat_from_yaw
from xop_lerobot.evaluation.bench import LEAD_IN_S, move_from
from xop_lerobot.evaluation.bench_report import make_table
from xop_lerobot.morphology.morphology import make_morphology

ROOT = Path(__file__).resolve().parents[2]
HOME = make_pose(np.array([0.0, 0, 1.25]), np.array([1.0, 0, 0, 0]))
SMALL = {"num_samples": 4, "horizon": 2}


def build_short(home, rng, hold, goals) -> GoalTrack:
    """Half a second: home, then 2 cm lower."""
    del rng, hold, goals
    return GoalTrack(home, 0.52, (GoalStep(0.2, move_from(home, (0, 0, -0.02)), 0.0, 0.1),))


@pytest.fixture
def short(monkeypatch):
    """A scenario that takes no time."""
    tolerances = {"": Tolerance(0.05, 1.0)}
    scenario = Scenario("short", "short", Mode.STATIONARY, build_short, tolerances=tolerances)
    monkeypatch.setitem(SCENARIOS, "short", scenario)
    return TrackingSetup("rby1", "short", overrides=SMALL)


# -- the loop ------------------------------------------------------------------------------------


def test_the_device_gives_the_goals_and_hands_go_with_head_and_heading():
    track = GoalTrack(HOME, 10, (GoalStep(1.0, move_from(HOME, (1, 0, 0), 1.0), 0, 1),))
    left = make_pose(np.array([0.2, 0.2, 0.9]), quat_from_yaw(0.3))
    device = GoalDevice(get_scenario("diagonal"), track, {"left_wrist": left, "right_wrist": left})
    np.testing.assert_allclose(device.read(5.0).head, HOME)
    device.start(3.0)
    frame = device.read(3.5)
    assert frame.mode is Mode.MOBILE
    np.testing.assert_allclose(frame.left_wrist, left, atol=1e-12)
    frame = device.read(4.0)
    np.testing.assert_allclose(frame.head, track.steps[0].head)
    expected = pose_multiply(pose_inverse(HOME), left)
    np.testing.assert_allclose(pose_multiply(pose_inverse(frame.head), frame.left_wrist), expected)


def test_the_device_stretches_the_hands_and_mirrors_the_right_one():
    track = GoalTrack(HOME, 10, reach=np.array([0.4, 0.15, -0.1]))
    wrist = make_pose(np.array([0.2, 0.2, 0.9]), quat_from_yaw(0.3))
    device = GoalDevice(get_scenario("arms"), track, {"left_wrist": wrist, "right_wrist": wrist})
    device.start(0.0)
    frame = device.read(LEAD_IN_S)
    np.testing.assert_allclose(frame.left_wrist[:3], [0.4, 0.15, 1.15])
    np.testing.assert_allclose(frame.right_wrist[:3], [0.4, -0.15, 1.15])


def test_world_alignment_changes_nothing():
    alignment = WorldAlignment()
    assert not alignment.is_engaged
    device = GoalDevice(
        get_scenario("squat"), GoalTrack(HOME, 1), {"left_wrist": HOME, "right_wrist": HOME}
    )
    frame = device.read(0.0)
    alignment.engage(frame, {}, 1.0)
    assert alignment.is_engaged
    np.testing.assert_array_equal(alignment.goal_poses(frame)["head"], HOME)
    alignment.disengage()
    assert not alignment.is_engaged


@pytest.mark.slow
def test_a_run_is_deterministic_and_measures_the_truth(short):
    track, first = run_scenario(short, 3)
    _, again = run_scenario(short, 3)
    _, other = run_scenario(short, 4)
    np.testing.assert_array_equal(first.head, again.head)
    assert not np.array_equal(first.head, other.head)
    np.testing.assert_allclose(first.time, np.arange(len(first.time)) * 0.04, atol=1e-9)
    assert len(first.time) == 13
    np.testing.assert_allclose(first.goal[-1], track.steps[0].head, atol=1e-9)
    np.testing.assert_allclose(first.goal[0], track.home)
    # Noise of a centimetre is in what the robot measures, not in what is written down.
    np.testing.assert_allclose(first.head[0, :3], track.home[:3], atol=1e-12)
    np.testing.assert_allclose(other.head[0, :3], track.home[:3], atol=2e-3)
    assert first.solve_s.size == 13
    assert not first.fallen.any()


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    ["default", "table1_equal", "table1_charitable", "no_extrapolation", "no_proposal",
     "no_candidates", "no_preview", "no_sync", "exact"],
)  # fmt: skip
def test_the_loop_runs_what_the_ablation_says(short, name, monkeypatch):
    seen = {}
    drive = tracking._drive

    def spy(loop, teleoperation, track):
        seen["configs"] = dict(teleoperation.retargeter.configs)
        seen["sync"] = teleoperation.config.retargeter.sync
        seen["noise"] = loop.plant.config.noise
        return drive(loop, teleoperation, track)

    monkeypatch.setattr(tracking, "_drive", spy)
    overrides = {} if name == "table1_equal" else SMALL
    setup = dataclasses.replace(short, ablation=name, overrides=overrides)
    record = run_trial(setup, 0)
    assert seen["configs"] == resolve_configs(setup)
    assert seen["sync"] == (name != "no_sync") == record["sync"]
    assert seen["noise"] == ("off" if name == "exact" else "mild") == record["noise"]
    assert record["metrics"]["failed_percent"] == 0  # a variant that cannot solve tells nothing
    assert record["samples"] == seen["configs"][Mode.STATIONARY].num_samples
    json.dumps(record, allow_nan=False)


def test_a_payload_is_in_the_plants_hands_alone():
    morphology = make_morphology("g1")
    setup = TrackingSetup("g1", "arms")
    bare = make_loaded_model(morphology, setup, "empty")
    loaded = make_loaded_model(morphology, dataclasses.replace(setup, payload=2.0), "empty")
    assert loaded.body_subtreemass[0] - bare.body_subtreemass[0] == pytest.approx(4.0)
    heavier = np.flatnonzero(loaded.body_mass != bare.body_mass)
    sites = [morphology.frames[name] for name in ("left_wrist", "right_wrist")]
    assert {int(bare.site(site).bodyid[0]) for site in sites} == set(heavier.tolist())
    assert setup.compute_key(0) != dataclasses.replace(setup, payload=2.0).compute_key(0)
    assert not dataclasses.replace(setup, payload=2.0).is_standard


def test_where_a_policys_file_lies_is_not_part_of_the_key():
    setup = TrackingSetup("g1", "squat", low_level="falcon")
    moved = dataclasses.replace(setup, low_level_path="/elsewhere/falcon.onnx")
    assert setup.compute_key(0) == moved.compute_key(0)
    assert not setup.is_standard


def test_a_run_knows_its_physics_steps(short):
    record = run_trial(short, 0)
    assert record["physics_steps_per_s"] == 4 * 2 * 25 * 4
    assert record["metrics"]["after_mean_max_cm"] is None  # half a second has no 1 s mean
    assert record["setup"] == dataclasses.asdict(short)
    assert record["trace"]["limits"] == [0.3]
    assert len(record["trace"]["position_cm"]) == 3


# -- file, tables, document ----------------------------------------------------------------------


def make_run(name="squat", ablation="default", robot="g1", seed=0, hold=10.0, **metrics):
    setup = TrackingSetup(robot, name, ablation, hold=hold)
    figures = {
        "falls": 0.0, "collisions": 0.0, "goals": 10, "collided_goals": 1, "arrived_goals": 7,
        "at_limit_cm": 1.0 + seed, "after_p95_cm": 2.0, "final_mean_cm": 0.5, "late_s": None,
        "moving_mean_cm": 9.0,
    } | metrics  # fmt: skip
    record = {
        "robot": robot, "scenario": name, "ablation": ablation, "noise": "mild", "seed": seed,
        "setup": dataclasses.asdict(setup), "hold": hold, "physics_steps_per_s": 12800.0,
        "contacts": [], "wall_s": 1.0, "metrics": figures,
        "trace": {"dt": 0.2, "position_cm": [2.0 + seed] * 50, "limits": [2.5]},
    }  # fmt: skip
    return setup.compute_key(seed), record


def parse_table(text: str) -> list[dict[str, str]]:
    lines = [line for line in text.splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert all(len(row) == len(cells[0]) for row in cells)
    assert all(set(cell) <= set("-") for cell in cells[1])
    return [dict(zip(cells[0], row, strict=True)) for row in cells[2:]]


def test_results_are_kept_and_read_back(tmp_path):
    path = tmp_path / "sub" / "results.json"
    results = Results(path)
    key, run = make_run()
    results.add(key, run)
    assert Results(path).runs == {key: run}
    assert Results(path, fresh=True).runs == {}
    assert "mujoco" in json.loads(path.read_text())["machine"]
    with pytest.raises(ValueError, match="Out of range float"):
        results.add("bad", {"metrics": {"x": math.nan}})
    assert Results(path).runs == {key: run}  # what was there is still there


def test_a_file_of_something_else_is_told(tmp_path):
    path = tmp_path / "results.json"
    path.write_text("[]")
    with pytest.raises(BadValue, match="holds no results of the tracking benchmark"):
        read_runs(path)


def test_median_and_worst_count_what_never_came_as_infinite():
    runs = [{"metrics": {"x": value}} for value in (1.0, None, 3.0)]
    assert compute_median_and_worst(runs, "x") == (3.0, math.inf)
    assert compute_median_and_worst(runs[:1] + runs[2:], "x") == (2.0, 3.0)
    assert compute_median_and_worst([runs[1]] * 2, "x") == (math.inf, math.inf)
    assert format_number(math.inf) == "never"
    assert [format_number(value) for value in (0.123, 12.34, 123.4, 0.0)] == [
        "0.1", "12.3", "123", "0"
    ]  # fmt: skip


def test_the_scenario_table_has_median_and_worst_of_the_seeds():
    runs = dict(make_run(seed=seed) for seed in range(3))
    (row,) = parse_table(make_scenario_table(runs, "g1", ["squat", "yaw"]))
    assert row["goal"] == "head 0.15 m down and back"
    assert row["at 1.5 s [cm]"] == "2 / 3"
    assert row["seeds"] == "3"
    rooms = dict(make_run("room", robot="rby1", seed=seed) for seed in range(3))
    (row,) = parse_table(make_scenario_table(rooms, "rby1", ["room"]))
    assert (row["goals"], row["with contact"], row["arrived"]) == ("30", "3", "21")
    with pytest.raises(UnknownName, match="unknown scenario 'x'"):
        make_scenario_table(runs, "g1", ["x"])


def test_the_ablation_table_has_a_row_per_variant_that_ran():
    runs = dict(
        make_run(ablation=name, seed=seed, final_mean_cm=value)
        for name, value in (("default", 1.0), ("table1", 10.0))
        for seed in range(2)
    )
    rows = parse_table(make_ablation_table(runs, "g1", ["squat"], ABLATIONS))
    assert [row["variant"].split(":")[0] for row in rows] == ["`default`", "`table1`"]
    assert [row["final [cm]"] for row in rows] == ["1 / 1", "10 / 10"]
    assert [row["× default"] for row in rows] == ["1.0", "10.0"]
    assert rows[0]["physics steps/s"] == "12800"


def test_a_runs_line_tells_its_figures():
    key, run = make_run("diagonal")
    line = describe_run(key, run)
    assert line.startswith("g1/diagonal/default/0: late [s] never, after, p95 [cm] 2,")


def test_blocks_replace_what_is_between_markers_alone():
    text = "a\n<!-- begin x -->\nold\n<!-- end x -->\nb\n"
    filled = fill_document(text, {"x": "new"})
    assert filled == "a\n<!-- begin x -->\nnew\n<!-- end x -->\nb\n"
    assert fill_document(filled, {"x": "new"}) == filled
    with pytest.raises(BadValue, match="no '<!-- begin y -->' with '<!-- end y -->' after it"):
        fill_document(text, {"y": ""})


def all_runs() -> dict:
    return dict(
        make_run(scenario, ablation, robot, seed, hold=60.0 if ablation == "default" else 10.0)
        for robot in ROBOTS
        for names in SCENARIO_GROUPS.values()
        for scenario in names
        for ablation in ABLATIONS
        for seed in range(2)
    )


@pytest.mark.slow
def test_every_table_and_picture_of_the_document_can_be_filled_and_parses(tmp_path):
    pytest.importorskip("matplotlib")
    runs = all_runs()
    results = tmp_path / "results.json"
    results.write_text(json.dumps({"machine": {"processor": "P", "cores": "2"}, "runs": runs}))
    document = tmp_path / "docs" / "results" / "benchmarks.md"
    document.parent.mkdir(parents=True)
    # RB-Y1 is not told to stretch its arms, and G1 sees no walls.
    text = (ROOT / "docs" / "results" / "benchmarks.md").read_text()
    kept = {
        key: run
        for key, run in runs.items()
        if f"<!-- begin {run['robot']} {kind_of(run['scenario'])} -->" in text
    }
    results.write_text(json.dumps({"machine": {"processor": "P", "cores": "2"}, "runs": kept}))
    document.write_text(text)
    (line,) = write_documents(tmp_path, results)
    assert "left out" not in line
    filled = document.read_text()
    blocks = re.findall(r"<!-- begin (.*?) -->\n(.*?)\n<!-- end \1 -->", filled, re.DOTALL)
    tables = {name: block for name, block in blocks if name.startswith(ROBOTS)}
    for robot in ROBOTS:
        picture = tables.pop(f"{robot} plot")
        assert picture == f"![Position error over time, {robot}](../images/tracking_{robot}.png)"
        assert (tmp_path / "docs" / "images" / f"tracking_{robot}.png").stat().st_size > 10_000
    assert len(tables) >= 14
    for name, block in tables.items():
        assert len(parse_table(block)) >= 1, name
    assert set(ASKED) <= set(tables)


def kind_of(scenario: str) -> str:
    return next(kind for kind, names in SCENARIO_GROUPS.items() if scenario in names)


def test_the_documents_tables_parse_as_they_are():
    text = (ROOT / "docs" / "results" / "benchmarks.md").read_text()
    begun = re.findall(r"<!-- begin (.*?) -->", text)
    assert begun == re.findall(r"<!-- end (.*?) -->", text)
    assert len(begun) == len(set(begun))
    for block in re.findall(r"<!-- begin .*? -->\n(.*?)<!-- end", text, re.DOTALL):
        if block.startswith("|"):
            assert parse_table(block)


def test_scenario_tables_take_the_longest_hold_and_variants_their_own():
    runs = dict(
        make_run(ablation=name, hold=hold, final_mean_cm=hold, at_limit_cm=hold)
        for name, hold in (("default", 60.0), ("default", 10.0), ("no_ess", 10.0))
    )
    blocks = make_blocks(runs, {"processor": "P"})
    assert parse_table(blocks["g1 stationary"])[0]["at 1.5 s [cm]"] == "60 / 60"
    rows = parse_table(blocks["g1 stationary ablations"])
    assert [row["final [cm]"] for row in rows] == ["10 / 10", "10 / 10"]


@pytest.mark.slow
def test_runs_with_other_settings_are_left_out(tmp_path):
    pytest.importorskip("matplotlib")
    key, run = make_run()
    stale = "g1/squat/default/1/00000000"
    setup = TrackingSetup("g1", "squat", overrides={"horizon": 3})
    tuned = {**run, "setup": dataclasses.asdict(setup)}
    results = tmp_path / "results.json"
    runs = {key: run, stale: {**run, "seed": 1}, setup.compute_key(0): tuned}
    results.write_text(json.dumps({"machine": {"processor": "P"}, "runs": runs}))
    document = tmp_path / "docs" / "results" / "benchmarks.md"
    document.parent.mkdir(parents=True)
    document.write_text((ROOT / "docs" / "results" / "benchmarks.md").read_text())
    lines = write_documents(tmp_path, results)
    assert lines[1] == "left out: 2 runs with other settings"
    assert "1 runs; seeds 0 to 0" in document.read_text()


def test_a_table_is_markdown():
    assert make_table(["a", "b"], [["1", "2"]]) == "| a | b |\n| --- | --- |\n| 1 | 2 |"


# -- the script ----------------------------------------------------------------------------------


def test_the_script_resumes(tmp_path, monkeypatch, capsys):
    ran = []

    def fake(setup, seed):
        ran.append((setup.scenario, seed))
        _, run = make_run(setup.scenario, seed=seed)
        return run

    monkeypatch.setattr(script, "run_trial", fake)
    path = tmp_path / "results.json"
    command = ["benchmark", "--robot", "g1", "--scenarios", "squat,yaw", "--json", str(path)]
    monkeypatch.setattr("sys.argv", [*command, "--seeds", "2"])
    assert script.main() == 0
    assert ran == [("squat", 0), ("squat", 1), ("yaw", 0), ("yaw", 1)]
    ran.clear()
    monkeypatch.setattr("sys.argv", [*command, "--seeds", "3"])
    assert script.main() == 0
    assert ran == [("squat", 2), ("yaw", 2)]
    output = capsys.readouterr().out
    assert f"4 of 6 runs are in {path} already" in output
    assert "[6/6] g1/yaw/default/2: at 1.5 s [cm] 3," in output
    ran.clear()
    monkeypatch.setattr("sys.argv", [*command, "--seeds", "1", "--set", "horizon=3"])
    assert script.main() == 0
    assert len(ran) == 2  # other settings, another run


def test_the_script_names_what_it_does_not_know(monkeypatch, capsys):
    for flags, text in (
        (["--scenarios", "jump"], "unknown scenario 'jump'. Known: "),
        (["--ablations", "none"], "unknown ablation 'none'. Known: "),
        (["--robot", "g2"], "unknown robot 'g2'. Known: g1, rby1"),
        (["--set", "horizon"], "a setting reads name=value, got 'horizon'"),
        (["--json", "nowhere.json", "--write-docs"], "there are no results at 'nowhere.json'"),
    ):
        monkeypatch.setattr("sys.argv", ["benchmark", *flags])
        assert script.main() == 1
        assert text in capsys.readouterr().err


@pytest.mark.slow
def test_the_script_draws_a_run(short, tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib")
    picture = tmp_path / "run.png"
    flags = ["--robot", short.robot, "--scenarios", "short", "--set", "num_samples=2"]
    monkeypatch.setattr("sys.argv", ["benchmark", *flags, "--plot", str(picture)])
    assert script.main() == 0
    assert picture.stat().st_size > 20_000
    assert "rby1/short/default/0: at 1.5 s [cm]" in capsys.readouterr().out


@pytest.mark.slow
def test_two_processes_give_the_runs_of_one(tmp_path, monkeypatch):
    flags = ["--robot", "rby1", "--scenarios", "quarter", "--hold", "0", "--seeds", "2"]
    flags += ["--set", "horizon=1", "--set", "num_samples=2"]
    runs = []
    for jobs in ("1", "2"):
        path = tmp_path / f"{jobs}.json"
        command = ["benchmark", *flags, "--jobs", jobs, "--json", str(path)]
        monkeypatch.setattr("sys.argv", command)
        assert script.main() == 0
        runs.append({key: run["metrics"] for key, run in read_runs(path).items()})
    for key, metrics in runs[0].items():
        for name, value in metrics.items():
            if not name.startswith("solve"):
                assert runs[1][key][name] == value, (key, name)
