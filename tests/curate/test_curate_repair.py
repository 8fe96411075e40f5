"""Recordings that were cut off come back to their last whole episode, and what is lost is said."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from curate_data import compute_digests
from curate_recorded import (
    CAMERA,
    FPS,
    load,
    make_packed,
    read_metadata,
    read_pictures,
    read_rows,
    record_toy,
)

from xop_lerobot.curate.cli import main
from xop_lerobot.recording.facts import read_facts

HELPERS = Path(__file__).parents[1] / "helpers"
LENGTHS = (37, 25, 44)
DATA = "data/chunk-000/file-000.parquet"
META = "meta/episodes/chunk-000/file-000.parquet"
VIDEO = f"videos/{CAMERA}/chunk-000/file-000.mp4"
RECORD_AND_DIE = """
import os, signal, sys
from pathlib import Path
from curate_recorded import make_packed, CAMERA, SIZE
import numpy as np
dataset = make_packed(Path(sys.argv[1]), finalize=False, vcodec="h264")
for i in range(12):
    frame = {"action": np.zeros(2, np.float32), CAMERA: np.zeros((*SIZE, 3), np.uint8)}
    dataset.add_frame({**frame, "task": "task 0"})
os.kill(os.getpid(), signal.SIGKILL)
"""


def repair(root: Path, out: Path, capsys=None) -> str:
    if capsys:
        capsys.readouterr()
    assert main(["repair", "--root", str(root), "--out", str(out), "--quiet"]) == 0
    return capsys.readouterr().out if capsys else ""


def check_episodes(out: Path, reference: Path, episodes: list[int]) -> None:
    """`out` holds these episodes of `reference`, in this order."""
    dataset = load("local/out", root=out)
    assert dataset.num_episodes == len(episodes)
    for number, episode in enumerate(episodes):
        rows, expected = read_rows(out, number), read_rows(reference, episode)
        for key in ("action", "frame_index", "timestamp"):
            np.testing.assert_array_equal(np.stack(rows[key]), np.stack(expected[key]))
        np.testing.assert_array_equal(
            read_pictures(out, number, CAMERA, FPS), read_pictures(reference, episode, CAMERA, FPS)
        )
    last = dataset[len(dataset) - 1]
    assert last["task"] == f"task {episodes[-1] % 2}"


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("whole") / "packed"
    make_packed(root, LENGTHS, vcodec="h264")
    return root


@pytest.fixture(scope="module")
def killed(whole, tmp_path_factory) -> Path:
    """A session whose metadata is lost, with images of the episode that was under way."""
    root = Path(shutil.copytree(whole, tmp_path_factory.mktemp("killed") / "packed"))
    (root / META).unlink()
    folder = root / f"images/{CAMERA}/episode-000003"
    folder.mkdir(parents=True)
    for number in range(12):
        (folder / f"frame-{number:06d}.png").touch()
    return root


@pytest.fixture(scope="module")
def killed_stock(tmp_path_factory) -> Path:
    """What LeRobot's recorder leaves when it is killed in its fourth episode."""
    root = tmp_path_factory.mktemp("killed_stock") / "packed"
    path = os.pathsep.join([str(HELPERS), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", RECORD_AND_DIE, str(root)],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
    )
    assert done.returncode == -signal.SIGKILL, done.stderr[-2000:]
    return root


def test_killed_session(killed, whole, tmp_path, capsys):
    before = compute_digests(killed)
    said = repair(killed, tmp_path / "out", capsys)
    assert compute_digests(killed) == before
    check_episodes(tmp_path / "out", whole, [0, 1, 2])
    assert said == (
        "meta/episodes has nothing readable: rebuilt from rows and images\n"
        f"images/{CAMERA}/episode-000003 holds 12 images of an unfinished episode: left out\n"
        "complete: 3 episodes, 106 frames. Lost: 0\n"
        f"written to {tmp_path.resolve()}/out\n"
    )
    steps = [row["provenance"][-1] for row in read_facts(tmp_path / "out")]
    assert [step["source"].rpartition("/")[2] for step in steps] == ["packed"] * 3


@pytest.mark.slow
def test_killed_session_of_lerobot(killed_stock, tmp_path, capsys, monkeypatch):
    # LeRobot looks for what it cannot read on the hub.
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    with pytest.raises(Exception, match="Repository Not Found|reach|offline|Parquet|parquet|hub"):
        load("local/killed", root=killed_stock)
    before = compute_digests(killed_stock)
    capsys.readouterr()  # what LeRobot said
    assert main(["repair", "--root", str(killed_stock), "--out", str(tmp_path / "out")]) == 1
    assert compute_digests(killed_stock) == before
    assert not list(tmp_path.iterdir())
    assert capsys.readouterr().err == (
        f"error: dataset '{killed_stock}': {DATA} is not readable (Parquet magic bytes not found "
        "in footer. Either the file is corrupted or this is not a parquet file.), and "
        "meta/episodes does not say which episodes are in it. LeRobot's own recorder leaves "
        "Parquet files without a footer when it is killed, an unfinished copy too: copy the file "
        "again, or move it out of the dataset and repair the rest\n"
    )


def test_metadata_is_what_lerobot_would_have_written(killed, whole, tmp_path):
    repair(killed, tmp_path / "out")
    found, expected = read_metadata(tmp_path / "out"), read_metadata(whole)
    for name in expected.columns:
        # Statistics of pictures are of the PNG files, which are gone.
        if f"stats/{CAMERA}" in name or name == "tasks":
            continue
        for before, after in zip(expected[name], found[name], strict=True):
            # LeRobot takes the quantiles of time stamps before it rounds them to 32 bits.
            np.testing.assert_allclose(after, before, atol=1e-3, err_msg=name)
    assert [list(tasks) for tasks in found["tasks"]] == [list(t) for t in expected["tasks"]]


def test_dry_run_says_the_same_and_writes_nothing(killed, tmp_path, capsys):
    said = repair(killed, tmp_path / "out", capsys).rpartition("written")[0]
    before = compute_digests(killed)
    assert main(["repair", "--root", str(killed), "--dry-run"]) == 0
    assert capsys.readouterr().out == said
    assert compute_digests(killed) == before
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_in_place(killed, whole, tmp_path):
    root = Path(shutil.copytree(killed, tmp_path / "packed"))
    assert main(["repair", "--root", str(root), "--in-place"]) == 0
    check_episodes(root, whole, [0, 1, 2])
    assert [path.name for path in tmp_path.iterdir()] == ["packed"]


def cut(path: Path, share: float) -> None:
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])


def test_rows_that_are_cut_off(tmp_path, capsys):
    """The other files' episodes stay, as the metadata says which one is lost."""
    whole = record_toy(tmp_path / "whole", (30, 24), session="cut-off", video=False)
    root = Path(shutil.copytree(whole, tmp_path / "packed"))
    cut(root / DATA, 0.9)
    said = repair(root, tmp_path / "out", capsys)
    assert f"{DATA} is not readable (Parquet magic bytes not found in footer" in said
    assert "episode 0 is lost: its rows are gone\n" in said
    assert "complete: 1 episode, 24 frames. Lost: 1\n" in said
    rows, expected = read_rows(tmp_path / "out", 0), read_rows(whole, 1)
    np.testing.assert_array_equal(np.stack(rows["action"]), np.stack(expected["action"]))


def test_video_that_is_cut_off(whole, tmp_path, capsys):
    root = Path(shutil.copytree(whole, tmp_path / "packed"))
    cut(root / VIDEO, 0.8)
    said = repair(root, tmp_path / "out", capsys)
    check_episodes(tmp_path / "out", whole, [0, 1])
    assert f"of its 44 images of '{CAMERA}' are gone\n" in said
    assert said.startswith("meta/info.json counts 3 episodes, 2 are whole\nepisode 2 is lost: ")


def test_an_episode_in_the_middle(whole, tmp_path, capsys):
    """Those after it stay."""
    root = Path(shutil.copytree(whole, tmp_path / "packed"))
    table = pq.read_table(root / DATA)
    drop = np.arange(table.num_rows) == 50
    pq.write_table(table.filter(pa.array(~drop)), root / DATA)
    said = repair(root, tmp_path / "out", capsys)
    check_episodes(tmp_path / "out", whole, [0, 2])
    assert "episode 1 is lost: it has 24 of 25 rows\n" in said


@pytest.mark.slow
@pytest.mark.parametrize("spoil", [Path.unlink, lambda path: path.write_bytes(b"no parquet")])
@pytest.mark.parametrize("name", [META, "meta/stats.json"])
def test_metadata_is_made_anew(whole, tmp_path, spoil, name):
    root = Path(shutil.copytree(whole, tmp_path / "packed"))
    spoil(root / name)
    repair(root, tmp_path / "out")
    check_episodes(tmp_path / "out", whole, [0, 1, 2])


def test_tasks_are_found_again(whole, tmp_path, capsys):
    root = Path(shutil.copytree(whole, tmp_path / "packed"))
    cut(root / "meta/tasks.parquet", 0.5)
    said = repair(root, tmp_path / "out", capsys)
    check_episodes(tmp_path / "out", whole, [0, 1, 2])
    assert "meta/tasks.parquet is not readable: rebuilt from what the episodes say\n" in said


def test_nothing_to_restore(whole, tmp_path, capsys):
    root = Path(shutil.copytree(whole, tmp_path / "packed"))
    (root / VIDEO).unlink()
    capsys.readouterr()
    assert main(["repair", "--root", str(root), "--out", str(tmp_path / "out")]) == 1
    out, err = capsys.readouterr()
    assert out.count("is lost: its images") == 3
    assert err == "error: no episode is left, so no dataset is made\n"
    assert [path.name for path in tmp_path.iterdir()] == ["packed"]


def test_whole_dataset_stays_as_it_is(whole, tmp_path, capsys):
    said = repair(whole, tmp_path / "out", capsys)
    assert said.startswith("no damage found\ncomplete: 3 episodes, 106 frames. Lost: 0\n")
    check_episodes(tmp_path / "out", whole, [0, 1, 2])
