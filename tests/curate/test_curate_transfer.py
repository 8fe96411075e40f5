"""Episodes go from dataset to dataset whole or cut, and nothing about them is lost."""

from __future__ import annotations

import json
from fractions import Fraction
from typing import Any

import numpy as np
import pandas as pd
import pytest
from curate_data import compute_digests, make_foreign
from curate_recorded import (
    CAMERA,
    FPS,
    add_episodes,
    load,
    make_packed,
    read_metadata,
    read_pictures,
    read_rows,
    read_stats,
    record_toy,
)
from lerobot.datasets.compute_stats import aggregate_stats, compute_episode_stats
from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets
from PIL import Image
from toy_robot import make_teleop, make_toy

from xop_lerobot.core.errors import BadDataset, BadShape, BadValue
from xop_lerobot.curate.cli import main
from xop_lerobot.curate.clip import Clip, Step, cut_changes
from xop_lerobot.curate.source import Source
from xop_lerobot.curate.transfer import NothingLeft, transfer
from xop_lerobot.curate.video import VideoIndex
from xop_lerobot.recording.dataset import XopDataset
from xop_lerobot.recording.facts import read_facts

HEAD = "observation.images.head"
COUNTED = ["timestamp", "frame_index", "episode_index", "index"]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return record_toy(tmp_path_factory.mktemp("recorded") / "toy", session="transfer")


def copy_clips(root, out, spans, **step):
    """Transfer the episodes that `spans` names; None is the whole."""
    with Source(root) as source:
        entries = {entry.index: entry for entry in source.episodes}
        clips = [Clip(source, entries[index], rows) for index, rows in spans]
        return transfer(iter(clips), out, Step.now("test", **step))


def check_same(root, out, spans, fps, key):
    """Rows and pictures of `out` are those of `root`, frame by frame."""
    index = 0
    for number, (episode, rows) in enumerate(spans):
        before, after = read_rows(root, episode), read_rows(out, number)
        start, stop = rows or (0, len(before))
        expected = before[start:stop].reset_index(drop=True)
        pd.testing.assert_frame_equal(
            after.drop(columns=[*COUNTED, "task_index"]),
            expected.drop(columns=[*COUNTED, "task_index"]),
        )
        n = stop - start
        assert after["frame_index"].tolist() == list(range(n))
        assert after["index"].tolist() == list(range(index, index + n))
        np.testing.assert_allclose(after["timestamp"], np.arange(n) / fps, atol=1e-6)
        index += n
        whole = read_pictures(root, episode, key, fps)
        np.testing.assert_array_equal(read_pictures(out, number, key, fps), whole[start:stop])


SPANS = [(0, None), (1, (7, 20)), (2, (1, 36))]


@pytest.mark.slow
def test_rows_and_pictures_are_the_same(recorded, tmp_path):
    before = compute_digests(recorded)
    done = copy_clips(recorded, tmp_path / "out", SPANS)
    assert (done.episodes, done.frames) == (3, 30 + 13 + 35)
    check_same(recorded, tmp_path / "out", SPANS, 25, HEAD)
    assert compute_digests(recorded) == before


@pytest.mark.slow
@pytest.mark.parametrize(
    "encoder",
    [
        {},
        {"g": 30},
        {"vcodec": "h264", "g": 40, "preset": "medium"},
        # Groups of pictures that refer to the one before.
        {"vcodec": "hevc", "g": 12, "preset": "fast"},
    ],
    ids=lambda encoder: "-".join(map(str, encoder.values())) or "av1",
)
def test_packed_videos_are_cut_exactly(tmp_path, encoder):
    root = tmp_path / "packed"
    make_packed(root, **encoder)
    spans = [(0, (5, 30)), (1, None), (2, (3, 44)), (0, (36, 37))]
    copy_clips(root, tmp_path / "out", spans)
    check_same(root, tmp_path / "out", spans, FPS, CAMERA)
    # What comes from one file goes to one file.
    assert len(list((tmp_path / "out").glob("videos/*/*/*.mp4"))) == 1
    assert len(list((tmp_path / "out").glob("data/*/*.parquet"))) == 1


def test_lerobot_reads_the_same(tmp_path):
    make_packed(tmp_path / "packed")
    spans = [(2, (10, 40)), (1, None)]
    copy_clips(tmp_path / "packed", tmp_path / "out", spans)
    old = load("local/old", root=tmp_path / "packed")
    new = load("local/new", root=tmp_path / "out")
    assert len(new) == 30 + 25
    for row, frame in ((0, 62 + 10), (29, 62 + 39), (30, 37), (54, 61)):
        assert new[row]["task"] == old[frame]["task"]
        for key in ("action", CAMERA):
            assert bool((new[row][key] == old[frame][key]).all()), (row, key)


def test_whole_videos_are_copied_byte_by_byte(recorded, tmp_path):
    copy_clips(recorded, tmp_path / "out", [(2, None), (0, None)])
    old, new = compute_digests(recorded), compute_digests(tmp_path / "out")
    folder = f"videos/{HEAD}/chunk-000"
    assert new[f"{folder}/file-000.mp4"] == old[f"{folder}/file-002.mp4"]
    assert new[f"{folder}/file-001.mp4"] == old[f"{folder}/file-000.mp4"]


def test_twice_the_same(recorded, tmp_path):
    for name in ("one", "two"):
        copy_clips(recorded, tmp_path / name, SPANS)
    assert compute_digests(tmp_path / "one") == compute_digests(tmp_path / "two")


@pytest.mark.slow
def test_agrees_with_lerobot(recorded, tmp_path):
    """LeRobot's delete and merge, where they keep what they know, give the same."""
    copy_clips(recorded, tmp_path / "ours", [(0, None), (2, None)])
    stock = load("local/toy", root=recorded)
    theirs = delete_episodes(stock, [1], tmp_path / "theirs", "local/theirs")
    for episode in (0, 1):
        ours = read_rows(tmp_path / "ours", episode)
        rows = read_rows(theirs.root, episode)
        pd.testing.assert_frame_equal(ours, rows[ours.columns], check_dtype=False)
    stats = read_stats(tmp_path / "ours")
    for key, parts in read_stats(theirs.root).items():
        if key in (*COUNTED, "task_index"):  # LeRobot keeps those from before the deletion
            continue
        for kind, value in parts.items():
            np.testing.assert_allclose(
                np.asarray(stats[key][kind], float), np.asarray(value, float), atol=1e-9
            )


def flatten(nested) -> list[float]:
    """Numbers of nested lists or arrays."""
    if np.ndim(nested) == 0:
        return [float(nested)]
    return [number for part in nested for number in flatten(part)]


def test_statistics(recorded, tmp_path):
    """Those of cut episodes are what LeRobot computes of the rows and pictures that stay."""
    out = tmp_path / "out"
    copy_clips(recorded, out, SPANS)
    features = Source(out).features
    metadata = read_metadata(out)
    episodes = []
    for episode in range(3):
        rows = read_rows(out, episode)
        data: dict[str, Any] = {key: np.stack(rows[key]) for key in rows.columns}
        expected = compute_episode_stats(data, features)
        if episode:
            paths = []
            for i, picture in enumerate(read_pictures(out, episode, HEAD, 25)):
                paths.append(str(tmp_path / f"{i}.png"))
                Image.fromarray(picture).save(paths[-1])
            expected |= compute_episode_stats({HEAD: paths}, features)
        found = metadata.loc[episode].to_dict()
        for key, parts in expected.items():
            for kind, value in parts.items():
                actual = flatten(found[f"stats/{key}/{kind}"])
                np.testing.assert_allclose(
                    actual, np.ravel(value).astype(float), atol=1e-6, err_msg=f"{key} {kind}"
                )
        episodes.append(expected)
    whole = read_stats(out)
    numbers = [{key: each[key] for key in each if key != HEAD} for each in episodes]
    for key, parts in aggregate_stats(numbers).items():
        np.testing.assert_allclose(whole[key]["mean"], parts["mean"], atol=1e-6)
        assert whole[key]["count"] == parts["count"]


def test_facts_come_along(recorded, tmp_path):
    out = tmp_path / "out"
    copy_clips(recorded, out, [(2, (4, 20)), (0, None)], limit=3, off=None)
    old, new = read_facts(recorded), read_facts(out)
    assert [row["episode_index"] for row in new] == [0, 1]
    assert [row["length"] for row in new] == [16, 30]
    for name in ("seed", "task", "success", "start_time", "versions", "settings", "config_hash"):
        assert new[0][name] == old[2][name]
    record = new[0]["provenance"][-1]
    assert record["verb"] == "test"
    assert record["arguments"] == {"limit": 3}
    assert record["source"].endswith("/toy")
    assert (record["source_episode"], record["source_rows"]) == (2, [4, 20])
    assert "lerobot" in record["versions"]
    metadata = read_metadata(out)
    assert metadata.loc[0, "xop/seed"] == old[2]["seed"]
    assert json.loads(metadata.loc[0, "xop/provenance"]) == new[0]["provenance"]
    config = (out / "meta/xop/config.json").read_text()
    assert config == (recorded / "meta/xop/config.json").read_text()
    assert (out / f"meta/xop/configs/{old[0]['config_hash']}.json").read_text() == config


def test_provenance_adds_up(recorded, tmp_path):
    copy_clips(recorded, tmp_path / "one", [(1, None), (2, (5, 30))])
    copy_clips(tmp_path / "one", tmp_path / "two", [(1, (1, 10))])
    steps = read_facts(tmp_path / "two")[0]["provenance"]
    assert [(step["source_episode"], step["source_rows"]) for step in steps] == [
        (2, [5, 30]),
        (1, [1, 10]),
    ]


def test_changes_are_cut_along():
    changes = [{"frame": 2, "a": 1}, {"frame": 10, "a": 2}, {"frame": 30, "a": 3}, {"a": 4}]
    assert cut_changes(changes, 5, 30) == [
        {"frame": 0, "a": 1},
        {"frame": 5, "a": 2},
        {"a": 4},
    ]


@pytest.mark.slow
def test_new_columns_and_another_task(recorded, tmp_path):
    with Source(recorded) as source:
        entry = next(source.episodes)
        column = np.arange(entry.length)[:, None]
        clip = Clip(source, entry, columns={"extra": column}, task="dance", facts={"mood": "good"})
        feature = {"dtype": "int64", "shape": [1], "names": None}
        transfer([clip], tmp_path / "out", Step.now("test"), {"extra": feature})
    dataset = load("local/out", root=tmp_path / "out")
    assert int(dataset[7]["extra"]) == 7
    assert dataset[7]["task"] == "dance"
    facts = read_facts(tmp_path / "out")[0]
    assert (facts["mood"], facts["task"]) == ("good", "dance")
    assert dataset.meta.stats["extra"]["max"] == [entry.length - 1]


@pytest.mark.slow
def test_pictures_in_the_rows(tmp_path):
    root = record_toy(tmp_path / "png", (12, 14), session="png", video=False)
    copy_clips(root, tmp_path / "out", [(1, (3, 9))])
    old = load("local/old", root=root)
    new = load("local/new", root=tmp_path / "out")
    for row in range(6):
        assert bool((new[row][HEAD] == old[12 + 3 + row][HEAD]).all())
    assert new.meta.stats[HEAD]["count"] == [6]


@pytest.mark.slow
def test_recording_goes_on_in_it(recorded, tmp_path):
    """`--resume` adds to a curated dataset, and LeRobot loads both parts."""
    out = tmp_path / "out"
    copy_clips(recorded, out, [(0, (2, 20)), (1, None)])
    robot, teleop = make_toy("goes_on"), make_teleop("goes_on")
    teleop.connect()
    robot.connect()
    dataset = XopDataset.bind("goes_on").resume("local/out", root=out)
    add_episodes(robot, teleop, dataset, (10,))
    dataset.finalize()
    teleop.disconnect()
    robot.disconnect()
    loaded = load("local/out", root=out)
    assert len(loaded) == 18 + 24 + 10
    assert loaded[51]["frame_index"] == 9
    with Source(out) as source:
        lengths = [(entry.index, entry.length, bool(entry.facts)) for entry in source.episodes]
    assert lengths == [(0, 18, True), (1, 24, True), (2, 10, True)]


def test_other_datasets_have_no_facts_made_up(tmp_path):
    root = make_foreign(tmp_path / "foreign")
    copy_clips(root, tmp_path / "out", [(1, (5, 25))])
    assert set(read_facts(tmp_path / "out")[0]) == {"episode_index", "length", "provenance"}
    columns = read_metadata(tmp_path / "out").columns
    assert [name for name in columns if name.startswith("xop/")] == ["xop/provenance"]


def test_nothing_is_left(tmp_path):
    with pytest.raises(NothingLeft, match=r"^no episode is left, so no dataset is made$"):
        transfer([], tmp_path / "out", Step.now("test"))
    assert not (tmp_path / "out").exists()


def test_clips_that_are_none(recorded):
    with Source(recorded) as source:
        entry = next(source.episodes)
        with pytest.raises(BadValue) as error:
            Clip(source, entry, (20, 31))
        assert str(error.value) == ("episode 0 has the rows 0 to 30; got 20 to 31")
        with pytest.raises(BadShape):
            Clip(source, entry, (0, 10), columns={"action": np.zeros((30, 2))})


def test_pictures_that_are_missing_are_refused(tmp_path):
    root = tmp_path / "packed"
    make_packed(root)
    (video,) = root.glob("videos/*/*/*.mp4")
    video.write_bytes(video.read_bytes()[: video.stat().st_size * 3 // 4])
    copy_clips(root, tmp_path / "out", [(0, None)])  # its pictures are before the cut
    with pytest.raises(BadDataset) as error:
        copy_clips(root, tmp_path / "bad", [(2, None)])
    assert "file-000.mp4 lacks " in str(error.value)
    assert "of the 44 images from 3.100 s on, at 20 Hz" in str(error.value)


def test_missing_pictures_are_counted():
    index = VideoIndex(np.array([0, 1, 2, 4, 5]), np.ones(5, bool), time_base=Fraction(1, 10))
    assert index.count_missing(0.0, 6, 10) == 1
    assert index.count_missing(0.4, 4, 10) == 2
    assert VideoIndex(np.array([]), np.array([]), Fraction(1)).count_missing(0.0, 3, 10) == 3


# Merge and split.


@pytest.mark.slow
def test_merge(recorded, tmp_path, capsys):
    copy_clips(recorded, tmp_path / "part", [(2, (0, 10))])
    out = tmp_path / "out"
    code = main(["merge", "--root", str(recorded), str(tmp_path / "part"), "--out", str(out)])
    assert code == 0
    text = capsys.readouterr().out
    assert text == f"4 episodes, 100 frames of 2 datasets, written to {out.resolve()}\n"
    check_same(recorded, out, [(0, None), (1, None), (2, None), (2, (0, 10))], 25, HEAD)
    sources = [row["provenance"][-1]["source"].rpartition("/")[2] for row in read_facts(out)]
    assert sources == ["toy"] * 3 + ["part"]
    names = [str(recorded), str(tmp_path / "part")]
    datasets = [load(f"local/{i}", root=name) for i, name in enumerate(names)]
    theirs = merge_datasets(datasets, "local/theirs", tmp_path / "theirs")
    for episode in range(4):
        ours, rows = read_rows(out, episode), read_rows(theirs.root, episode)
        pd.testing.assert_frame_equal(ours, rows[ours.columns], check_dtype=False)


def test_merge_numbers_tasks_anew(tmp_path):
    make_packed(tmp_path / "one", (5,), vcodec="h264")
    make_packed(tmp_path / "two", (4, 6), vcodec="h264")
    copy_clips(tmp_path / "two", tmp_path / "second", [(1, None)])  # task 1 alone
    roots = [str(tmp_path / name) for name in ("second", "one")]
    assert main(["merge", "--root", *roots, "--out", str(tmp_path / "out")]) == 0
    dataset = load("local/out", root=tmp_path / "out")
    assert [dataset[i]["task"] for i in (0, 5, 6, 10)] == ["task 1", "task 1", "task 0", "task 0"]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"fps": 30}, "its fps is 30, that of '{one}' is 20"),
        ({"robot_type": "other"}, "its robot_type is other, that of '{one}' is so100"),
    ],
)
def test_merge_refuses_what_differs(tmp_path, capsys, change, text):
    for name in ("one", "two"):
        make_packed(tmp_path / name, (4,), vcodec="h264")
    path = tmp_path / "two" / "meta/info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    roots = [str(tmp_path / "one"), str(tmp_path / "two")]
    capsys.readouterr()
    assert main(["merge", "--root", *roots, "--out", str(tmp_path / "out")]) == 1
    expected = f"error: dataset '{roots[1]}': {text.format(one=roots[0])}\n"
    assert capsys.readouterr().err == expected
    assert not (tmp_path / "out").exists()


def test_merge_refuses_one_twice(recorded, tmp_path, capsys):
    words = [
        "merge",
        "--root",
        str(recorded),
        "--root",
        str(recorded),
        "--out",
        str(tmp_path / "o"),
    ]
    assert main(words) == 2
    assert "names a dataset twice" in capsys.readouterr().err


def test_split(recorded, tmp_path, capsys):
    out = tmp_path / "out"
    code = main(
        ["split", "--root", str(recorded), "--out", str(out), "--parts", "train=0,2", "val=1:2"]
    )
    assert code == 0
    assert capsys.readouterr().out == (
        f"train: 2 episodes (0, 2)\nval: 1 episode (1)\nwritten to {out.resolve()}\n"
    )
    check_same(recorded, out / "train", [(0, None), (2, None)], 25, HEAD)
    check_same(recorded, out / "val", [(1, None)], 25, HEAD)
    assert read_facts(out / "val")[0]["provenance"][-1]["arguments"] == {"part": "val"}


def test_split_by_fractions(recorded, tmp_path, capsys):
    words = ["split", "--root", str(recorded), "--dry-run", "--parts", "a=0.67", "b=0.33"]
    assert main(words) == 0
    assert capsys.readouterr().out == "a: 2 episodes (0:2)\nb: 1 episode (2)\n"
    assert main([*words, "--shuffle", "1"]) == 0
    shuffled = capsys.readouterr().out
    assert main([*words, "--shuffle", "1"]) == 0
    assert capsys.readouterr().out == shuffled


@pytest.mark.parametrize(
    ("parts", "text"),
    [
        (["a=0.5", "b=0.6"], "the fractions of --parts must add up to 1 at most, got 1.1"),
        (["a=0.5", "b=1"], "--parts must be all fractions or all lists of episodes"),
        (["a=x"], "--parts takes NAME=FRACTION or NAME=EPISODES"),
        (["../a=1"], "--parts takes NAME=FRACTION or NAME=EPISODES"),
        (["a=1", "a=2"], "--parts has 'a' twice"),
        (["a=1", "b=0,1"], "episode 1 is in the parts 'a' and 'b'"),
        (["a=7"], "part 'a' asks for episode 7. There are 0:3"),
        (["a=0.1", "b=0.9"], "part 'a' would have no episode; there are 3 in all"),
    ],
)
def test_split_refuses(recorded, tmp_path, capsys, parts, text):
    words = ["split", "--root", str(recorded), "--out", str(tmp_path / "out"), "--parts", *parts]
    assert main(words) == 2
    assert capsys.readouterr().err.startswith(f"error: {text}")
    assert not (tmp_path / "out").exists()
