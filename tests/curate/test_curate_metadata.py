"""Metadata that is wrong of one episode: it is named, the others are kept, and it is mended."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from curate_data import CAMERA, EVERY, compute_digests, make_numbered, read_numbers, rewrite

from xop_lerobot.curate.cli import main

LENGTHS = (14, 10, 10, 12)
STARTS = (0, 14, 24, 34)
VIDEO = f"videos/{CAMERA}/"
NAN = float("nan")


@pytest.fixture(scope="module")
def bases(tmp_path_factory) -> dict[bool, Path]:
    """Four episodes, all in the same files (True) and each in its own."""
    folder = tmp_path_factory.mktemp("bases")
    return {
        each: make_numbered(folder / str(each), LENGTHS, one_file=each) for each in (True, False)
    }


@pytest.fixture
def packed(bases, tmp_path) -> Path:
    return Path(shutil.copytree(bases[True], tmp_path / "data"))


@pytest.fixture
def single(bases, tmp_path) -> Path:
    """With files of its own for each episode."""
    root = Path(shutil.copytree(bases[False], tmp_path / "data"))
    assert len(list(root.glob("videos/*/*/*.mp4"))) == len(LENGTHS)
    return root


def edit(root: Path, changes: dict[str, dict[int, Any]], drop: tuple[int, ...] = ()) -> None:
    """Set cells of the metadata, column -> episode -> value, and drop rows, all in one file then.

    A column of whole numbers becomes one of floats by a NaN, as in pandas.
    """
    paths = sorted(root.glob("meta/episodes/*/*.parquet"))
    table = pa.concat_tables([pq.read_table(path) for path in paths])
    for column, cells in changes.items():
        values = [cells.get(row, old) for row, old in enumerate(table[column].to_pylist())]
        if any(isinstance(value, float) for value in values):
            values = [None if value is None else float(value) for value in values]
        table = table.set_column(table.column_names.index(column), column, pa.array(values))
    for path in paths:
        path.unlink()
    kept = [row for row in range(table.num_rows) if row not in drop]
    pq.write_table(table.take(kept), root / "meta/episodes/chunk-000/file-000.parquet")


def curate(capsys, *words: object) -> tuple[int, str, str]:
    code = main([*map(str, words), "--quiet"])
    return code, *capsys.readouterr()


def inspect(root: Path, capsys) -> tuple[int, dict[int, list[str]], str]:
    """Exit code, problems by episode, and what is said of the dataset as a whole."""
    code, out, err = curate(capsys, "inspect", "--root", root, "--json", "-")
    rows = {row["episode"]: row["problems"] for row in json.loads(out)}
    told = {f"problem: {each}" for problems in rows.values() for each in problems}
    rest = [line for line in err.splitlines() if line not in told]
    return code, rows, "\n".join(rest)


def expect(*episodes: int) -> list[tuple[int, int]]:
    """Rows and pictures of episodes, as `read_numbers` tells them."""
    numbers = [STARTS[each] + frame for each in episodes for frame in range(LENGTHS[each])]
    return [(number, number) for number in numbers[::EVERY]]


CELLS = {
    "end of a video": ({VIDEO + "to_timestamp": NAN}, "to_timestamp' of episode 1 as a time [s]"),
    "start of a video": ({VIDEO + "from_timestamp": NAN}, "from_timestamp' of episode 1 as a"),
    "both": ({VIDEO + "from_timestamp": NAN, VIDEO + "to_timestamp": NAN}, "of episode 1 as a"),
    "before the video": ({VIDEO + "from_timestamp": -2.0}, "of 0 or more, got -2.0"),
    "without end": ({VIDEO + "to_timestamp": float("inf")}, "of 0 or more, got inf"),
    "file of a video": ({VIDEO + "file_index": NAN}, "file_index' of episode 1 as a number"),
    "folder of a video": ({VIDEO + "chunk_index": NAN}, "chunk_index' of episode 1 as a number"),
    "no file of a video": ({VIDEO + "file_index": None}, "1 does not say where its video"),
    "file of rows": ({"data/file_index": NAN}, "'data/file_index' of episode 1 as a number of 0"),
    "folder of rows": ({"data/chunk_index": NAN}, "'data/chunk_index' of episode 1 as a number"),
    "length": ({"length": NAN}, "'length' of episode 1 as a number of 0 or more, got nan"),
    "half a frame": ({"length": 9.5}, "'length' of episode 1 as a number of 0 or more, got 9.5"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cell", "one_file"),
    [*((cell, True) for cell in CELLS), ("both", False), ("file of a video", False)],
)
def test_a_cell_that_says_nothing(bases, tmp_path, capsys, cell, one_file):
    root = Path(shutil.copytree(bases[one_file], tmp_path / "data"))
    changes, text = CELLS[cell]
    edit(root, {column: {1: value} for column, value in changes.items()})
    before = compute_digests(root)
    code, problems, _ = inspect(root, capsys)
    assert code == 1
    assert list(problems) == [0, 1, 2, 3]
    assert text in problems[1][0]
    assert not any(problems[each] for each in (0, 2, 3))
    out, mended = tmp_path / "out", tmp_path / "mended"
    assert curate(capsys, "filter", "--root", root, "--out", out, "--where", "readable")[0] == 0
    assert read_numbers(out) == expect(0, 2, 3)
    code, said, _ = curate(capsys, "repair", "--root", root, "--out", mended)
    assert code == 0
    assert text in said
    assert "complete: 4 episodes, 46 frames. Lost: 0" in said
    assert read_numbers(mended) == expect(0, 1, 2, 3)
    assert compute_digests(root) == before


@pytest.mark.parametrize("verb", ["filter", "merge", "split", "trim", "label"])
def test_verbs_that_mend_nothing_stop_at_it(packed, tmp_path, capsys, verb):
    edit(packed, {VIDEO + "to_timestamp": {1: NAN}})
    flags = {
        "filter": ["--where", "length > 1"],
        "split": ["--parts", "a=0.5", "b=0.5"],
        "label": ["--success", "length > 1"],
    }
    out = tmp_path / "out"
    code, _, err = curate(capsys, verb, "--root", packed, "--out", out, *flags.get(verb, []))
    assert code == 1
    assert err.splitlines()[-1].startswith(
        f"error: dataset '{packed}': meta/episodes must give '{VIDEO}to_timestamp' of episode 1 as "
        "a time [s] of 0 or more, got nan. `xop-curate repair` keeps what is complete"
    )
    assert not out.exists()


def test_episode_without_a_number(packed, tmp_path, capsys):
    edit(packed, {"episode_index": {1: NAN}})
    code, problems, err = inspect(packed, capsys)
    assert (code, list(problems)) == (1, [0, 2, 3])
    assert (
        "problem: meta/episodes/chunk-000/file-000.parquet must give 'episode_index' as a number "
        "of 0 or more in each row, row 1 gives nan"
    ) in err
    code, said, _ = curate(capsys, "repair", "--root", packed, "--out", tmp_path / "out")
    assert code == 0
    assert "episode 1 is not in meta/episodes: rebuilt\n" in said
    assert read_numbers(tmp_path / "out") == expect(0, 1, 2, 3)


def test_what_is_not_known_of_a_neighbour_is_not_guessed(packed, tmp_path, capsys):
    """Episode 1 is gone but for its pictures: which of them are episode 2's is not to be told."""
    edit(packed, {VIDEO + "from_timestamp": {2: NAN}}, drop=(1,))
    (rows,) = packed.glob("data/*/*.parquet")
    table = pq.read_table(rows)
    gone = np.array(table["episode_index"].to_pylist()) == 1
    pq.write_table(table.filter(pa.array(~gone)), rows)
    code, said, _ = curate(capsys, "repair", "--root", packed, "--out", tmp_path / "out")
    assert code == 0
    assert "episode 2 is lost: its images are gone\n" in said
    assert read_numbers(tmp_path / "out") == expect(0, 3)


def test_statistics_that_are_no_numbers_are_made_anew(packed, tmp_path, capsys):
    path = packed / "meta/episodes/chunk-000/file-000.parquet"
    name = f"stats/{CAMERA}/mean"
    before = pq.read_table(path)[name].to_pylist()
    rewrite(path, {name: pa.array([[[[NAN]]] * 3, *before[1:]])})
    out = tmp_path / "out"
    code, _, _ = curate(capsys, "filter", "--root", packed, "--out", out, "--where", "length > 1")
    assert code == 0
    after = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet")[name].to_pylist()
    np.testing.assert_allclose(after, before, atol=0.01)


# Pictures that are two episodes'.


def share(root: Path, **cells: object) -> None:
    edit(root, {VIDEO + name: {2: value} for name, value in cells.items()})


def test_shared_pictures_are_named_and_not_handed_on(single, tmp_path, capsys):
    share(single, file_index=1)
    code, problems, err = inspect(single, capsys)
    text = (
        f"the episodes 1 and 2 have the same images of '{CAMERA}', "
        f"videos/{CAMERA}/chunk-000/file-001.mp4 from 0.00 s to 1.00 s"
    )
    assert (code, problems) == (1, {0: [], 1: [text], 2: [text], 3: []})
    assert f"problem: videos/{CAMERA}/chunk-000/file-002.mp4 belongs to no episode" in err
    out = tmp_path / "out"
    assert curate(capsys, "filter", "--root", single, "--out", out, "--where", "readable")[0] == 0
    assert read_numbers(out) == expect(0, 3)
    code, _, err = curate(capsys, "merge", "--root", single, "--out", tmp_path / "merged")
    assert code == 1
    assert f"error: dataset '{single}': {text}. `xop-curate repair` keeps" in err


def test_repair_gives_the_pictures_back(single, tmp_path, capsys):
    share(single, file_index=1)
    code, said, _ = curate(capsys, "repair", "--root", single, "--out", tmp_path / "out")
    assert code == 0
    assert "the images of episode 2 are found: " in said
    assert read_numbers(tmp_path / "out") == expect(0, 1, 2, 3)


def test_spans_that_overlap_in_part(packed, tmp_path, capsys):
    share(packed, from_timestamp=2.0, to_timestamp=3.0)  # 0.4 s too early
    code, problems, _ = inspect(packed, capsys)
    assert code == 1
    assert [bool(problems[each]) for each in range(4)] == [False, True, True, False]
    assert "from 2.00 s to 2.40 s" in problems[1][0]
    code, _, _ = curate(capsys, "repair", "--root", packed, "--out", tmp_path / "out")
    assert code == 0
    assert read_numbers(tmp_path / "out") == expect(0, 1, 2, 3)


def test_shared_pictures_without_others_are_lost(single, tmp_path, capsys):
    """Nothing tells whose the only ones are."""
    share(single, file_index=1)
    (single / f"videos/{CAMERA}/chunk-000/file-002.mp4").unlink()
    code, said, _ = curate(capsys, "repair", "--root", single, "--out", tmp_path / "out")
    assert code == 0
    assert "episode 2 is lost: the episodes 1 and 2 have the same images" in said


# Numbers.


def test_gap_of_numbers(packed, tmp_path, capsys):
    """Two episodes are lost, the numbers go on, and somebody has put the count right."""
    (rows,) = packed.glob("data/*/*.parquet")
    table = pq.read_table(rows)
    numbers = np.array(table["episode_index"].to_pylist())
    pq.write_table(table.filter(pa.array((numbers == 0) | (numbers == 3))), rows)
    edit(packed, {}, drop=(1, 2))
    info = json.loads((packed / "meta/info.json").read_text())
    info |= {"total_episodes": 2, "total_frames": LENGTHS[0] + LENGTHS[3]}
    (packed / "meta/info.json").write_text(json.dumps(info))
    code, problems, _ = inspect(packed, capsys)
    assert code == 1
    assert problems[0] == []
    assert problems[3][0] == (
        "episode 3 comes after 0, but LeRobot assumes episodes numbered from 0 without gaps. "
        "`xop-curate filter` renumbers it"
    )
    out, mended = tmp_path / "out", tmp_path / "mended"
    assert curate(capsys, "filter", "--root", packed, "--out", out, "--where", "readable")[0] == 0
    code, said, _ = curate(capsys, "repair", "--root", packed, "--out", mended)
    assert "episode 3 comes after 0" in said
    for each in (out, mended):
        assert read_numbers(each) == expect(0, 3)
        assert inspect(each, capsys) == (0, {0: [], 1: []}, "")
    labels = tmp_path / "labels.json"
    labels.write_text('{"3": {"success": true}}')
    flags = ["--root", packed, "--out", tmp_path / "labelled", "--labels", labels]
    assert curate(capsys, "label", *flags)[0] == 0


COUNTERS = {
    "timestamp": (
        lambda old: old + 1.7e9,
        "'timestamp' of episode 0 must be 0 in row 0, it is 1700000000. `xop-curate filter` renumb",
    ),
    "index": (
        lambda old: old + 5,
        "'index' of episode 0 must be 0 in row 0, it is 5. `xop-curate filter` renumbers it",
    ),
    "frame_index": (
        lambda old: old + 1,
        "'frame_index' of episode 0 must be 0 in row 0, it is 1. `xop-curate filter` renumbers it",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", COUNTERS)
def test_rows_that_are_counted_in_their_own_way(packed, tmp_path, capsys, name):
    change, text = COUNTERS[name]
    (rows,) = packed.glob("data/*/*.parquet")
    table = pq.read_table(rows)
    values = change(np.array(table[name].to_pylist()))
    rewrite(rows, {name: pa.array(values.tolist()).cast(table.schema.field(name).type)})
    code, problems, _ = inspect(packed, capsys)
    assert code == 1
    assert problems[0][0].startswith(text)
    out = tmp_path / "out"
    code, _, err = curate(capsys, "filter", "--root", packed, "--out", out, "--where", "readable")
    assert code == 0
    assert text in err
    assert read_numbers(out) == expect(0, 1, 2, 3)
    assert inspect(out, capsys)[0] == 0


def test_time_stamps_that_jitter(packed, capsys):
    """By less than LeRobot minds, and by more."""
    (rows,) = packed.glob("data/*/*.parquet")
    stamps = np.array(pq.read_table(rows)["timestamp"].to_pylist())
    for jitter, code in ((5e-5, 0), (2e-3, 1)):
        rewrite(rows, {"timestamp": pa.array(stamps + jitter).cast(pa.float32())})
        assert inspect(packed, capsys)[0] == code


def test_offsets_that_are_scrambled(packed, tmp_path, capsys):
    edit(packed, {"dataset_from_index": {1: 0, 2: 14}})
    code, problems, _ = inspect(packed, capsys)
    assert code == 1
    assert problems[1] == [
        "the metadata puts episode 1 at the rows 0 to 24, it is the rows 14 to 24. "
        "`xop-curate filter` renumbers it"
    ]
    out = tmp_path / "out"
    assert curate(capsys, "filter", "--root", packed, "--out", out, "--where", "readable")[0] == 0
    assert inspect(out, capsys)[0] == 0
    code, said, _ = curate(capsys, "repair", "--root", packed, "--dry-run")
    assert "no damage found" not in said
    assert "the metadata puts episode 1 at the rows 0 to 24" in said


def test_words_of_another_task(packed, capsys):
    rewrite(packed / "meta/episodes/chunk-000/file-000.parquet", {"tasks": [["other"]] * 4})
    code, problems, _ = inspect(packed, capsys)
    assert code == 1
    assert problems[1] == [
        "the task of episode 1 is 'other' in meta/episodes, 'task 1' in its rows"
    ]


# Empty episodes.


@pytest.fixture
def hollow(packed) -> Path:
    """The dataset with an episode of no frames at its end."""
    edit(packed, {})
    path = packed / "meta/episodes/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    last = table.slice(3, 1).to_pylist()[0] | {"episode_index": 4, "length": 0}
    last |= {"dataset_from_index": 46, "dataset_to_index": 46}
    last |= {VIDEO + "from_timestamp": 4.6, VIDEO + "to_timestamp": 4.6}
    pq.write_table(pa.concat_tables([table, pa.Table.from_pylist([last], table.schema)]), path)
    info = json.loads((packed / "meta/info.json").read_text()) | {"total_episodes": 5}
    (packed / "meta/info.json").write_text(json.dumps(info))
    return packed


def test_empty_episode_is_named(hollow, capsys):
    assert inspect(hollow, capsys)[:2] == (
        1, {0: [], 1: [], 2: [], 3: [], 4: ["episode 4 has no frames"]},
    )  # fmt: skip


@pytest.mark.parametrize("verb", ["merge", "split", "trim", "label"])
def test_empty_episode_stops_verbs_that_mend_nothing(hollow, tmp_path, capsys, verb):
    flags = {"split": ["--parts", "a=0.5", "b=0.5"], "label": ["--success", "length > 1"]}
    out = tmp_path / "out"
    code, _, err = curate(capsys, verb, "--root", hollow, "--out", out, *flags.get(verb, []))
    assert code == 1
    assert err.splitlines()[-1].startswith(f"error: dataset '{hollow}': episode 4 has no frames")
    assert not out.exists()


@pytest.mark.slow
def test_empty_episode_is_left_out(hollow, tmp_path, capsys):
    out, mended = tmp_path / "out", tmp_path / "mended"
    assert curate(capsys, "filter", "--root", hollow, "--out", out, "--where", "readable")[0] == 0
    code, said, _ = curate(capsys, "repair", "--root", hollow, "--out", mended)
    assert code == 0
    assert "episode 4 is lost: it has no rows\n" in said
    assert read_numbers(out) == read_numbers(mended) == expect(0, 1, 2, 3)
    assert curate(capsys, "report", "--root", hollow, "--out", tmp_path / "page.html")[0] == 1
    assert "episode 4 has no frames" in (tmp_path / "page.html").read_text()


# Files that are named wrongly.


def test_repair_says_what_it_mends(single, tmp_path, capsys):
    edit(single, {"data/file_index": {1: 0}})
    code, said, _ = curate(capsys, "repair", "--root", single, "--out", tmp_path / "out")
    assert code == 0
    assert said.startswith(
        "episode 1 is in data/chunk-000/file-001.parquet, and not in "
        "data/chunk-000/file-000.parquet, as meta/episodes says: repaired\n"
    )
    assert read_numbers(tmp_path / "out") == expect(0, 1, 2, 3)


def test_repair_finds_a_video_that_is_named_wrongly(single, tmp_path, capsys):
    edit(single, {VIDEO + "file_index": {1: 7}})
    code, said, _ = curate(capsys, "repair", "--root", single, "--out", tmp_path / "out")
    assert code == 0
    assert "the images of episode 1 are found: " in said
    assert read_numbers(tmp_path / "out") == expect(0, 1, 2, 3)


def test_repair_of_what_is_whole(bases, capsys):
    for root in bases.values():
        code, said, _ = curate(capsys, "repair", "--root", root, "--dry-run")
        assert (code, said) == (
            0, "no damage found\ncomplete: 4 episodes, 46 frames. Lost: 0\n",
        )  # fmt: skip
