"""The verbs on sessions of mixed episodes of a G1 in simulation: each does the right thing.

One is whole, one was killed: that is restored, merged, labelled and split. They are made by
`benchmarks/run_make_mixed_dataset.py`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from curate_data import compute_digests
from curate_recorded import load, read_pictures, read_rows

from xop_lerobot.curate.cli import main
from xop_lerobot.recording.facts import read_facts

pytestmark = pytest.mark.slow

REPO = Path(__file__).parents[2]
HEAD = "observation.images.head"
EPISODES = 10
"""The script makes every kind once within ten."""


@pytest.fixture(scope="module")
def mixed(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("mixed")
    script = [sys.executable, "-m", "benchmarks.run_make_mixed_dataset", "--out", str(out)]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(
            str(REPO / name) for name in (".", "robots", "teleoperators")
        ),
        "HF_LEROBOT_HOME": str(out / "home"),
    }
    flags = ["--episodes", str(EPISODES)]
    done = subprocess.run(
        [*script, *flags], cwd=REPO, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return out


@pytest.fixture(autouse=True)
def nothing_changes(mixed):
    """No verb may change a byte of what it reads."""
    before = compute_digests(mixed)
    yield
    assert compute_digests(mixed) == before


@pytest.fixture
def session(mixed) -> Path:
    return mixed / "session"


@pytest.fixture(scope="module")
def kinds(mixed) -> list[str]:
    return json.loads((mixed / "kinds.json").read_text())


def find(kinds: list[str], *names: str) -> list[int]:
    return [index for index, kind in enumerate(kinds) if kind in names]


def inspect(root: Path, capsys) -> list[dict]:
    assert main(["inspect", "--root", str(root), "--json", "-"]) == 0
    return json.loads(capsys.readouterr().out)


def test_figures_tell_the_kinds(session, kinds, capsys):
    rows = inspect(session, capsys)
    assert len(rows) == len(kinds) == EPISODES
    assert set(kinds) == {"success", "failure", "fall", "tracking_loss", "idle_start", "idle_both"}
    for row, kind in zip(rows, kinds, strict=True):
        assert row["success"] is (kind in ("success", "idle_start", "idle_both")), kind
        assert row["fall"] is row["collision"] is (kind == "fall"), kind
        assert row["gaps"] == (kind == "tracking_loss"), kind
        assert (row["gap_time"] == pytest.approx(0.8, abs=0.1)) is (kind == "tracking_loss"), kind
        assert row["trouble"] is (kind == "fall"), kind
        assert row["tracking_p95"] < 1.5
        assert (row["command_roughness"] < 1.0) is (kind == "failure"), kind
        assert row["robot"] == "xop_g1"
        assert row["missing_frames"] == row["dropped_frames"] == 0
        assert row["readable"]
    starts = {kind: row["idle_start"] for row, kind in zip(rows, kinds, strict=True)}
    assert starts["idle_start"] == pytest.approx(2.0, abs=0.2)
    assert starts["idle_both"] == pytest.approx(1.4, abs=0.2)
    assert starts["success"] < 0.5
    ends = {kind: row["idle_end"] for row, kind in zip(rows, kinds, strict=True)}
    assert ends["idle_both"] > 0.8
    assert ends["success"] < 0.5


@pytest.mark.parametrize(
    ("where", "expected"),
    [
        ("success and not fall", {"success", "idle_start", "idle_both"}),
        ("fall", {"fall"}),
        ("gaps > 0", {"tracking_loss"}),
        ("success and idle_start + idle_end < 1", {"success"}),
        ("not success and not fall and gaps == 0", {"failure"}),
        ("trouble or gap_max > 0.5", {"fall", "tracking_loss"}),
    ],
)
def test_filters_choose_kinds(session, kinds, capsys, where, expected):
    assert main(["filter", "--root", str(session), "--where", where, "--dry-run"]) == 0
    text = capsys.readouterr().out
    dropped = [i for i, kind in enumerate(kinds) if kind not in expected]
    assert f"{EPISODES - len(dropped)} of {EPISODES} episodes kept" in text
    assert f"left out: {', '.join(map(str, dropped))}\n" in text


def test_filtered_dataset_loads_and_has_the_same_figures(session, kinds, tmp_path, capsys):
    out = tmp_path / "good"
    assert main(["filter", "--root", str(session), "--out", str(out), "--where", "success"]) == 0
    capsys.readouterr()
    before = [row for row in inspect(session, capsys) if row["success"]]
    after = inspect(out, capsys)
    for old, new in zip(before, after, strict=True):
        assert new == {**old, "episode": new["episode"]}
    dataset = load("local/good", root=out)
    assert dataset.num_episodes == len(before)
    assert dataset[len(dataset) - 1]["observation.images.head"].shape[0] == 3
    steps = [row["provenance"][-1] for row in read_facts(out)]
    assert [step["source_episode"] for step in steps] == [row["episode"] for row in before]
    assert {step["verb"] for step in steps} == {"filter"}


def test_trim_cuts_what_inspect_calls_idle(session, tmp_path, capsys):
    out = tmp_path / "trimmed"
    assert main(["trim", "--root", str(session), "--out", str(out), "--margin", "0.2"]) == 0
    capsys.readouterr()
    for old, new in zip(inspect(session, capsys), inspect(out, capsys), strict=True):
        start = max(0, old["idle_start"] - 0.2)
        assert new["duration"] <= old["duration"] - start + 0.05
        assert new["idle_start"] == pytest.approx(min(old["idle_start"], 0.2), abs=0.3)
        assert (new["success"], new["fall"]) == (old["success"], old["fall"])


def test_trimmed_pictures_are_those_of_their_rows(session, kinds, tmp_path):
    out, root = tmp_path / "out", session
    assert main(["trim", "--root", str(root), "--out", str(out), "--margin", "0.3"]) == 0
    cut = {}
    for row in read_facts(out):
        step = row["provenance"][-1]
        cut[step["source_episode"]] = (step["source_rows"], row["length"])
    starts = [index for index, (rows, _) in cut.items() if rows[0] > 20]
    assert starts == find(kinds, "idle_start", "idle_both")
    assert all(cut[index][0][0] > 25 for index in find(kinds, "idle_start"))
    for index in starts:
        (start, stop), length = cut[index]
        assert stop - start == length
        old, new = read_rows(root, index), read_rows(out, index)
        assert new["time.wall"].tolist() == old["time.wall"][start:stop].tolist()
        whole = read_pictures(root, index, HEAD, 25)
        np.testing.assert_array_equal(read_pictures(out, index, HEAD, 25), whole[start:stop])
        # The person's head goes down by a hand's breadth only after the cut.
        assert (
            np.stack(new["operator.head"])[0, 2] > np.stack(new["operator.head"])[:, 2].max() - 0.02
        )
    assert [row["success"] for row in read_facts(out)] == [
        row["success"] for row in read_facts(root)
    ]


def test_what_is_split_and_merged_is_the_same(session, tmp_path, capsys):
    parts, whole = tmp_path / "parts", tmp_path / "whole"
    flags = ["--parts", "first=0:4", "second=4:10"]
    assert main(["split", "--root", str(session), "--out", str(parts), *flags]) == 0
    roots = ["--root", str(parts / "first"), "--root", str(parts / "second")]
    assert main(["merge", *roots, "--out", str(whole)]) == 0
    capsys.readouterr()
    assert inspect(whole, capsys) == inspect(session, capsys)


def test_label_by_rule(session, kinds, tmp_path, capsys):
    out = tmp_path / "labelled"
    rule = "not fall and gaps == 0 and duration < 4"
    assert main(["label", "--root", str(session), "--out", str(out), "--success", rule]) == 0
    capsys.readouterr()
    expected = [not row["fall"] and row["gaps"] == 0 and row["duration"] < 4
                for row in inspect(session, capsys)]  # fmt: skip
    assert [row["success"] for row in inspect(out, capsys)] == expected
    assert len(set(expected)) == 2


def test_repair_of_a_whole_session_changes_nothing(session, tmp_path, capsys):
    code = main(["repair", "--root", str(session), "--out", str(tmp_path / "repaired")])
    text = capsys.readouterr()
    assert code == 0, text
    if (tmp_path / "repaired").exists():
        assert inspect(tmp_path / "repaired", capsys) == inspect(session, capsys)


# A session that was killed.


def test_repair(mixed, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["repair", "--root", str(mixed / "killed"), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "of an unfinished episode: left out" in said
    assert "complete: 3 episodes" in said
    dataset = load("local/out", root=out)
    assert dataset.num_episodes == 3
    dataset[len(dataset) - 1]


def test_killed_session_joins_the_whole_one(mixed, tmp_path):
    """Repair, merge, label, split: facts and files come along all the way."""
    restored, week, labelled, parts = (tmp_path / name for name in ("a", "b", "c", "d"))
    steps = [
        ["repair", "--root", f"{mixed}/killed", "--out", str(restored)],
        ["merge", "--root", f"{mixed}/session", str(restored), "--out", str(week)],
        ["label", "--root", str(week), "--out", str(labelled), "--success", "success and not fall",
         "--subtask", "down=robot_head_z < 1.1"],
        ["split", "--root", str(labelled), "--out", str(parts), "--parts", "train=0.8", "val=0.2"],
    ]  # fmt: skip
    for words in steps:
        assert main([*words, "--quiet"]) == 0, words
    names = {"train": EPISODES, "val": 3}
    for name, count in names.items():
        dataset = load("local/part", root=parts / name)
        assert dataset.num_episodes == count
        dataset[len(dataset) - 1]
    facts = read_facts(parts / "val")
    verbs = [[step["verb"] for step in row["provenance"]] for row in facts]
    assert verbs == 3 * [["repair", "merge", "label", "split"]]
    assert all(row["robot"] == "xop_g1" for row in facts)
    assert facts[-1]["subtasks"]
    configs = list((parts / "val/meta/xop/configs").glob("*.json"))
    assert len(configs) == 2  # of two sessions
