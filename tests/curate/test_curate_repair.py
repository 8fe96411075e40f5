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
from curate_recorded import CAMERA, FPS, load, make_packed, read_metadata, read_pictures, read_rows
from hypothesis import given, settings
from hypothesis import strategies as st

from xop_lerobot.curate.cli import main
from xop_lerobot.curate.salvage import CannotSalvage, salvage
from xop_lerobot.curate.thrift import (
    BINARY,
    DOUBLE,
    I32,
    I64,
    LIST,
    STRUCT,
    TRUE,
    Field,
    Malformed,
    Reader,
    write_struct,
)
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
def killed(tmp_path_factory) -> Path:
    """What LeRobot's recorder leaves when it is killed in its fourth episode."""
    root = tmp_path_factory.mktemp("killed") / "packed"
    path = os.pathsep.join([str(HELPERS), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", RECORD_AND_DIE, str(root)],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
    )
    assert done.returncode == -signal.SIGKILL, done.stderr[-2000:]
    return root


@pytest.mark.slow
def test_killed_session_of_lerobot(killed, whole, tmp_path, capsys, monkeypatch):
    # LeRobot looks for what it cannot read on the hub.
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    with pytest.raises(Exception, match="Repository Not Found|reach|offline|Parquet|parquet|hub"):
        load("local/killed", root=killed)
    before = compute_digests(killed)
    said = repair(killed, tmp_path / "out", capsys)
    assert compute_digests(killed) == before
    check_episodes(tmp_path / "out", whole, [0, 1, 2])
    assert said == (
        f"{DATA} was cut off: 3 episodes' rows in it are whole\n"
        "meta/episodes has nothing readable: made anew of rows and pictures\n"
        f"images/{CAMERA}/episode-000003 holds 12 pictures of an unfinished episode: left out\n"
        "whole: 3 episodes, 106 frames. Lost: 0\n"
        f"written to {tmp_path.resolve()}/out\n"
    )
    steps = [row["provenance"][-1] for row in read_facts(tmp_path / "out")]
    assert [step["source"].rpartition("/")[2] for step in steps] == ["packed"] * 3


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


def test_rows_that_are_cut_off(killed, whole, tmp_path, capsys):
    root = Path(shutil.copytree(killed, tmp_path / "packed"))
    cut(root / DATA, 0.9)  # in the rows of the last episode
    said = repair(root, tmp_path / "out", capsys)
    check_episodes(tmp_path / "out", whole, [0, 1])
    assert "2 episodes' rows in it are whole\n" in said
    assert "meta/info.json counts 3 episodes, 2 are whole\n" in said


def test_video_that_is_cut_off(whole, tmp_path, capsys):
    root = Path(shutil.copytree(whole, tmp_path / "packed"))
    cut(root / VIDEO, 0.8)
    said = repair(root, tmp_path / "out", capsys)
    check_episodes(tmp_path / "out", whole, [0, 1])
    assert f"of its 44 pictures of '{CAMERA}' are gone\n" in said
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
    assert "meta/tasks.parquet is not readable: made anew of what the episodes say\n" in said


def test_nothing_to_restore(whole, tmp_path, capsys):
    root = Path(shutil.copytree(whole, tmp_path / "packed"))
    (root / VIDEO).unlink()
    capsys.readouterr()
    assert main(["repair", "--root", str(root), "--out", str(tmp_path / "out")]) == 1
    out, err = capsys.readouterr()
    assert out.count("is lost: its pictures") == 3
    assert err == "error: no episode is left, so no dataset is made\n"
    assert [path.name for path in tmp_path.iterdir()] == ["packed"]


def test_whole_dataset_stays_as_it_is(whole, tmp_path, capsys):
    said = repair(whole, tmp_path / "out", capsys)
    assert said.startswith("nothing is wrong with it\nwhole: 3 episodes, 106 frames. Lost: 0\n")
    check_episodes(tmp_path / "out", whole, [0, 1, 2])


# Parquet files without an end.


SCHEMA = pa.schema(
    [
        pa.field("state", pa.list_(pa.float32(), 5)),
        pa.field("flags", pa.list_(pa.bool_(), 3)),
        pa.field("done", pa.bool_()),
        pa.field("image", pa.struct([("bytes", pa.binary()), ("path", pa.string())])),
        pa.field("text", pa.string()),
        pa.field("wall", pa.int64()),
        pa.field("sim", pa.float64()),
        pa.field("frame_index", pa.int64()),
    ]
)


def make_table(rows: int, rng: np.random.Generator) -> pa.Table:
    """Rows of every type that LeRobot writes; large ones take several pages a column."""
    state = pa.array(rng.normal(size=rows * 5).astype(np.float32))
    flags = pa.array(rng.random(rows * 3) < 0.5)
    return pa.Table.from_arrays(
        [
            pa.FixedSizeListArray.from_arrays(state, 5),
            pa.FixedSizeListArray.from_arrays(flags, 3),
            pa.array(rng.random(rows) < 0.5),
            pa.array([{"bytes": rng.bytes(40), "path": f"{i}.png"} for i in range(rows)]),
            pa.array([f"text {i % 7}" for i in range(rows)]),
            pa.array(rng.integers(0, 1 << 60, rows)),
            pa.array(rng.normal(size=rows)),
            pa.array(np.arange(rows)),
        ],
        schema=SCHEMA,
    )


@pytest.fixture(scope="module")
def parquet(tmp_path_factory):
    """A file of four row groups, its tables, and where each group ends."""
    path = tmp_path_factory.mktemp("parquet") / "whole.parquet"
    rng = np.random.default_rng(0)
    tables = [make_table(rows, rng) for rows in (3, 60_000, 1, 500)]
    with pq.ParquetWriter(path, SCHEMA, compression="snappy", use_dictionary=True) as writer:
        for table in tables:
            writer.write_table(table)
    metadata, ends = pq.ParquetFile(path).metadata, []
    for group in range(metadata.num_row_groups):
        row = metadata.row_group(group)
        columns = [row.column(i) for i in range(row.num_columns)]
        starts = [c.dictionary_page_offset or c.data_page_offset for c in columns]
        sizes = [c.total_compressed_size for c in columns]
        ends.append(max(map(sum, zip(starts, sizes, strict=True))))
    return path, tables, ends


@pytest.mark.slow
@pytest.mark.parametrize("where", ["footer", "exactly", "a byte short", "first", "middle"])
def test_row_groups_that_are_whole_come_back(parquet, tmp_path, where):
    path, tables, ends = parquet
    size = {
        "footer": path.stat().st_size - 1,
        "exactly": ends[2],
        "a byte short": ends[2] - 1,
        "first": ends[0],
        "middle": (ends[0] + ends[1]) // 2,
    }[where]
    broken = tmp_path / "broken.parquet"
    broken.write_bytes(path.read_bytes()[:size])
    expected = sum(end <= size for end in ends)
    assert salvage(broken, SCHEMA, tmp_path / "out.parquet") == expected
    assert pq.read_table(tmp_path / "out.parquet").equals(pa.concat_tables(tables[:expected]))


@pytest.mark.parametrize("seed", range(15))
def test_any_cut_gives_the_same_as_its_whole_groups(parquet, tmp_path, seed):
    path, tables, ends = parquet
    size = int(np.random.default_rng(seed).integers(4, path.stat().st_size))
    broken = tmp_path / "broken.parquet"
    broken.write_bytes(path.read_bytes()[:size])
    expected = sum(end <= size for end in ends)
    if expected:
        assert salvage(broken, SCHEMA, tmp_path / "out.parquet") == expected
        assert pq.read_table(tmp_path / "out.parquet").equals(pa.concat_tables(tables[:expected]))
    else:
        with pytest.raises(CannotSalvage, match=r"^not a single row group in it is whole$"):
            salvage(broken, SCHEMA, tmp_path / "out.parquet")


@pytest.mark.parametrize("seed", range(10))
def test_bytes_that_are_wrong_do_no_harm(parquet, tmp_path, seed):
    """What is salvaged is a readable file, whatever stands in the broken one."""
    path, _, ends = parquet
    rng = np.random.default_rng(seed)
    data = bytearray(path.read_bytes()[: ends[-1]])
    place = int(rng.integers(4, len(data) - 5000))
    data[place : place + 4096] = bytes(4096) if seed % 2 else rng.bytes(4096)
    broken = tmp_path / "broken.parquet"
    broken.write_bytes(data)
    try:
        groups = salvage(broken, SCHEMA, tmp_path / "out.parquet")
    except CannotSalvage:
        assert not (tmp_path / "out.parquet").exists()
        return
    with pq.ParquetFile(tmp_path / "out.parquet") as file:
        assert file.num_row_groups == groups
        file.read()


@pytest.mark.parametrize("content", [b"", b"PAR1", b"no parquet at all", b"PAR1" + bytes(100)])
def test_files_with_nothing_in_them(tmp_path, content):
    (tmp_path / "file").write_bytes(content)
    with pytest.raises(CannotSalvage):
        salvage(tmp_path / "file", SCHEMA, tmp_path / "out")
    assert not (tmp_path / "out").exists()


# Thrift.

VALUES = st.deferred(
    lambda: st.one_of(
        st.integers(-(1 << 62), 1 << 62).map(lambda value: Field(I64, value)),
        st.integers(-(1 << 31), 1 << 31).map(lambda value: Field(I32, value)),
        st.booleans().map(lambda value: Field(TRUE if value else TRUE + 1, value)),
        st.binary(max_size=300).map(lambda value: Field(BINARY, value)),
        st.floats(allow_nan=False).map(lambda value: Field(DOUBLE, value)),
        st.lists(st.integers(-9, 9), max_size=40).map(lambda value: Field(LIST, (I32, value))),
        st.lists(st.booleans(), max_size=20).map(lambda value: Field(LIST, (TRUE, value))),
        STRUCTS.map(lambda value: Field(STRUCT, value)),
        st.lists(STRUCTS, max_size=3).map(lambda value: Field(LIST, (STRUCT, value))),
    )
)
STRUCTS = st.dictionaries(st.integers(1, 200), VALUES, max_size=4)


@pytest.mark.slow
@given(STRUCTS)
@settings(max_examples=200, deadline=None)
def test_thrift_round_trip(fields):
    data = write_struct(fields)
    reader = Reader(data)
    assert reader.read_struct() == fields
    assert reader.place == len(data)


@given(st.binary(max_size=200))
@settings(max_examples=300, deadline=None)
def test_thrift_of_any_bytes(data):
    try:
        Reader(data).read_struct()
    except Malformed:
        pass


def test_thrift_of_a_real_footer(parquet):
    path, tables, _ = parquet
    data = path.read_bytes()
    length = int.from_bytes(data[-8:-4], "little")
    footer = data[-8 - length : -8]
    fields = Reader(footer).read_struct()
    assert fields[3].value == sum(map(len, tables))
    assert write_struct(fields) == footer
