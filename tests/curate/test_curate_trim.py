"""Idle starts and ends are cut off, and rows and pictures stay together."""

from __future__ import annotations

import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from curate_data import compute_digests, make_foreign, rewrite
from curate_recorded import load, read_pictures, read_rows, record_toy

from xop_lerobot.curate.cli import main
from xop_lerobot.recording.facts import read_facts

HEAD = "observation.images.head"
FILE = "data/chunk-000/file-{:03d}.parquet"
FPS = 25
POSES = [
    *(f"operator.{name}" for name in ("head", "left_wrist", "right_wrist")),
    *(f"robot.{name}" for name in ("base_pose", "head", "left_wrist", "right_wrist")),
]
MOVES = {0: (50, 90), 1: (0, 100), 2: (30, 31)}
"""Frames of each episode in which something moves."""


def move(length: int, start: int, stop: int) -> np.ndarray:
    """Poses that go 30 cm a second between two frames, and stand still otherwise. Shape (n, 7)."""
    poses = np.tile([0, 0, 1, 1, 0, 0, 0.0], (length, 1))
    poses[:, 0] = np.clip(np.arange(length) - start, 0, stop - start) * 0.3 / FPS
    poses[:, 0] += 0.002 * np.sin(np.arange(length))  # they tremble
    return poses


def set_columns(root, episode, **columns) -> None:
    path = root / FILE.format(episode)
    table = pq.read_table(path)
    new = {}
    for key, values in columns.items():
        flat = pa.array(np.ravel(values))
        kind = table.schema.field(key).type
        is_list = pa.types.is_fixed_size_list(kind)
        new[key] = (
            pa.FixedSizeListArray.from_arrays(flat.cast(kind.value_type), kind.list_size)
            if is_list
            else flat
        )
    rewrite(path, new)


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    root = record_toy(tmp_path_factory.mktemp("trim") / "toy", (120, 100, 60), session="trim")
    for episode, (start, stop) in MOVES.items():
        length = len(read_rows(root, episode))
        poses = dict.fromkeys(POSES, move(length, start, stop))
        engaged = np.ones(length, bool)
        if episode == 2:
            engaged[:10] = False
        set_columns(root, episode, **poses, **{"operator.engaged": engaged})
    return root


def trim(root, out, *flags) -> dict[int, tuple[int, int]]:
    assert main(["trim", "--root", str(root), "--out", str(out), *flags]) == 0
    return {
        row["provenance"][-1]["source_episode"]: tuple(row["provenance"][-1]["source_rows"])
        for row in read_facts(out)
    }


@pytest.mark.slow
def test_idle_ends_are_cut(base, tmp_path, capsys):
    before = compute_digests(base)
    spans = trim(base, tmp_path / "out", "--margin", "0.4")
    # What moves is seen up to a quarter of a second before and after, and ten frames stay.
    assert spans[0][0] in range(50 - 10 - 7, 50 - 10 + 1)
    assert spans[0][1] in range(90 + 10, 90 + 10 + 8)
    assert spans[1] == (0, 100)
    assert spans[2] == (0, 60)  # a centimetre is no movement, so nothing happens: kept as it is
    assert compute_digests(base) == before
    text = capsys.readouterr().out
    start, stop = spans[0]
    assert text.startswith(
        f"episode 0: 4.80 s, {start / FPS:.2f} s cut off the start, {(120 - stop) / FPS:.2f} s "
        f"off the end\n1 episode cut, "
    )


@pytest.mark.slow
def test_rows_and_pictures_stay_together(base, tmp_path):
    """Row and picture i of the new episode are row and picture start + i of the old one."""
    out = tmp_path / "out"
    start, stop = trim(base, out)[0]
    old, new = read_rows(base, 0), read_rows(out, 0)
    assert new["time.sim"].tolist() == old["time.sim"][start:stop].tolist()
    whole = read_pictures(base, 0, HEAD, FPS)
    np.testing.assert_array_equal(read_pictures(out, 0, HEAD, FPS), whole[start:stop])
    before, after = (load(f"local/{r.name}", root=r) for r in (base, out))
    for row in (0, 1, stop - start - 1):
        assert bool((after[row][HEAD] == before[start + row][HEAD]).all())


def test_margin(base, tmp_path):
    (start, stop) = trim(base, tmp_path / "none", "--margin", "0")[0]
    assert trim(base, tmp_path / "some", "--margin", "0.6")[0] == (start - 15, stop + 15)
    assert trim(base, tmp_path / "much", "--margin", "60")[0] == (0, 120)


@pytest.mark.parametrize(("ends", "kept"), [("start", (False, True)), ("end", (True, False))])
def test_one_end_only(base, tmp_path, ends, kept):
    start, stop = trim(base, tmp_path / "out", "--ends", ends)[0]
    assert (start == 0, stop == 120) == kept


def test_finer_limit(base, tmp_path):
    """What is under the limit stands still, so a finer one finds more that moves."""
    assert trim(base, tmp_path / "out", "--limit", "0.008", "--margin", "0")[2] != (0, 60)


def test_before_engaging_is_idle(base, tmp_path):
    root = tmp_path / "toy"
    shutil.copytree(base, root)
    set_columns(root, 2, **dict.fromkeys(POSES, move(60, 0, 60)))
    assert trim(root, tmp_path / "out", "--margin", "0")[2] == (10, 60)


def test_success_is_never_cut_off(base, tmp_path):
    """The end stays up to where success came, and the last row says that it is over."""
    root = tmp_path / "toy"
    shutil.copytree(base, root)
    late = np.arange(120) >= 112
    done = np.arange(120) == 119
    set_columns(root, 0, **{"next.success": late, "next.done": done})
    out = tmp_path / "out"
    start, stop = trim(root, out, "--margin", "0.2")[0]
    assert stop == 113
    rows = read_rows(out, 0)
    assert rows["next.success"].tolist() == [False] * (112 - start) + [True]
    assert rows["next.done"].tolist() == [False] * (112 - start) + [True]


def test_a_policy_drove(base, tmp_path):
    """Where nobody ever engages, what moves counts."""
    root = tmp_path / "toy"
    shutil.copytree(base, root)
    set_columns(root, 0, **{"operator.engaged": np.zeros(120, bool)})
    assert trim(root, tmp_path / "one") == trim(base, tmp_path / "two")


def test_others_datasets_by_their_action(tmp_path):
    root = make_foreign(tmp_path / "foreign", 1, 60)
    still = np.zeros((60, 3))
    still[20:40] = np.sin(np.arange(20))[:, None]
    set_columns(root, 0, action=still)
    start, stop = trim(root, tmp_path / "out", "--margin", "0.1")[0]
    assert start in range(20 - 1 - 4, 20)
    assert stop in range(40, 40 + 1 + 5)


def test_dry_run_and_in_place(base, tmp_path, capsys):
    root = tmp_path / "toy"
    shutil.copytree(base, root)
    before = compute_digests(root)
    assert main(["trim", "--root", str(root), "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert compute_digests(root) == before
    assert main(["trim", "--root", str(root), "--in-place"]) == 0
    assert capsys.readouterr().out == f"{said}written to {root.resolve()}\n"
    assert len(read_rows(root, 0)) < 120
    assert [path.name for path in tmp_path.iterdir()] == ["toy"]


@pytest.mark.parametrize(
    ("flags", "text"),
    [
        (["--margin", "-1"], "error: --margin must be finite and at least 0, got -1.0\n"),
        (["--limit", "nan"], "error: --limit must be finite and at least 0, got nan\n"),
    ],
)
def test_bad_flags(base, tmp_path, capsys, flags, text):
    assert main(["trim", "--root", str(base), "--out", str(tmp_path / "out"), *flags]) == 2
    assert capsys.readouterr().err == text
