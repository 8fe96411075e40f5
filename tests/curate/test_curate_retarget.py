"""`xop-curate retarget`: the same operator drives another robot, twice the same."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import toy_robot  # noqa: F401  registers the robot
from hardware_like import make_hardware_like

import xop_lerobot.collect.run as run_module
from xop_lerobot.collect.merge import merge_attempts
from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.state import FRAMES
from xop_lerobot.curate.arguments import parse_episodes
from xop_lerobot.curate.cli import main
from xop_lerobot.curate.retarget import RetargetFolder
from xop_lerobot.curate.retarget_job import (
    RetargetConfig,
    RetargetJob,
    choose_fps,
    read_settings,
    read_weights,
)
from xop_lerobot.curate.retarget_worker import Replayer
from xop_lerobot.operator.alignment import AlignmentConfig
from xop_lerobot.operator.recording import Recording, load_recording, make_recording
from xop_lerobot.recording.facts import read_facts
from xop_lerobot.retarget.config import RetargeterConfig

pytestmark = pytest.mark.slow

REPO = Path(__file__).parents[2]
SHARED = Path(os.environ.get("XOP_SHARED", REPO.parent / "shared"))
HUMAN = SHARED / "operator" / "human_seq_0_0.npz"
TOY = RetargetConfig(
    "toy",
    method="direct",
    plugins=("toy_robot",),
    cameras=(),
    hold_s=0.0,
    noise="off",
    name="people",
)
FLAGS = (
    "--robot=toy", "--method=direct", "--plugins=toy_robot", "--cameras=", "--noise=off",
    "--hold=0",
)  # fmt: skip
HOST = ("time.wall", "retargeter.health")
"""Columns that tell of the host's clock."""
FPS = 25


@pytest.fixture(scope="module", autouse=True)
def workers() -> Iterator[None]:
    """Let the workers find the toy robot."""
    with pytest.MonkeyPatch.context() as patch:
        folders = ("tests/helpers", "teleoperators", "robots", ".")
        patch.setenv("PYTHONPATH", os.pathsep.join(str(REPO / name) for name in folders))
        yield


def make_person(seed: int, seconds: float = 2.0) -> Recording:
    """A person who sways, squats and walks."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, seconds, 0.011)
    pose = np.tile([0.0, 0, 1.6, 1, 0, 0, 0], (len(t), 1))
    phase = rng.uniform(0, 6, 3)
    pose[:, :3] += np.sin(2 * t[:, None] + phase) * (0.1, 0.05, 0.1)
    hand = np.array([0.3, 0.2, -0.4, 0, 0, 0, 0])
    return make_recording(
        {
            "t": t,
            "head_pose": pose,
            "left_wrist_pose": pose + hand,
            "right_wrist_pose": pose + hand * [1, -1, 1, 1, 1, 1, 1],
            "left_pinch": np.full(len(t), 0.08),
            "right_pinch": np.full(len(t), 0.08),
            "mode": (t > 1).astype(int),
        },
        "person",
    )


def record(root: Path, config: RetargetConfig, jobs: Sequence[RetargetJob]) -> Path:
    """Record a dataset in this process."""
    folder = RetargetFolder(root)
    settings = config.to_settings()
    with folder.hold(settings):
        maker = Replayer(config, 0.0)
        try:
            for job in jobs:
                draft = folder.open_attempt(job.index)
                folder.close_attempt(draft, maker.make(job, draft))
        finally:
            maker.close()
        merge_attempts(folder, range(len(jobs)), "local/toy", settings, dict)
    return root


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    """Three sessions of the toy robot; the task of the second changes in it."""
    tasks = [((0.0, "sway"),), ((0.0, "sway"), (1.0, "squat")), ((0.0, "sway"),)]
    jobs = [
        RetargetJob(index, make_person(index, 2.6 + 0.2 * index), tasks=tasks[index])
        for index in range(3)
    ]
    return record(tmp_path_factory.mktemp("source") / "toys", TOY, jobs)


def read(root: Path) -> Any:
    """All rows of a dataset."""
    paths = sorted(root.glob("data/*/*.parquet"))
    return pd.concat(pd.read_parquet(path) for path in paths).reset_index(drop=True)


def stack(rows: Any, column: str) -> np.ndarray:
    return np.stack(rows[column].to_numpy())


def assert_same_rows(root: Path, other: Path) -> None:
    one, two = (read(each).drop(columns=list(HOST)) for each in (root, other))
    pd.testing.assert_frame_equal(one, two)
    # Of the health, the solve time alone is the host's.
    health, others = (stack(read(each), "retargeter.health")[:, 1:] for each in (root, other))
    np.testing.assert_array_equal(health, others)


def compute_sums(root: Path) -> dict[Path, str]:
    return {
        path: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


def retarget(source: Path, out: Path, *flags: str) -> int:
    return main(["retarget", f"--root={source}", f"--out={out}", *FLAGS, *flags])


# Content.


@pytest.fixture(scope="module")
def made(source, tmp_path_factory) -> Path:
    """The sessions, retargeted by one worker."""
    before = compute_sums(source)
    out = tmp_path_factory.mktemp("made") / "again"
    assert retarget(source, out, "--workers=1", f"--json={out.with_name('made.json')}") == 0
    assert compute_sums(source) == before
    return out


def test_operator_and_goals_are_those_of_the_source(source, made):
    old, new = read(source), read(made)
    for episode in range(3):
        one, two = (rows[rows.episode_index == episode] for rows in (old, new))
        assert len(one) == len(two)
        assert two["operator.engaged"].all()
        for frame in FRAMES:
            np.testing.assert_allclose(
                stack(two, f"operator.{frame}"), stack(one, f"operator.{frame}"), atol=2e-6
            )
            # The same robot stands in the same place, so the goals are the same too.
            np.testing.assert_allclose(
                stack(two, f"goal.{frame}"), stack(one, f"goal.{frame}"), atol=1e-5
            )
        np.testing.assert_allclose(stack(two, "operator.pinch"), stack(one, "operator.pinch"))
        modes, old_modes = (stack(rows, "action")[:, 2] for rows in (two, one))
        np.testing.assert_array_equal(modes, old_modes)
        assert two["task_index"].tolist() == one["task_index"].tolist()
    assert old["task_index"].nunique() == 2


def test_figures_are_told(made, source):
    document = json.loads(made.with_name("made.json").read_text())
    assert document["root"] == str(made)
    assert document["left_out"] == {}
    assert [row["source_episode"] for row in document["episodes"]] == [0, 1, 2]
    rows = read(made)
    for row in document["episodes"]:
        part = rows[rows.episode_index == row["episode"]]
        error = stack(part, "goal.head")[:, :3] - stack(part, "robot.head")[:, :3]
        mean = np.linalg.norm(error, axis=1).mean()
        assert row["tracking_head_mean"] == pytest.approx(mean, rel=1e-4)
        assert row["duration"] == pytest.approx(len(part) / FPS)


def test_provenance_is_among_the_facts(source, made):
    for episode, facts in enumerate(read_facts(made)):
        (step,) = facts["provenance"]
        assert (step["verb"], step["source_episode"]) == ("retarget", episode)
        assert step["source"] == f"{source.parent.name}/toys"
        assert step["source_rows"] == [0, facts["length"]]
        assert step["arguments"] == {
            "robot": "toy", "fps": 25, "method": "direct", "noise": "off",
        }  # fmt: skip
        assert step["versions"]["mujoco"] == facts["versions"]["mujoco"]
    table = pq.read_table(next(made.glob("meta/episodes/*/*.parquet")))
    assert json.loads(table["xop/provenance"][0].as_py())[0]["verb"] == "retarget"
    config = json.loads((made / "meta/xop/config.json").read_text())
    assert config["teleop"]["device"]["type"] == "retarget"
    assert {facts["config_hash"] for facts in read_facts(made)} == {
        read_facts(made)[0]["config_hash"]
    }


def test_two_workers_make_the_same(made, source, tmp_path):
    assert retarget(source, tmp_path / "two", "--workers=2", "--quiet") == 0
    assert_same_rows(made, tmp_path / "two")


def test_retargeting_what_was_retargeted_remembers_both(made, tmp_path):
    out = tmp_path / "out"
    flags = ("--episodes=1", "--workers=1", "--quiet", "--method=mpc", "--alignment=walk_scale=0.5")
    assert retarget(made, out, *flags, "--weights", "position=2", "tilt_share=0.5") == 0
    (facts,) = read_facts(out)
    assert [step["source_episode"] for step in facts["provenance"]] == [1, 1]
    assert facts["provenance"][1]["arguments"]["alignment"] == {"walk_scale": 0.5}
    assert facts["settings"]["weights"] == {"position": 2.0, "tilt_share": 0.5}
    old, new = read(made).query("episode_index == 1"), read(out)
    travel = [np.ptp(stack(rows, "goal.head")[:, 0]) for rows in (old, new)]
    assert travel[1] == pytest.approx(0.5 * travel[0], rel=1e-4)


# Hardware.


@pytest.fixture(scope="module")
def hardware(source, tmp_path_factory) -> Path:
    return make_hardware_like(source, tmp_path_factory.mktemp("hardware") / "toys")


def test_recording_of_hardware_plays_as_it_was(hardware, tmp_path):
    out = tmp_path / "out"
    assert retarget(hardware, out, "--workers=1", "--quiet") == 0
    old, new = read(hardware), read(out)
    for episode in range(3):
        one, two = (rows[rows.episode_index == episode] for rows in (old, new))
        # The robot holds where nobody drove: a tick earlier or later, as the clock jitters.
        length = min(len(one), len(two))
        assert abs(len(one) - len(two)) <= 2
        engaged = [rows["operator.engaged"].to_numpy()[:length] for rows in (one, two)]
        assert (engaged[0] != engaged[1]).sum() <= 6
        assert 15 <= (~engaged[1]).sum() <= 26
        tracked = stack(two, "operator.tracked")
        assert 8 <= (~tracked[:, 0]).sum() <= 12 and 13 <= (~tracked[:, 1]).sum() <= 17
        assert tracked[:, 2].all()
        error = (
            stack(one, "operator.right_wrist")[:length]
            - stack(two, "operator.right_wrist")[:length]
        )
        # A person at 0.4 m/s at most, and a clock that is 18 ms beside at most.
        assert np.abs(error).max() < 0.4 * 0.05
        # What nobody knows is 0 in both, and the robot's truth is there again.
        assert (stack(two, "goal.head")[~engaged_of(two)] == 0).all()
        assert (np.abs(stack(two, "robot.head")[:, 2]) > 0.5).all()


def engaged_of(rows: Any) -> np.ndarray:
    return rows["operator.engaged"].to_numpy()


# What cannot be replayed.


def spoil_episode(root: Path, episode: int, column: str, value: float) -> None:
    (path,) = root.glob(f"data/*/file-{episode:03d}.parquet")
    table = pd.read_parquet(path)
    width = np.size(table[column][0])
    table[column] = [np.full(width, value, np.float32).tolist()] * len(table)
    table.to_parquet(path)


def test_episodes_that_cannot_be_replayed_are_left_out(source, tmp_path, capsys):
    root, out = tmp_path / "toys", tmp_path / "out"
    shutil.copytree(source, root)
    spoil_episode(root, 0, "operator.head", 0.7)
    (root / "data/chunk-000/file-002.parquet").write_bytes(b"PAR1")
    assert main(["retarget", f"--root={root}", *FLAGS, "--dry-run"]) == 0
    plan = capsys.readouterr().out.splitlines()
    assert plan[0].startswith("episode 0: left out (operator recording")
    assert "head_pose[0, 3:] must be a unit quaternion (qw qx qy qz), its norm is 1.4" in plan[0]
    assert plan[1:] == [
        "episode 1: 2.8 s of 'sway'",
        plan[2],
        "1 episode, 2.8 s would be replayed",
    ]
    assert "file-002.parquet is not readable" in plan[2]
    assert retarget(root, out, "--workers=1") == 0
    assert len(read_facts(out)) == 1
    printed = capsys.readouterr()
    assert "episode 0 of the source is left out: operator recording" in printed.err
    # Once the source is mended, the same command adds what was left out.
    shutil.copy(source / "data/chunk-000/file-002.parquet", root / "data/chunk-000")
    assert retarget(root, out, "--workers=1") == 0
    assert "1 episode already done, skipping" in capsys.readouterr().err
    origins = [facts["provenance"][-1]["source_episode"] for facts in read_facts(out)]
    assert origins == [1, 2]


def test_a_floor_that_is_wrong_is_told_and_the_others_are_made(source, tmp_path):
    low = dataclasses.replace(make_person(0), poses=make_person(0).poses - [0, 0, 1.3, 0, 0, 0, 0])
    jobs = [RetargetJob(0, low), RetargetJob(1, make_person(1, 1.0))]
    root = record(tmp_path / "out", TOY, jobs)
    (attempt,) = json.loads((root / "meta/xop/retarget.json").read_text())["attempts"]
    assert (attempt["index"], attempt["kept"]) == (1, True)
    maker = Replayer(TOY, 0.0)
    try:
        refused = maker.make(jobs[0], tmp_path / "draft")
    finally:
        maker.close()
    assert refused.failure.startswith("cannot engage: the operator's head is 0.")


def test_nothing_that_can_be_replayed(source, tmp_path, capsys):
    root = tmp_path / "toys"
    shutil.copytree(source, root)
    for episode in range(3):
        spoil_episode(root, episode, "time.sim", 0.0)
        spoil_episode(root, episode, "time.wall", 0)
        spoil_episode(root, episode, "timestamp", 0.0)
    assert retarget(root, tmp_path / "out", "--workers=1") == 1
    error = capsys.readouterr().err.splitlines()
    assert error[-1] == "error: no operator could be replayed, so no dataset is made"
    assert "no clock of it runs at about 25 Hz. Tried: time.sim, time.wall, timestamp" in error[-2]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["toys"]


@pytest.mark.parametrize(
    ("flags", "code", "message"),
    [
        (["--episodes=1,7"], 1, "it has no episode 7 (it has 3, 0 to 2)"),
        (["--episodes=one"], 2, "--episodes must be such as 0,3,8-11 or 0,3,8:12, got 'one'"),
        (["--retargeter", "colour=2"], 2, "unknown setting of the retargeter 'colour'. Known: bod"),
        (["--retargeter", "horizon=x"], 2, "setting of the retargeter 'horizon': Couldn't parse"),
        (["--weights", "position"], 2, "weight must be given as KEY=VALUE, got 'position'"),
        (["--weights", "colour=1"], 2, "unknown weight 'colour'. Known: change, collision, "),
        (["--robot=h1"], 2, "unknown robot 'h1'. Known: "),
        (["--task=sleep"], 2, "unknown task 'sleep'. Known: "),
        (["--weights", "position=2"], 2, "the retargeter is 'direct'. Use --method=mpc, or"),
        (["--colour=red"], 2, "unknown flag of xop-curate retarget '--colour=red'. Known: --al"),
    ],
)
def test_bad_flags(source, tmp_path, capsys, flags, code, message):
    assert retarget(source, tmp_path / "out", *flags) == code
    error = capsys.readouterr().err
    assert error.startswith("error: ") and message in error
    assert not list(tmp_path.iterdir())


def test_places_that_are_taken(source, made, tmp_path, capsys):
    assert retarget(source, made, "--seed=3") == 1
    assert capsys.readouterr().err == (
        f"error: '{made}' was made with other settings: seed 0 (asked for: 3). Ask for the same, "
        "choose another --out, or delete it\n"
    )
    assert main(["retarget", f"--root={source}", *FLAGS]) in (1, 2)
    assert "missing output: pass --out=DIR, or --dry-run" in capsys.readouterr().err
    other = tmp_path / "other"
    shutil.copytree(source, other)
    (other / "meta/xop/retarget.json").unlink()
    assert retarget(source, other) == 1
    assert "holds a dataset that xop-curate retarget did not make" in capsys.readouterr().err
    for inside in (source / "inside", source.parent):
        assert retarget(source, inside) == 1
    assert not (source / "inside").exists()


def test_dataset_without_an_operator(source, tmp_path, capsys):
    root = tmp_path / "foreign"
    shutil.copytree(source, root)
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    del info["features"]["operator.head"]
    path.write_text(json.dumps(info))
    assert retarget(root, tmp_path / "out") == 1
    error = capsys.readouterr().err
    assert "the dataset has no column operator.head. Its columns: action, episode_index" in error


# Interruption.


def test_stopped_runs_go_on(made, source, tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"
    stock = run_module._Progress.note

    def stop(progress, attempt) -> None:
        stock(progress, attempt)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(run_module._Progress, "note", stop)
        assert retarget(source, out, "--workers=1") == 130
    assert not out.exists()
    first = next(RetargetFolder(out).work.glob("attempts/[0-9]*/attempt.json"))
    written = json.loads(first.read_text())
    assert capsys.readouterr().err.splitlines()[-1] == (
        "interrupted; run the same command again to resume"
    )
    assert retarget(source, out, "--workers=1") == 0
    assert "1 episode already done, skipping" in capsys.readouterr().err
    attempts = json.loads((out / "meta/xop/retarget.json").read_text())["attempts"]
    assert attempts[0] == written
    assert not RetargetFolder(out).work.exists()
    assert_same_rows(made, out)


# Settings.


def test_settings_are_read_by_their_type():
    assert read_settings(RetargeterConfig, "setting", ["horizon=40", "sync=false"]) == {
        "horizon": 40, "sync": False,
    }  # fmt: skip
    assert read_settings(AlignmentConfig, "setting", ["reach_scale=1"]) == {"reach_scale": 1.0}
    assert read_weights(["position=2", "collision_range=inf"]) == {
        "position": 2.0, "collision_range": np.inf,
    }  # fmt: skip
    with pytest.raises(UnknownName):
        read_settings(RetargeterConfig, "setting", ["preset=wild"])
    with pytest.raises(BadValue, match=r"alignment\.walk_scale must be finite and above 0, got -1"):
        read_settings(AlignmentConfig, "setting", ["walk_scale=-1"])


def test_choices():
    assert parse_episodes("8-11, 3,9") == [3, 8, 9, 10, 11]
    assert parse_episodes("8:11,9-12,3") == [3, 8, 9, 10, 11, 12]
    with pytest.raises(BadValue, match="--episodes has '11-8', an empty range, in '3,11-8'"):
        parse_episodes("3,11-8")
    assert [choose_fps(0, fps) for fps in (25, 50, 30, 12.5, 10)] == [25, 50, 25, 25, 10]
    assert choose_fps(5, 30) == 5


# Real robots and a real person.
def test_a_session_of_g1_becomes_one_of_rby1(tmp_path):
    if not HUMAN.exists():
        pytest.skip(f"the recording of a person, {HUMAN}, is not on this machine")
    person = load_recording(HUMAN)
    person = dataclasses.replace(person, mode=np.ones(len(person.t), int))
    config = RetargetConfig("g1", cameras=(), hold_s=1.0, name="people")
    g1 = record(tmp_path / "g1", config, [RetargetJob(0, person, tasks=((0.0, "walk"),))])
    rby1, again = tmp_path / "rby1", tmp_path / "again"
    for out in (rby1, again):
        flags = ("--robot=rby1", "--cameras=", "--workers=1", "--quiet", f"--json={out}.json")
        assert main(["retarget", f"--root={g1}", f"--out={out}", *flags]) == 0
    assert_same_rows(rby1, again)
    (figures,) = json.loads(Path(f"{rby1}.json").read_text())["episodes"]
    assert figures["tracking_head_mean"] < 0.20
    assert not figures["fall"]

    old, new = read(g1), read(rby1)[: len(read(g1))]
    np.testing.assert_allclose(stack(new, "operator.head"), stack(old, "operator.head"), atol=1e-6)
    # Both start with their own head at their own heading; from there the heads' goals travel alike.
    for goals in (stack(old, "goal.head"), stack(new, "goal.head")):
        assert np.linalg.norm(goals[-1, :2] - goals[0, :2]) == pytest.approx(
            np.linalg.norm(person.poses[-1, 0, :2] - person.poses[0, 0, :2]), abs=1e-4
        )
    # Hands are as far from the head as the person's, over the scale of the robot.
    for rows in (old, new):
        lengths = [
            np.linalg.norm(
                (stack(rows, f"{of}.left_wrist") - stack(rows, f"{of}.head"))[:, :3], axis=1
            )
            for of in ("goal", "operator")
        ]
        scale = lengths[0] / lengths[1]
        np.testing.assert_allclose(scale, scale[0], rtol=1e-4)
    robots = {facts["robot"] for root in (g1, rby1) for facts in read_facts(root)}
    assert robots == {"xop_g1", "xop_rby1"}
    assert stack(new, "action").shape[1] != stack(old, "action").shape[1]
