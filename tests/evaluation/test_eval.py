"""`xop-eval`: workers that die, studies that go on, tables, and the command line."""

import csv
import json
import os
import time
from dataclasses import replace

import pytest
from eval_jobs import do, make_trial, run_made

from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.pool import THREAD_VARIABLES, run_jobs
from xop_lerobot.evaluation import study
from xop_lerobot.evaluation.cli import main, parse_arguments
from xop_lerobot.evaluation.methods import (
    METHODS,
    make_retargeter_config,
    parse_variant,
    resolve_low_level,
)
from xop_lerobot.evaluation.study import (
    Cell,
    Results,
    collect,
    compute_key,
    load_study,
    make_cell,
    plan_jobs,
    run_study,
    summarise,
)
from xop_lerobot.evaluation.trial import TrialSetup
from xop_lerobot.morphology.morphology import make_morphology

CONTRACT = (
    "robot", "task", "method", "variant", "trials", "success", "pickup", "collision", "falls",
    "ct_mean", "ct_std", "abp_mean", "abp_std", "tilt_mean", "jerk_mean", "seeds",
)  # fmt: skip
SETUP = TrialSetup("g1", "dual_point_touch", "direct").resolved


@pytest.fixture(autouse=True)
def offline(monkeypatch):
    """Policies whose files are not in the package are absent: no test downloads any."""
    absent = {"falcon": "weights not present: x", "amo": "weights not present: y"}
    monkeypatch.setattr(study, "find_absence", lambda name, path: absent.get(name, ""))
    study._find_absence.cache_clear()
    yield
    study._find_absence.cache_clear()


def test_a_worker_that_dies_or_fails_costs_its_own_job_alone():
    jobs = [1, "fail", 2, "die", 3, 4]
    results = {result.job: result for result in run_jobs(do, jobs, workers=2)}
    assert set(results) == set(jobs)
    assert [results[job].value[0] for job in (1, 2, 3, 4)] == [2, 4, 6, 8]
    assert results["die"].error == "the worker process died (signal SIGKILL)"
    assert results["fail"].error.startswith("ValueError: bad luck\nTraceback")


def test_workers_live_on_from_job_to_job_with_one_thread_each():
    results = list(run_jobs(do, [1, 2, 3, "threads"], workers=1))
    assert len({result.value[1] for result in results[:3]}) == 1
    assert results[3].value == ["1"] * len(THREAD_VARIABLES)


def test_whoever_stops_asking_stops_the_workers():
    results = run_jobs(do, list(range(100)), workers=1)
    pid = next(results).value[1]
    results.close()
    for _ in range(2400):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    pytest.fail("the worker is still there")


def test_trials_are_planned_method_by_method_within_each_seed(tmp_path):
    other = TrialSetup("g1", "dual_point_touch", "mpc").resolved
    cells = [Cell(SETUP, 3, seed=5), Cell(other, 2, seed=5), Cell(other, 9, absence="no weights")]
    jobs = plan_jobs(cells, tmp_path, ())
    assert [(job.setup.method, job.seed) for job in jobs] == [
        ("direct", 5), ("mpc", 5), ("direct", 6), ("mpc", 6), ("direct", 7)
    ]  # fmt: skip
    assert len({job.key for job in jobs}) == 5
    left = plan_jobs(cells, tmp_path, [jobs[0].key, jobs[3].key])
    assert [job.key for job in left] == [jobs[1].key, jobs[2].key, jobs[4].key]


def test_a_key_tells_every_setting():
    keys = {
        compute_key(TrialSetup(**{"robot": "g1", "task": "t", **change}), 0)
        for change in ({}, {"method": "direct"}, {"variant": "v2"}, {"noise": "off"},
                       {"fps": 50}, {"scene": "room"}, {"low_level": "falcon"}, {"robot": "x"})
    }  # fmt: skip
    assert len(keys) == 8
    assert compute_key(SETUP, 1) != compute_key(SETUP, 2)
    assert compute_key(SETUP, 1) == compute_key(TrialSetup("g1", "dual_point_touch", "direct")
                                                .resolved, 1)  # fmt: skip


@pytest.mark.slow
def test_a_study_goes_on_after_a_crash_and_after_a_line_cut_off(tmp_path):
    cell, results = Cell(SETUP, 3), Results(tmp_path / "out")
    outcomes = list(run_study([cell], results, 1, run=run_made))
    assert [bool(outcome.error) for outcome in outcomes] == [False, True, False]
    assert [trial["seed"] for trial in collect(cell, results.load())] == [0, 2]
    file = tmp_path / "out" / "trials.jsonl"
    assert "the worker process died" in file.read_text()
    with file.open("a") as stream:
        stream.write('{"key": "half a li')
    assert [job.seed for job in plan_jobs([cell], results.folder, results.load())] == [1]
    results.append(make_trial(SETUP, 1))
    lines = file.read_text().splitlines()
    assert json.loads(lines[-1])["seed"] == 1  # on a line of its own
    assert [trial["seed"] for trial in collect(cell, results.load())] == [0, 1, 2]
    file.write_text("\n".join([*lines[:3], '{"key": "half a li', lines[3]]))
    with pytest.raises(BadValue, match=r"line 4, is no trial"):
        results.load()  # in the middle, a broken line is no cut-off one
    file.write_text("\n".join(lines))  # no newline at the end, but a whole line
    results.append(make_trial(SETUP, 3))
    assert [trial["seed"] for trial in results.load().values()] == [0, 2, 1, 3]


def test_summary_of_hand_made_trials():
    trials = [
        make_trial(SETUP, 0, picked_up=True),
        make_trial(SETUP, 1),
        make_trial(SETUP, 2, success=False, completion_s=None, fallen=True, collision=True),
    ]
    row = summarise(Cell(SETUP, 3), trials)
    assert tuple(row)[: len(CONTRACT)] == CONTRACT
    assert (row["trials"], row["success"], row["pickup"]) == (3, 2, 1)
    assert (row["collision"], row["falls"], row["seeds"]) == (1, 1, [0, 1, 2])
    assert row["ct_mean"] == pytest.approx(10.5) and row["ct_std"] == pytest.approx(0.5)
    assert row["abp_mean"] == pytest.approx(0.2)
    assert row["tilt_mean"] is None and row["jerk_mean"] == 10
    assert (row["completed"], row["ct_any_mean"]) == (None, None)  # no trial goes on beyond
    beyond = replace(SETUP, time_limit=300.0)
    late = make_trial(beyond, 2, success=False, completion_s=200.0)
    never = make_trial(beyond, 3, success=False, completion_s=None)
    row = summarise(Cell(beyond, 3), [make_trial(beyond, 0), late, never])
    assert (row["success"], row["ct_mean"]) == (1, 10.0)
    assert (row["completed"], row["ct_any_mean"], row["ct_any_std"]) == (2, 105.0, 95.0)
    empty = summarise(Cell(SETUP, 3, absence="weights not present: x"), [])
    assert empty["trials"] == 0 and empty["ct_mean"] is None
    assert empty["note"] == "weights not present"


def test_methods_and_variants():
    rby1, g1 = make_morphology("rby1"), make_morphology("g1")
    assert parse_variant(rby1, "") == {}
    assert parse_variant(rby1, "v2_upright_conservative") == {
        "variant": "v2", "constraints": "upright", "preset": "conservative"
    }  # fmt: skip
    config = make_retargeter_config(rby1, "mpc_no_sync", "v2_upright", seed=3)
    assert (config.sync, config.variant, config.constraints) == (False, "v2", "upright")
    assert (config.threads, config.seed) == (1, 3)
    assert make_retargeter_config(g1, "direct").type == "direct"
    assert make_retargeter_config(g1, "mpc_table1").preset == "table1"
    charitable = make_retargeter_config(g1, "mpc_table1_charitable")
    assert charitable.preset == "table1_charitable"
    for variant in ("v2_table1_charitable", "table1_charitable_v2"):  # one name, not two parts
        parsed = parse_variant(rby1, variant)
        assert parsed == {"variant": "v2", "preset": "table1_charitable"}
    with pytest.raises(UnknownName, match="unknown part of variant 'v2_x' of rby1 'x'. Known: agg"):
        parse_variant(rby1, "v2_x")
    with pytest.raises(BadValue, match="variant 'v1_v2' has two bindings: v1, v2. Choose one"):
        parse_variant(rby1, "v1_v2")
    with pytest.raises(BadValue, match="method 'mpc_table1' sets preset itself"):
        make_retargeter_config(g1, "mpc_table1", "conservative")
    assert resolve_low_level(rby1, "mpc", "") == "diff_drive"
    assert resolve_low_level(g1, "direct_amo", "falcon") == METHODS["direct_amo"].low_level
    with pytest.raises(UnknownName, match="low-level policy of rby1 'falcon'"):
        resolve_low_level(rby1, "mpc", "falcon")


@pytest.mark.slow
def test_every_cell_of_the_papers_tables_can_be_made(tmp_path):
    cells = load_study(_repository() / "configs" / "paper_tables.yaml", {"trials": 2, "seed": 7})
    assert {(cell.setup.robot, cell.setup.task) for cell in cells} == {
        ("g1", "dual_point_touch"), ("g1", "box_pick_and_place"), ("rby1", "dual_point_touch"),
        ("rby1", "box_pick_and_place"), ("rby1", "non_prehensile_transport"),
    }  # fmt: skip
    assert {cell.setup.method for cell in cells} == set(METHODS)
    assert all(list(cell.seeds) == [7, 8] for cell in cells)
    assert len({cell.setup for cell in cells}) == len(cells)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("groups: [{robot: g1, tasks: [dual_point_touch]}]", "group 1 lacks 'methods'"),
        ("group: []", "unknown key of study '.*' 'group'. Known: fps, groups"),
        ("groups: []", "groups must be a list of at least one group"),
        ("groups: [{robot: g1, tasks: t, methods: [mpc]}]", "tasks must be a list, got 't'"),
        ("groups: [{robot: g9, tasks: [t], methods: [mpc]}]", "unknown robot 'g9'"),
        ("[", "is no YAML"),
    ],
)
def test_a_study_that_is_malformed_says_where(tmp_path, text, fault):
    path = tmp_path / "study.yaml"
    path.write_text(text)
    with pytest.raises((BadValue, UnknownName), match=fault):
        load_study(path)


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (["--robto", "g1"], "error: unknown flag of xop-eval '--robto'. Known: --config, --csv"),
        (["--robot", "g1"], "error: xop-eval needs --task, or a study with --config=FILE"),
        (["--robot", "g1", "--task", "juggle"], "error: unknown task 'juggle'. Known: "),
        (["--robot", "g9", "--task", "juggle"], "error: unknown robot 'g9'. Known: g1, rby1"),
        (
            ["--robot", "g1", "--task", "dual_point_touch", "--methods", "mpc,magic"],
            "error: unknown method 'magic'. Known: direct, direct_amo, mpc, mpc_no_sync, mpc_table",
        ),
        (
            ["--robot", "g1", "--task", "dual_point_touch", "--trials", "0"],
            "error: trials must be at least 1, got 0",
        ),
        (
            ["--robot", "g1", "--task", "dual_point_touch", "--fps", "30"],
            "error: --fps must divide the low-level policy's 50 Hz, got 30",
        ),
        (
            ["--robot", "g1", "--task", "dual_point_touch", "--noise", "loud"],
            "error: unknown noise preset 'loud'. Known: harsh, mild, off",
        ),
    ],
)
def test_mistakes_on_the_command_line(capsys, arguments, fault):
    assert main(arguments) == 2
    assert capsys.readouterr().err.startswith(fault)


def test_tables_of_what_is_there(tmp_path, capsys):
    results = Results(tmp_path / "out")
    for seed in range(2):
        results.append(make_trial(SETUP, seed))
    table, sheet = tmp_path / "t.json", tmp_path / "t.csv"
    code = main(
        [*("--robot", "g1", "--task", "dual_point_touch", "--methods", "direct,direct_amo")]
        + [*("--trials", "2", "--out", str(tmp_path / "out"), "--no-run")]
        + [*("--json", str(table), "--csv", str(sheet))]
    )
    assert code == 0
    rows = json.loads(table.read_text())
    assert [row["method"] for row in rows] == ["direct", "direct_amo"]
    assert rows[0]["trials"] == 2 and rows[0]["success"] == 2
    assert all(set(CONTRACT) <= set(row) for row in rows)
    assert rows[1]["trials"] == 0 and rows[1]["note"] == "weights not present"
    with sheet.open() as file:
        assert next(csv.DictReader(file))["ct_mean"] == "10.5"
    printed = capsys.readouterr()
    assert "2/2" in printed.out and "weights not present" in printed.out
    assert "2 trials in" in printed.err and "--fresh runs them again" in printed.err


def test_the_page_is_whole_and_tells_whose_figures_are_whose(tmp_path):
    results = Results(tmp_path / "out")
    other = TrialSetup("g1", "dual_point_touch", "mpc").resolved
    for seed in range(3):
        results.append(make_trial(SETUP, seed, success=seed > 0, failure="the robot <fell>"))
        results.append(make_trial(other, seed))
    page = tmp_path / "report" / "index.html"
    code = main(
        [*("--robot", "g1", "--task", "dual_point_touch", "--methods", "mpc,direct,direct_amo")]
        + [*("--trials", "3", "--out", str(tmp_path / "out"), "--no-run")]
        + [*("--report", str(page.parent))]
    )
    assert code == 0
    text = page.read_text()
    assert text.count("data:image/png;base64,") == 4
    assert 'src="http' not in text and "href=" not in text  # it needs no other file
    assert "2/3<br>" in text and "21% to 94%" in text  # Wilson's of 2 of 3
    assert "weights not present" in text
    theirs = [row for row in text.split("<tr") if "26.6 ± 6.6" in row]
    assert len(theirs) == 1 and 'class="theirs"' in theirs[0] and "the paper" in theirs[0]
    rows = json.loads((page.parent / "table.json").read_text())
    assert [row["success"] for row in rows] == [3, 2, 0]


@pytest.mark.slow
def test_a_whole_study_can_be_narrowed(tmp_path, capsys):
    path = str(_repository() / "configs" / "paper_tables.yaml")
    out = ["--out", str(tmp_path), "--no-run"]
    assert main(["--config", path, "--robot", "rby1", "--methods", "direct", *out]) == 0
    assert capsys.readouterr().out.count("rby1") == 2
    assert main(["--config", path, "--methods", "mpc,amo", *out]) == 2
    assert "unknown method of the study 'amo'" in capsys.readouterr().err


def test_trials_and_seeds_have_ranges():
    with pytest.raises(BadValue, match="seed must be 0 or more, got -1"):
        make_cell(SETUP, 1, -1)


def _repository():
    from pathlib import Path

    return Path(__file__).parents[2]


def test_lerobots_type_of_a_robot_names_it_too():
    arguments = ["--robot", "xop_rby1m", "--task", "dual_point_touch"]
    assert parse_arguments(arguments).robot == "rby1m"
