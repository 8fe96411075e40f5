"""Malformed datasets before every verb: a clear error or a stated partial result, and no harm.

Whatever is wrong with a dataset, no verb ends in a traceback, none changes a file of the source,
and none leaves anything behind but a whole dataset.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from curate_data import compute_digests, make_foreign, make_synthetic, rewrite
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from lerobot.datasets import LeRobotDataset

from xop_lerobot.curate.cli import VERBS, main
from xop_lerobot.curate.source import Source
from xop_lerobot.curate.survey import survey
from xop_lerobot.recording.facts import CONFIG_FILE, EPISODES_FILE

pytestmark = pytest.mark.slow

EPISODES, FRAMES = 3, 30
FLAGS: dict[str, list[list[str]]] = {
    "inspect": [[]],
    "filter": [
        ["--out", "{out}", "--where", "duration > 0"],
        ["--out", "{out}", "--where", "success and tracking_p95 < 9 and readable"],
    ],
    "trim": [["--out", "{out}", "--margin", "0.1"]],
    "merge": [["--out", "{out}", "--root", "{intact}"]],
    "split": [["--out", "{out}", "--parts", "a=0.5", "b=0.5"]],
    "repair": [["--out", "{out}"]],
    "label": [["--out", "{out}", "--success", "tracking_p95 < 0.1"]],
    "retarget": [["--out", "{out}", "--robot", "rby1", "--dry-run"]],
}
"""Flags of each verb but for `--root`; a verb that is not named gets `--out` alone."""
READERS = ("inspect", "filter", "trim", "merge", "split", "report")
"""Verbs that go over all episodes and mend nothing."""


@pytest.fixture(scope="module")
def bases(tmp_path_factory) -> dict[str, Path]:
    """A whole dataset of ours without pictures, and somebody else's with a video."""
    folder = tmp_path_factory.mktemp("bases")
    return {
        "ours": make_synthetic(folder / "ours", EPISODES, FRAMES),
        "foreign": make_foreign(folder / "foreign", 2, FRAMES),
    }


def run_verbs(root: Path, intact: Path, capsys, verbs=tuple(VERBS)) -> dict[str, list]:
    """Run verbs on a dataset; returns exit code and standard error of each run.

    Checks all that must be so whatever is wrong.
    """
    before = compute_digests(root)
    results: dict[str, list] = {}
    for verb in verbs:
        for flags in FLAGS.get(verb, [["--out", "{out}"]]):
            out = root.parent / "out"
            words = [flag.format(out=out, intact=intact) for flag in flags]
            code = main([verb, "--root", str(root), "--quiet", *words])
            text, err = capsys.readouterr()
            what = f"{verb} {' '.join(words)}: {code}\n{text}\n{err}"
            assert code in (0, 1, 2), what
            assert "Traceback" not in err, what
            if code:
                assert "error: " in err or "problem: " in err, what
                assert len(err) < 4000 * EPISODES, what
            assert compute_digests(root) == before, f"changed the source: {what}"
            if verb == "report" and out.exists():  # what is readable is shown, whatever is not
                assert (out / "index.html").read_text().endswith("</html>\n"), what
                assert len(list(out.iterdir())) == 1, what
            elif code or "--dry-run" in words:
                assert not out.exists(), f"left something behind: {what}"
            if out.exists():
                for part in [path.parents[1] for path in out.rglob("meta/info.json")]:
                    check_whole(part)
                shutil.rmtree(out)
            rest = {path.name for path in root.parent.iterdir()} - {root.name}
            assert not rest, f"left {rest} behind: {what}"
            results.setdefault(verb, []).append((code, err))
    return results


def check_whole(root: Path) -> None:
    """Check that a dataset is readable and complete: every row of it, and every video."""
    with Source(root) as source:
        found = list(survey(source))
        assert all(finding.figures["readable"] for finding in found), found
        assert len(found) == source.total_episodes
        for finding in found:
            names = [key for key, each in source.features.items() if each["dtype"] != "video"]
            rows = source.read(finding.entry, names)
            assert (rows["frame_index"][:, 0] == np.arange(finding.entry.length)).all()


def spoil(root: Path, change: Callable[[Path], Any]) -> Path:
    change(root)
    return root


def edit_info(**changes: Any) -> Callable[[Path], None]:
    """A change of `meta/info.json`; None deletes a key."""

    def change(root: Path) -> None:
        path = root / "meta/info.json"
        info = json.loads(path.read_text()) | changes
        path.write_text(
            json.dumps({key: value for key, value in info.items() if value is not None})
        )

    return change


def edit_feature(key: str, **changes: Any) -> Callable[[Path], None]:
    def change(root: Path) -> None:
        path = root / "meta/info.json"
        info = json.loads(path.read_text())
        info["features"].setdefault(key, {}).update(changes)
        path.write_text(json.dumps(info))

    return change


def write(name: str, content: bytes) -> Callable[[Path], None]:
    def change(root: Path) -> None:
        (root / name).write_bytes(content)

    return change


def cut(name: str, share: float = 0.5) -> Callable[[Path], None]:
    def change(root: Path) -> None:
        content = (root / name).read_bytes()
        (root / name).write_bytes(content[: int(len(content) * share)])

    return change


def replace(name: str, old: bytes, new: bytes) -> Callable[[Path], None]:
    def change(root: Path) -> None:
        content = (root / name).read_bytes()
        assert old in content and len(old) == len(new)
        (root / name).write_bytes(content.replace(old, new))

    return change


def delete(name: str) -> Callable[[Path], None]:
    def change(root: Path) -> None:
        path = root / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return change


def edit_rows(
    name: str, drop: tuple[str, ...] = (), **columns: Callable[[pa.Table], Any]
) -> Callable[[Path], None]:
    """A change of columns of a parquet file; `__` in a name stands for a dot, `_s_` for a slash."""

    def change(root: Path) -> None:
        path = root / name
        table = pq.read_table(path)
        named = {key.replace("_s_", "/").replace("__", "."): make for key, make in columns.items()}
        rewrite(path, {key: make(table) for key, make in named.items()}, drop)

    return change


def keep_rows(name: str, first: int, last: int) -> Callable[[Path], None]:
    def change(root: Path) -> None:
        path = root / name
        pq.write_table(pq.read_table(path).slice(first, last - first), path)

    return change


def spoil_values(key: str, value: float) -> Callable[[Path], None]:
    def change(root: Path) -> None:
        path = root / DATA
        table = pq.read_table(path)
        column = table[key].combine_chunks()
        flat = column.flatten().to_numpy(zero_copy_only=False).copy()
        flat[: 7 * 10] = value
        new = pa.FixedSizeListArray.from_arrays(pa.array(flat), column.type.list_size)
        rewrite(path, {key: new})

    return change


def empty(root: Path) -> None:
    """A dataset of zero episodes, as LeRobot leaves it when nothing was recorded."""
    edit_info(total_episodes=0, total_frames=0, total_tasks=0)(root)
    for name in ("data", "meta/episodes", "meta/tasks.parquet", "meta/stats.json", "meta/xop"):
        delete(name)(root)


DATA = "data/chunk-000/file-000.parquet"
META = "meta/episodes/chunk-000/file-000.parquet"
VIDEO = "videos/observation.images.cam/chunk-000/file-000.mp4"
FATAL = {
    "no info": delete("meta/info.json"),
    "cut info": cut("meta/info.json"),
    "empty info": write("meta/info.json", b"\n"),
    "info is a list": write("meta/info.json", b"[]"),
    "info is no text": write("meta/info.json", b"\xff\xfe\x00"),
    "old version": edit_info(codebase_version="v2.1"),
    "no version": edit_info(codebase_version=None),
    "fps 0": edit_info(fps=0),
    "fps text": edit_info(fps="25"),
    "fps infinite": edit_info(fps=float("inf")),
    "no fps": edit_info(fps=None),
    "no features": edit_info(features=None),
    "features are a list": edit_info(features=["action"]),
    "feature without shape": edit_feature("more", dtype="float32"),
    "feature of no size": edit_feature("action", shape=[0]),
    "feature with text for shape": edit_feature("action", shape="22"),
    "feature without dtype": edit_feature("more", shape=[1]),
    "no data path": edit_info(data_path=None),
    "data path with unknown field": edit_info(data_path="data/{episode}.parquet"),
    "data path that leads out": edit_info(data_path="../other/file-{file_index:03d}.parquet"),
    "data path that is no pattern": edit_info(data_path="data/{"),
    "negative count": edit_info(total_episodes=-1),
    "count as text": edit_info(total_frames="many"),
    "robot as number": edit_info(robot_type=3),
}
"""Faults that leave nothing to show: every reader says so with exit code 1."""
PARTIAL = {
    "no metadata": delete("meta/episodes"),
    "cut metadata": cut(META),
    "metadata is text": write(META, b"episode_index,length\n0,30\n"),
    "metadata without lengths": edit_rows(META, drop=("length",)),
    "negative length": edit_rows(META, length=lambda t: [-1] * t.num_rows),
    "lengths as text": edit_rows(META, length=lambda t: ["30"] * t.num_rows),
    "too long": edit_rows(META, length=lambda t: [FRAMES + 5] * t.num_rows),
    "episode listed twice": edit_rows(META, episode_index=lambda t: [0] * t.num_rows),
    "file that is not there": edit_rows(META, data_s_file_index=lambda t: [77] * t.num_rows),
    "no data": delete("data"),
    "cut data": cut(DATA),
    "empty data": write(DATA, b""),
    "names that are no text": replace(DATA, b"goal.head", b"go\xdb\xffl.hed"),
    "data is text": write(DATA, b"PAR1 and no more than that PAR1"),
    "rows missing": keep_rows(DATA, 0, 20),
    "column missing": edit_rows(DATA, drop=("goal.head",)),
    "index missing": edit_rows(DATA, drop=("episode_index",)),
    "column of another shape": edit_rows(
        DATA, goal__head=lambda t: [[0.0] * 6] * t.num_rows
    ),
    "ragged column": edit_rows(
        DATA, goal__head=lambda t: [[0.0] * (6 + i % 3) for i in range(t.num_rows)]
    ),
    "column of scalars": edit_rows(DATA, goal__head=lambda t: [0.0] * t.num_rows),
    "column of texts": edit_rows(DATA, action=lambda t: [["x"] * 22] * t.num_rows),
    "column of empty values": edit_rows(
        DATA, goal__head=lambda t: pa.array([None] * t.num_rows, pa.list_(pa.float32(), 7))
    ),
    "entries that are empty": edit_rows(DATA, goal__head=lambda t: [[None] * 7] * t.num_rows),
    "feature without column": edit_feature(
        "operator.hat", dtype="float32", shape=[2], names=None
    ),
    "feature of another shape": edit_feature("robot.head", shape=[3]),
}  # fmt: skip
"""Faults of some episodes or columns: `inspect` names them and shows the rest, with exit code 1."""
HARMLESS = {
    "count that is too high": edit_info(total_episodes=99),
    "no tasks": delete("meta/tasks.parquet"),
    "cut tasks": cut("meta/tasks.parquet"),
    "no statistics": delete("meta/stats.json"),
    "cut statistics": cut("meta/stats.json"),
    "no facts": delete("meta/xop"),
    "facts are no JSON": write(str(EPISODES_FILE), b"\x00\xff{\nnull\n[]\n{}\n"),
    "facts of other kinds": write(
        str(EPISODES_FILE),
        b'{"episode_index": 0, "length": 30, "success": "yes", "robot": 3, "settings": []}\n'
        b'{"episode_index": "1"}\n',
    ),
    "configuration is no JSON": write(str(CONFIG_FILE), b"{"),
    "no number": spoil_values("goal.head", float("nan")),
    "infinite": spoil_values("robot.head", float("inf")),
    "zeros": spoil_values("robot.head", 0.0),
    "names that are none": edit_feature("retargeter.health", names=None),
    "zero episodes": empty,
}
"""What some verbs may refuse, and `inspect` shows at least in part."""
VIDEO_FAULTS = {
    "cut video": cut(VIDEO),
    "video without its end": cut(VIDEO, 0.99),
    "no video": delete(VIDEO),
    "empty video": write(VIDEO, b""),
    "video is text": write(VIDEO, b"this is no video" * 100),
    "video is not said where": edit_rows(
        META, drop=("videos/observation.images.cam/file_index",)
    ),
    "video without a pattern": edit_info(video_path=None),
    "another rate": edit_info(fps=30),
    "video too short": edit_rows(
        META, videos_s_observation__images__cam_s_to_timestamp=lambda t: [99.0] * t.num_rows
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FATAL)
def test_fatal_faults(fault, bases, tmp_path, capsys):
    root = Path(shutil.copytree(bases["ours"], tmp_path / "data"))
    results = run_verbs(spoil(root, FATAL[fault]), bases["ours"], capsys)
    for verb in READERS:
        for code, err in results[verb]:
            assert code == 1, (verb, err)
            assert err.count("\n") == 1
            assert err.startswith(f"error: dataset '{root}': ")


@pytest.mark.parametrize("fault", PARTIAL)
def test_partial_results(fault, bases, tmp_path, capsys):
    root = Path(shutil.copytree(bases["ours"], tmp_path / "data"))
    results = run_verbs(spoil(root, PARTIAL[fault]), bases["ours"], capsys)
    code, err = results["inspect"][0]
    assert code == 1
    assert "problem: " in err or f"error: dataset '{root}': " in err


@pytest.mark.parametrize("fault", HARMLESS)
def test_lesser_faults(fault, bases, tmp_path, capsys):
    root = Path(shutil.copytree(bases["ours"], tmp_path / "data"))
    results = run_verbs(spoil(root, HARMLESS[fault]), bases["ours"], capsys)
    assert "error: " not in results["inspect"][0][1]


@pytest.mark.parametrize("fault", VIDEO_FAULTS)
def test_faults_of_videos(fault, bases, tmp_path, capsys):
    root = Path(shutil.copytree(bases["foreign"], tmp_path / "data"))
    results = run_verbs(spoil(root, VIDEO_FAULTS[fault]), bases["foreign"], capsys)
    assert results["inspect"][0][0] == 1


@pytest.mark.parametrize("base", ["ours", "foreign"])
def test_whole_datasets_pass(base, bases, tmp_path, capsys):
    root = Path(shutil.copytree(bases[base], tmp_path / "data"))
    results = run_verbs(root, bases[base], capsys)
    assert results["inspect"][0] == (0, "")
    assert results["filter"][0] == (0, "")
    for verb in ("trim", "merge", "split", "repair"):
        assert results[verb][0][0] == 0, results[verb]
    out = tmp_path / "out"
    assert main(["filter", "--root", str(root), "--where", "duration > 0", "--out", str(out)]) == 0
    dataset = LeRobotDataset("local/out", root=out)
    assert len(dataset) == FRAMES * dataset.num_episodes
    for index in (0, len(dataset) - 1):
        dataset[index]


def test_datasets_that_do_not_fit_are_not_merged(bases, tmp_path, capsys):
    root = Path(shutil.copytree(bases["ours"], tmp_path / "data"))
    edit_info(fps=50)(root)
    for intact in bases.values():
        code, err = run_verbs(root, intact, capsys, ["merge"])["merge"][0]
        assert code in (1, 2)
        assert err.startswith("error: ")


def test_directory_that_is_no_dataset(tmp_path, bases, capsys):
    root = tmp_path / "data"
    root.mkdir()
    results = run_verbs(root, bases["ours"], capsys)
    assert all(code for runs in results.values() for code, _ in runs)


@given(data=st.data())
@settings(
    max_examples=12,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
def test_any_byte_of_any_file_may_be_wrong(data, bases, tmp_path_factory, capsys):
    """Bytes are overwritten at random anywhere but in the videos' and rows' contents.

    Those have check sums of neither format: that they hold another number is not to be seen.
    """
    folder = tmp_path_factory.mktemp("random")
    root = Path(shutil.copytree(bases["ours"], folder / "data"))
    files = sorted(path for path in root.rglob("*") if path.is_file())
    path = data.draw(st.sampled_from(files))
    content = bytearray(path.read_bytes())
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    tail = rng.random() < 0.5  # the end of a parquet file says where everything is
    first = max(0, len(content) - 2000) if tail else 0
    for _ in range(data.draw(st.integers(1, 20))):
        content[int(rng.integers(first, len(content)))] = int(rng.integers(256))
    path.write_bytes(bytes(content))
    run_verbs(root, bases["ours"], capsys, ["inspect", "filter"])
    shutil.rmtree(folder)
