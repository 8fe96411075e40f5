"""Labels by rule, by hand and from a file, in the facts and in the columns."""

from __future__ import annotations

import io
import json

import numpy as np
import pandas as pd
import pytest
from curate_data import compute_digests, make_foreign, make_synthetic
from curate_recorded import load, read_rows, record_toy

from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.curate.cli import main
from xop_lerobot.curate.label import FrameRules, list_entries
from xop_lerobot.curate.label_by_hand import LabelSession, ask, read_images
from xop_lerobot.curate.labels import (
    Label,
    list_runs,
    number_frames,
    read_labels,
    set_success,
    write_labels,
)
from xop_lerobot.curate.source import Source
from xop_lerobot.recording.facts import read_facts

EPISODES, FRAMES, FPS = 4, 60, 25


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return make_synthetic(tmp_path_factory.mktemp("label") / "base", EPISODES, FRAMES)


def run(root, out, *flags, code: int = 0) -> None:
    assert main(["label", "--root", str(root), "--out", str(out), "--quiet", *flags]) == code


# By rule.


def test_success_by_rule(base, tmp_path, capsys):
    before = compute_digests(base)
    run(base, tmp_path / "out", "--success", "episode in (1, 2)")
    assert compute_digests(base) == before
    old = [row["success"] for row in read_facts(base)]
    new = [row["success"] for row in read_facts(tmp_path / "out")]
    assert new == [False, True, True, False]
    changed = ", ".join(str(i) for i in range(4) if old[i] != new[i])
    assert capsys.readouterr().out.startswith(
        f"success: 2 yes, 2 no, 0 as before; changed: {changed or 'none'}\n"
    )
    for episode in range(4):
        column = read_rows(tmp_path / "out", episode)["next.success"]
        assert bool(column.iloc[-1]) == new[episode]
        assert new[episode] or not column.any()
    dataset = load("local/out", root=tmp_path / "out")
    assert bool(dataset[2 * FRAMES - 1]["next.success"])


def test_unknown_leaves_the_label(tmp_path, capsys):
    root = make_foreign(tmp_path / "foreign", 2, 10, video=False)
    run(root, tmp_path / "out", "--success", "episode == 0 and tracking_p95 < 0.1")
    assert "success: 0 yes, 1 no, 1 as before" in capsys.readouterr().out
    facts = read_facts(tmp_path / "out")
    assert [row.get("success") for row in facts] == [None, False]
    # A column that all episodes have to have, where none had it.
    assert not read_rows(tmp_path / "out", 0)["next.success"].any()
    assert Source(tmp_path / "out").features["next.success"]["dtype"] == "bool"


def test_set_success():
    column = np.array([0, 1, 1, 0], bool)[:, None]
    assert set_success(column, 4, True)[:, 0].tolist() == [False, True, True, True]
    assert not set_success(column, 4, False).any()
    assert column[:, 0].tolist() == [False, True, True, False]
    assert set_success(None, 3, True)[:, 0].tolist() == [False, False, True]


def test_subtasks_by_rule(base, tmp_path, capsys):
    rules = ["--subtask", "first=time < 0.5", "--subtask", "far=robot_head_x > 0.2 and left > 0.4"]
    run(base, tmp_path / "out", *rules)
    names = pd.read_parquet(tmp_path / "out/meta/subtasks.parquet")
    assert names.index.tolist() == ["first", "far", "other"]
    assert names["subtask_index"].tolist() == [0, 1, 2]
    runs = []
    for episode in range(EPISODES):
        rows = read_rows(tmp_path / "out", episode)
        time = rows["frame_index"] / FPS
        head, left = np.stack(rows["robot.head"])[:, 0], (FRAMES - 1) / FPS - time
        expected = np.where(time < 0.5, 0, np.where((head > 0.2) & (left > 0.4), 1, 2))
        assert rows["subtask_index"].tolist() == expected.tolist()
        runs = read_facts(tmp_path / "out")[episode]["subtasks"]
        assert runs[0] == {"name": "first", "start": 0, "stop": 13}
        assert runs[-1]["stop"] == FRAMES
    assert "sub-tasks: first 2.08 s, far " in capsys.readouterr().out
    # They go along when the dataset is curated further.
    words = ["split", "--root", str(tmp_path / "out"), "--out", str(tmp_path / "parts")]
    assert main([*words, "--parts", "a=3"]) == 0
    pd.testing.assert_frame_equal(
        pd.read_parquet(tmp_path / "parts/a/meta/subtasks.parquet"), names
    )
    assert read_facts(tmp_path / "parts/a")[0]["subtasks"] == runs


def test_entries_of_rules(base):
    entries = list_entries(Source(base).features)
    assert entries["robot_left_wrist_qw"][:2] == ("robot.left_wrist", 3)
    assert entries["action_mode_pos"].column == "action"
    assert entries["next_success"][:2] == ("next.success", 0)
    assert "task_index" not in entries
    assert list_entries({"a": {"dtype": "float32", "shape": [2], "names": None}}).keys() == {
        "a_0",
        "a_1",
    }


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("robot_head_z < 1", BadValue, "--subtask takes NAME=EXPRESSION"),
        ("down=", BadValue, "--subtask takes NAME=EXPRESSION"),
        ("down=robot_head_zz < 1", UnknownName, "unknown metric 'robot_head_zz'. Did you mean"),
        ("down=robot_head_z", BadValue, "expression 'robot_head_z': 'robot_head_z' is a number"),
    ],
)
def test_bad_rules(base, text, error, message):
    with pytest.raises(error) as caught:
        FrameRules(Source(base), [text])
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize("flags", [[], ["--success", "fall", "--labels", "x"]])
def test_one_way_at_a_time(base, tmp_path, capsys, flags):
    run(base, tmp_path / "out", *flags, code=2)
    assert capsys.readouterr().err == (
        "error: pass exactly one of: rules (--success, --subtask), --labels, --by-hand\n"
    )


# Files of labels.


def test_labels_of_a_file(base, tmp_path):
    path = tmp_path / "labels.json"
    write_labels(path, {2: Label(True, (("reach", 0.4), ("lift", 1.0))), 0: Label(False)})
    run(base, tmp_path / "out", "--labels", str(path))
    facts = read_facts(tmp_path / "out")
    old = read_facts(base)
    assert [row["success"] for row in facts] == [False, old[1]["success"], True, old[3]["success"]]
    assert facts[2]["subtasks"] == [
        {"name": "other", "start": 0, "stop": 10},
        {"name": "reach", "start": 10, "stop": 25},
        {"name": "lift", "start": 25, "stop": 60},
    ]
    assert facts[1]["subtasks"] == [{"name": "other", "start": 0, "stop": 60}]
    assert facts[0]["provenance"][-1]["arguments"] == {"labels": "labels.json"}


def test_labels_round_trip(tmp_path):
    labels = {3: Label(None, (("a", 0.5),)), 1: Label(True)}
    write_labels(tmp_path / "labels.json", labels)
    assert read_labels(tmp_path / "labels.json") == labels
    assert read_labels(tmp_path / "none.json") == {}


def test_frames_of_a_label():
    label = Label(None, (("a", 0.2), ("b", 0.5)))
    numbers = number_frames(label, ["a", "b", "other"], 8, 10, 2)
    assert numbers.tolist() == [2, 2, 0, 0, 0, 1, 1, 1]
    assert list_runs(np.array([1, 1, 0]), ["x", "y"]) == [
        {"name": "y", "start": 0, "stop": 2},
        {"name": "x", "start": 2, "stop": 3},
    ]


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("{", "are not readable"),
        ("[]", "must be one JSON object by episode"),
        ('{"1": {"success": "yes"}}', "episode 1 must have success (true, false or null)"),
        ('{"x": {"success": true}}', "episode x must have"),
        ('{"1": [true]}', "episode 1 must have"),
        ('{"9": {"success": true}}', "there are labels of episode 9, but"),
    ],
)
def test_bad_files_of_labels(base, tmp_path, capsys, content, text):
    path = tmp_path / "labels.json"
    path.write_text(content)
    run(base, tmp_path / "out", "--labels", str(path), code=2)
    assert text in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


# By hand.


def test_session_keeps_every_answer_at_once(tmp_path):
    path = tmp_path / "labels.json"
    session = LabelSession([0, 1, 2], path, ["reach", "lift"])
    assert session.progress == "episode 0 (1 of 3)"
    session.press("2 1.5")
    session.press("1 0.25")
    assert session.marks == (("reach", 0.25), ("lift", 1.5))
    session.press("s")
    assert json.loads(path.read_text()) == {
        "0": {"success": True, "subtasks": [["reach", 0.25], ["lift", 1.5]]}
    }
    session.press("f")
    session.press("q")
    assert session.current is None
    again = LabelSession([0, 1, 2], path)
    assert again.current == 2
    again.press("k")
    assert again.current is None
    assert again.labels[2] == Label(None)


def test_session_goes_back_and_refuses(tmp_path):
    session = LabelSession([4, 7], tmp_path / "labels.json", ["reach"])
    session.press("b")
    assert session.message == "this is the first"
    session.press("1 0.5")
    session.press("c")
    assert session.marks == ()
    session.press("s")
    session.press("b")
    assert session.current == 4
    session.press("f")
    assert session.labels[4] == Label(False)
    session.press("x y")
    assert session.message.startswith("'x y' is no answer. Known: s, f, k, b, q, c")
    session.press("3 1")
    assert session.message == "there is no sub-task 3. Known: 1 reach"
    for word in ("1", "1 soon", "1 -2"):
        session.press(word)
        assert session.message == "missing start time [s], such as '1 1.5'"
    assert session.current == 7


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    return record_toy(tmp_path_factory.mktemp("film") / "toy", (20, 12), session="label")


def test_by_hand_in_a_terminal(filmed, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.stdin", io.StringIO("1 0.2\ns\n\nf\n"))
    path = tmp_path / "labels.json"
    flags = ["--by-hand", str(path), "--names", "reach,lift"]
    run(filmed, tmp_path / "out", *flags)
    assert [row["success"] for row in read_facts(tmp_path / "out")] == [True, False]
    assert read_rows(tmp_path / "out", 0)["subtask_index"].tolist() == [1] * 5 + [0] * 15
    text = capsys.readouterr().out
    strips = [tmp_path / f"labels_strips/episode_{i:06d}.png" for i in range(2)]
    assert f"episode 0 (1 of 2): {strips[0]}\n> 'reach' begins at 0.20 s\n" in text
    assert all(strip.stat().st_size > 1000 for strip in strips)


def test_end_of_input_stops(filmed, tmp_path):
    with Source(filmed) as source:
        labels = ask(source, tmp_path / "labels.json", [], io.StringIO("s\n"))
    assert labels == {0: Label(True)}


def test_images_of_a_strip(filmed):
    with Source(filmed) as source:
        # Three times as large as they are, for the labels.
        images = read_images(source, next(source.episodes), 4)
        assert images["head"].shape == (4, 144, 192, 3)


def test_no_pictures_to_show(base, tmp_path, capsys):
    run(base, tmp_path / "out", "--by-hand", str(tmp_path / "l.json"), code=1)
    assert "episode 0 has no images to show" in capsys.readouterr().err
