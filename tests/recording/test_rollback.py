"""An episode that cannot be written leaves the dataset as it was, and one line says why."""

from __future__ import annotations

import errno
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from lerobot.datasets import LeRobotDataset, dataset_metadata, dataset_writer, image_writer
from lerobot.datasets.video_utils import StreamingVideoEncoder
from lerobot_rows import get_row
from toy_robot import make_toy

from tests.recording import test_dataset
from tests.recording.test_dataset import REPO, STREAMING, create, pair, session, tick  # noqa: F401  fixtures
from xop_lerobot.recording import dataset as xop_dataset
from xop_lerobot.recording.dataset import XopDataset
from xop_lerobot.recording.facts import append_facts, read_facts
from xop_lerobot.recording.opening import NotMade
from xop_lerobot.recording.rollback import NotSaved, find_reason

FULL = "No space left on device"


def is_full(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, FULL)


def read_files(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in root.rglob("*") if p.is_file()}


def record(pair, dataset, frames: int = 3) -> None:  # noqa: F811
    robot, teleop = pair
    for _ in range(frames):
        tick(robot, teleop, dataset)


def cut(path: str):
    """A function that empties a file and then finds the disk full, as `open(..., "w")` does."""

    def write(_: object, root: Path) -> None:
        (root / path).write_text("")
        is_full()

    return write


def fail_thread(_: object) -> None:
    raise RuntimeError(f"Encoder thread for head failed: [Errno 28] {FULL}: 'a.mp4'")


def write_half(root, *_: object) -> None:
    with (root / "meta/xop/episodes.jsonl").open("a") as file:
        file.write('{"episode_in')
    is_full()


POINTS = {
    "rows": (pq.ParquetWriter, "write_table", is_full),
    "the end of the rows' file": (pq.ParquetWriter, "close", is_full),
    "video": (StreamingVideoEncoder, "finish_episode", fail_thread),
    "place of the video": (dataset_writer.shutil, "move", is_full),
    "counts": (dataset_metadata, "write_info", cut("meta/info.json")),
    "statistics": (dataset_metadata, "write_stats", cut("meta/stats.json")),
    "facts": (xop_dataset, "append_facts", write_half),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("point", "rotates"), [*((point, True) for point in POINTS), ("rows", False)]
)
def test_a_full_disk_costs_one_episode(
    session, pair, tmp_path, monkeypatch, point, rotates  # noqa: F811
):  # fmt: skip
    if not rotates:
        monkeypatch.setattr(xop_dataset, "ROTATION", test_dataset.NO_ROTATION)
    root = tmp_path / "data"
    dataset = create(session, pair[0], root, **STREAMING)
    for _ in range(2):
        record(pair, dataset)
        dataset.save_episode()
    before = read_files(root)
    record(pair, dataset)
    owner, name, fail = POINTS[point]
    with monkeypatch.context() as patch, pytest.raises(NotSaved) as caught:
        patch.setattr(owner, name, fail)
        dataset.save_episode()
    dataset.finalize()
    assert str(caught.value) == (
        f"episode 2 could not be saved to '{root}': {FULL}. What was saved before it is complete: "
        "2 episodes. Fix the cause, then continue with --resume=true"
    )
    assert read_files(root) == before
    assert not list(root.glob("tmp*"))

    dataset = XopDataset.bind(session).resume("local/toy", root=root, **STREAMING)
    record(pair, dataset)
    dataset.save_episode()
    dataset.finalize()
    loaded = LeRobotDataset("local/toy", root=root)
    assert (loaded.num_episodes, len(loaded)) == (3, 9)
    assert get_row(loaded, 8)["observation.images.head"].shape == (3, 48, 64)
    assert [row["episode_index"] for row in read_facts(root)] == [0, 1, 2]


def test_the_first_episode_leaves_nothing(session, pair, tmp_path, monkeypatch):  # noqa: F811
    dataset = create(session, pair[0], tmp_path / "data", **STREAMING)
    record(pair, dataset)
    monkeypatch.setattr(pq.ParquetWriter, "write_table", is_full)
    with pytest.raises(NotSaved, match=f"{FULL}. None was saved before it$"):
        dataset.save_episode()
    assert not (tmp_path / "data").exists()


def test_other_faults_stay_what_they_are(session, pair, tmp_path, monkeypatch):  # noqa: F811
    dataset = create(session, pair[0], tmp_path / "data", **STREAMING)
    record(pair, dataset)
    dataset.save_episode()
    before = read_files(tmp_path / "data")
    record(pair, dataset)
    monkeypatch.setattr(pq.ParquetWriter, "write_table", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        dataset.save_episode()
    assert read_files(tmp_path / "data") == before


def test_what_cannot_be_taken_back_is_repaired(
    session, pair, tmp_path, monkeypatch  # noqa: F811
):  # fmt: skip
    root = tmp_path / "data"
    dataset = create(session, pair[0], root, **STREAMING)
    record(pair, dataset)
    dataset.save_episode()
    record(pair, dataset)
    monkeypatch.setattr(dataset_metadata, "write_info", cut("meta/info.json"))
    monkeypatch.setattr("xop_lerobot.recording.rollback.replace_file", is_full)
    with pytest.raises(NotSaved) as caught:
        dataset.save_episode()
    assert str(caught.value) == (
        f"episode 1 could not be saved to '{root}': {FULL}. What it left there could not be "
        f"removed. `xop-curate repair --root {root} --out DIR` restores the episodes before "
        "it"
    )


@pytest.mark.slow
def test_a_disk_that_fills_up_during_an_episode(
    session, pair, tmp_path, monkeypatch  # noqa: F811
):  # fmt: skip
    robot, teleop = pair
    dataset = create(session, robot, tmp_path / "data", **STREAMING)
    record(pair, dataset)
    dataset.save_episode()
    monkeypatch.setattr(StreamingVideoEncoder, "feed_frame", lambda self, *_: fail_thread(self))
    with pytest.raises(NotSaved, match=f"episode 1 could not be saved .* {FULL}"):
        tick(robot, teleop, dataset)
    dataset.finalize()
    assert LeRobotDataset("local/toy", root=tmp_path / "data").num_episodes == 1


@pytest.mark.parametrize("use_videos", [True, False])
def test_pictures_that_were_not_written(
    session, pair, tmp_path, monkeypatch, use_videos, caplog  # noqa: F811
):  # fmt: skip
    """LeRobot only logs it, and encodes a video that is too short."""
    robot, _ = pair
    dataset = create(session, robot, tmp_path / "data", image_writer_threads=1)
    write, count = image_writer.write_image, []

    def write_some(image, path, *rest) -> None:
        count.append(path)
        if len(count) != 3:
            write(image, path, *rest)

    monkeypatch.setattr(image_writer, "write_image", write_some)
    record(pair, dataset, 5)
    with pytest.raises(NotSaved, match=": 1 of its 5 images could not be written. None was"):
        dataset.save_episode()
    assert not (tmp_path / "data").exists()


def test_a_cut_line_of_facts_takes_no_other_along(session, pair, tmp_path):  # noqa: F811
    dataset = create(session, pair[0], tmp_path / "data", **STREAMING)
    record(pair, dataset)
    facts = dataset._collect_facts()
    append_facts(tmp_path, 0, 3, facts)
    with (tmp_path / "meta/xop/episodes.jsonl").open("a") as file:
        file.write('{"episode_in')
    append_facts(tmp_path, 1, 3, facts)
    assert [row["episode_index"] for row in read_facts(tmp_path)] == [0, 1]


def test_a_directory_that_cannot_be_made(session, tmp_path, monkeypatch):  # noqa: F811
    robot = make_toy(session)
    (tmp_path / "file").write_text("")
    with pytest.raises(NotMade) as caught:
        create(session, robot, tmp_path / "file" / "data")
    assert str(caught.value) == (
        f"dataset directory '{tmp_path}/file/data' cannot be made: Not a directory"
    )
    monkeypatch.setattr(dataset_metadata, "write_info", cut("half.json"))
    with pytest.raises(NotMade, match=FULL):
        create(session, robot, tmp_path / "data")
    assert not (tmp_path / "data").exists()
    robot.disconnect()


def test_reasons():
    assert find_reason(ValueError("no disk")) == ""
    assert find_reason(OSError(errno.EDQUOT, "x")) == os.strerror(errno.EDQUOT)
    error = RuntimeError("failed")
    error.__cause__ = OSError("Video encoding did not work.")
    assert find_reason(error) == "Video encoding did not work."


@pytest.mark.slow
def test_a_disk_that_is_really_full(tmp_path):
    """In a small disk of its own."""
    disk, copy = tmp_path / "disk", tmp_path / "copy"
    disk.mkdir()
    words = [
        sys.executable, str(REPO / "tests" / "helpers" / "record_toy.py"), "xop-record",
        "--robot.type=xop_toy", "--robot.width=64", "--robot.height=48", "--teleop.type=xop",
        "--teleop.device.path=g1_squat_walk_reach", "--teleop.retargeter.type=direct",
        "--dataset.repo_id=local/toy", f"--dataset.root={disk}/data", "--dataset.fps=25",
        "--dataset.single_task=play", "--dataset.episode_time_s=0.4",
        "--dataset.streaming_encoding=true", "--dataset.push_to_hub=false",
        "--play_sounds=false", "--dataset.num_episodes=50",
        "--dataset.rgb_encoder.vcodec=h264", "--dataset.rgb_encoder.preset=ultrafast",
    ]  # fmt: skip
    script = f"mount -t tmpfs -o size=700k none {disk} && {{ {shlex.join(words)}; code=$?; "
    script += f"cp -a {disk}/data {copy}; exit $code; }}"
    if shutil.which("unshare") is None:
        pytest.skip("no unshare to make a small disk with")
    done = subprocess.run(["unshare", "-rm", "sh", "-c", script], capture_output=True, text=True)
    if not copy.exists():
        pytest.skip(f"no small disk can be made here: {done.stderr[-200:]}")
    assert done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("error: episode ")
    assert f": {FULL}. What was saved" in last
    loaded = LeRobotDataset("local/toy", root=copy)
    assert loaded.num_episodes == len(read_facts(copy)) > 0
    assert np.all(np.bincount(loaded.hf_dataset["episode_index"]) == 10)
    assert get_row(loaded, len(loaded) - 1)["observation.images.head"].shape == (3, 48, 64)
