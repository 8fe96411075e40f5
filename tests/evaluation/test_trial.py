"""One closed-loop trial: the same seed is the same trial, and every method meets the same world."""

import json
from dataclasses import replace

import numpy as np
import pytest

from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.evaluation.report import load_film, render_film
from xop_lerobot.evaluation.study import Job, Results, run_job
from xop_lerobot.evaluation.trial import Trace, TrialSetup, run_trial
from xop_lerobot.evaluation.trial_metrics import (
    compute_metrics,
    find_lower_body,
    find_transport,
    make_record,
)
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.plant.rendering import RenderingUnavailable
from xop_lerobot.tasks.task import TASKS

DIRECT = TrialSetup("g1", "dual_point_touch", "direct", time_limit=3.0)


@pytest.fixture(scope="module")
def trial():
    return run_trial(DIRECT, seed=3)


@pytest.mark.slow
def test_the_same_seed_is_the_same_trial(trial):
    again, other = run_trial(DIRECT, seed=3), run_trial(DIRECT, seed=4)
    np.testing.assert_array_equal(again.trace.qpos, trial.trace.qpos)
    np.testing.assert_array_equal(again.trace.command, trial.trace.command)
    assert not np.array_equal(other.trace.qpos[-1], trial.trace.qpos[-1])
    there = [each.trace.objects["left_point"][0] for each in (trial, again, other)]
    np.testing.assert_array_equal(there[0], there[1])
    assert not np.array_equal(there[0], there[2])


def test_every_method_meets_the_same_places_and_the_same_person(trial):
    seen = []
    frames = []

    def watch(stage, view, record):
        seen.append(view.objects)
        frames.append(record.frame)

    run_trial(replace(DIRECT, method="mpc", time_limit=0.5), 3, watch)
    for name, pose in trial.trace.objects.items():
        np.testing.assert_array_equal(seen[0][name].pose, pose[0])
    mpc = frames[:]
    frames.clear()
    run_trial(replace(DIRECT, time_limit=0.5), 3, watch)
    np.testing.assert_array_equal(mpc[0].head, frames[0].head)


def test_what_a_trial_keeps(trial):
    trace = trial.trace
    n = len(trace.time)
    assert n == 75  # 3 s at 25 Hz
    np.testing.assert_allclose(np.diff(trace.time), 0.04, atol=1e-9)
    assert trace.qpos.shape == (n, 36) and trace.effort.shape == (n, 29)
    assert set(trace.frames) == {"head", "left_wrist", "right_wrist", "left_palm", "right_palm"}
    assert set(trace.goals) == {"head", "left_wrist", "right_wrist"}
    assert trace.engaged.any()
    np.testing.assert_array_equal(np.isnan(trace.goals["head"]).any(axis=1), ~trace.engaged)
    assert np.isnan(trial.completion_s) and not trial.status.success
    assert trial.setup.low_level == "default" and trial.setup.scene == "empty"
    metrics = compute_metrics(trial)
    assert metrics["abp"] > 0 and abs(metrics["abp_signed"]) <= metrics["abp"]
    assert np.isnan(metrics["tilt"]) and metrics["touch_s"] == 0
    record = json.loads(json.dumps(make_record(trial), allow_nan=False))
    assert record["completion_s"] is None and record["seed"] == 3


@pytest.mark.parametrize(
    "at, success, ever", [(5, True, True), (15, False, True), (99, False, False)]
)
def test_beyond_the_tasks_limit_only_the_completion_time_is_measured(
    monkeypatch, at, success, ever
):
    monkeypatch.setattr(TASKS[DIRECT.task], "time_limit", 0.4)
    ticks = 0

    def watch(stage, view, tick):
        nonlocal ticks
        ticks += 1
        stage.task._success |= ticks == at

    trial = run_trial(replace(DIRECT, time_limit=0.8), 3, watch)
    assert trial.status.success == success
    # The person engages in the first tick. After a success an episode goes on for a second.
    assert trial.completion_s == pytest.approx(0.04 * at) if ever else np.isnan(trial.completion_s)
    assert ticks == at + 25 if ever else 20
    assert len(trial.trace.time) == (ticks if success else 10)
    assert len(trial.film.qpos) == ticks


def test_power_counts_legs_and_waist_alone():
    robot = make_morphology("g1")
    actuators, dofs = find_lower_body(robot)
    model = robot.build_spec("planning").compile()
    names = [model.actuator(int(index)).name for index in actuators]
    assert len(names) == 15
    assert all(name.split("_")[1] in ("hip", "knee", "ankle", "yaw", "roll", "pitch")
               for name in names)  # fmt: skip
    assert [int(model.joint(name).dofadr[0]) for name in names] == list(dofs)


def make_trace(toy, opening, palm):
    n = len(toy)
    pose = np.zeros((n, 7))
    pose[:, 3] = 1

    def at(places):
        return np.concatenate([np.asarray(places, float), pose[:, 3:]], axis=1)

    far = np.tile([0.0, -1, 1], (n, 1))
    return Trace(
        time=np.arange(n) * 0.04, engaged=np.arange(n) > 0, mode=np.zeros(n), qpos=pose, qvel=pose,
        effort=pose, command=pose, frames={"left_palm": at(palm), "right_palm": at(far)}, goals={},
        objects={"toy": at(toy), "opening": at(np.tile(opening, (n, 1)))}, solve_s=np.zeros(0),
        fallen=np.zeros(n), collision=np.zeros(n), failed=np.zeros(0), intervened=np.zeros(0),
    )  # fmt: skip


def test_transport_ends_at_the_opening_or_when_the_toy_is_lost():
    x = np.linspace(0, 1, 11)
    carried = np.stack([x, 0 * x, 1 + 0 * x], axis=1)
    palm = carried - [0, 0, 0.03]
    found = find_transport(make_trace(carried, [0.75, 0, 0.5], palm))
    assert found is not None and found[0] == "left_palm"
    assert list(np.flatnonzero(found[1])) == [1, 2, 3, 4, 5, 6]  # not engaged at first; 0.7 is near
    times = {"free_time_s": 0.1, "let_go_time_s": 0.2}
    found = find_transport(make_trace(carried, [0.75, 0, 0.5], palm), times)
    assert found is not None and list(np.flatnonzero(found[1])) == [3, 4]  # 0.12 and 0.16 s
    fallen = carried.copy()
    fallen[4:, 2] -= 0.5
    found = find_transport(make_trace(fallen, [0.75, 0, 0.5], palm))
    assert found is not None and list(np.flatnonzero(found[1])) == [1, 2, 3]
    trace = make_trace(carried, [5, 0, 0], palm)
    assert find_transport(replace(trace, objects={"box": trace.objects["toy"]})) is None


def test_a_film_is_made_of_what_a_trial_left_behind(tmp_path):
    setup = replace(DIRECT, time_limit=0.4).resolved
    job = Job(setup, 3, str(tmp_path))
    record = run_job(job)
    assert record["key"] == job.key and record["sim_s"] == pytest.approx(0.4)
    film = load_film(Results(tmp_path).film_path(job.key))
    assert film.fps == 25 and film.qpos.shape[1] == 36
    try:
        pictures = list(render_film(setup, 3, film))
    except RenderingUnavailable as error:
        pytest.skip(str(error))
    assert len(pictures) == 10 and pictures[0].shape == (240, 320, 3)
    assert pictures[0].std() > 10
    with pytest.raises(BadValue, match="has qpos of shape .36,., the trial was recorded with"):
        list(render_film(setup, 3, replace(film, qpos=film.qpos[:, :-1])))
    with pytest.raises(BadValue, match="holds no positions of a trial"):
        load_film(tmp_path / "nothing.npz")


def test_names_are_checked_before_anything_runs():
    with pytest.raises(UnknownName, match="unknown method 'magic'"):
        run_trial(replace(DIRECT, method="magic"), 0)
    with pytest.raises(UnknownName, match="unknown task 'juggle'"):
        run_trial(replace(DIRECT, task="juggle"), 0)
