"""Sessions of a G1 that were killed, beside a whole one: restored, merged, labelled and split.

They are made by `scripts/make_mixed_dataset.py`.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from curate_data import compute_digests
from curate_recorded import load, read_pictures, read_rows

from xop_lerobot.dataset.curate.cli import main
from xop_lerobot.dataset.facts import read_facts

SCRIPT = Path(__file__).parents[1] / "scripts/make_mixed_dataset.py"
HEAD = "observation.images.head"
EPISODES = 4
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def mixed(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("mixed") / "mixed"
    command = [sys.executable, str(SCRIPT), f"--out={folder}", f"--episodes={EPISODES}"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


@pytest.fixture(scope="module")
def kinds(mixed) -> list[str]:
    return json.loads((mixed / "kinds.json").read_text())


@pytest.fixture(autouse=True)
def nothing_changes(mixed):
    before = compute_digests(mixed)
    yield
    assert compute_digests(mixed) == before


def find(kinds: list[str], *names: str) -> list[int]:
    return [index for index, kind in enumerate(kinds) if kind in names]


def test_trimmed_pictures_are_those_of_their_rows(mixed, kinds, tmp_path):
    out, root = tmp_path / "out", mixed / "session"
    assert main(["trim", "--root", str(root), "--out", str(out), "--margin", "0.3"]) == 0
    cut = {}
    for row in read_facts(out):
        step = row["provenance"][-1]
        cut[step["source_episode"]] = (step["source_rows"], row["length"])
    starts = [index for index, (rows, _) in cut.items() if rows[0] > 25]
    assert starts == find(kinds, "idle_start")
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


@pytest.mark.parametrize("name", ["killed", "killed_stock"])
def test_repair(mixed, name, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["repair", "--root", str(mixed / name), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "of an unfinished episode: left out" in said
    assert "whole: 3 episodes" in said
    dataset = load("local/out", root=out)
    assert dataset.num_episodes == 3
    dataset[len(dataset) - 1]
    if name == "killed_stock":  # it was recorded of the first episodes of the whole session
        for episode in range(3):
            rows, expected = read_rows(out, episode), read_rows(mixed / "session", episode)
            np.testing.assert_array_equal(np.stack(rows["action"]), np.stack(expected["action"]))


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
    names = {"train": 6, "val": 1}
    for name, count in names.items():
        dataset = load("local/part", root=parts / name)
        assert dataset.num_episodes == count
        dataset[len(dataset) - 1]
    facts = read_facts(parts / "val")
    verbs = [[step["verb"] for step in row["provenance"]] for row in facts]
    assert verbs == [["repair", "merge", "label", "split"]]
    assert all(row["robot"] == "xop_g1" and row["subtasks"] for row in facts)
    configs = list((parts / "val/meta/xop/configs").glob("*.json"))
    assert len(configs) == 2  # of two sessions
