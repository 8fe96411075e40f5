"""`xop-curate inspect` and `filter`, and the source below them: right figures, stated gaps."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from curate_data import compute_digests, make_foreign, make_synthetic, rewrite
from lerobot.datasets import LeRobotDataset

from xop_lerobot.core.errors import BadDataset
from xop_lerobot.curate.cli import main
from xop_lerobot.curate.expression import Expression
from xop_lerobot.curate.measures import FIGURES
from xop_lerobot.curate.source import Source
from xop_lerobot.curate.survey import survey
from xop_lerobot.recording.columns import HEALTH_NAMES
from xop_lerobot.recording.facts import EPISODES_FILE, read_facts

REPO = Path(__file__).parents[2]
EPISODES = 6
FRAMES = 100


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    return make_synthetic(tmp_path_factory.mktemp("made") / "data", EPISODES, FRAMES)


@pytest.fixture(scope="module")
def foreign(tmp_path_factory) -> Path:
    return make_foreign(tmp_path_factory.mktemp("foreign") / "data")


@pytest.fixture
def data(made, tmp_path) -> Path:
    """A copy that may be spoilt."""
    return Path(shutil.copytree(made, tmp_path / "data"))


def find_file(root: Path, episode: int) -> Path:
    return root / f"data/chunk-000/file-{episode:03d}.parquet"


def set_column(root: Path, episode: int, name: str, values: np.ndarray) -> None:
    path = find_file(root, episode)
    kind = pq.read_schema(path).field(name).type
    flat = pa.array(values.reshape(-1))
    if pa.types.is_nested(kind):
        flat = pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    rewrite(path, {name: flat.cast(kind)})


def inspect(root: Path, capsys, *flags: str) -> tuple[int, list[dict], str]:
    """Exit code, rows and standard error of `inspect --json -`."""
    code = main(["inspect", "--root", str(root), "--json", "-", *flags])
    out, err = capsys.readouterr()
    return code, json.loads(out) if out else [], err


def read_one(root: Path, episode: int = 0) -> dict:
    with Source(root) as source:
        return list(survey(source))[episode].to_json()


# Figures.


def test_every_figure_is_in_every_row(made, capsys):
    code, rows, err = inspect(made, capsys)
    assert code == 0
    assert err == ""
    assert [row["episode"] for row in rows] == list(range(EPISODES))
    for row in rows:
        assert list(row) == [*FIGURES, "problems"]
        unknown = {name for name, value in row.items() if value is None}
        assert unknown == {"late_frames"}  # in lock-step the host's clock means nothing
        assert row["problems"] == []
        assert row["readable"] is True
        assert row["robot"] == "xop_g1"
        assert row["duration"] == 4.0
        assert row["engaged_time"] == 4.0


def test_figures_are_what_was_put_in(data):
    goal = Source(data).read(next(Source(data).episodes), ["goal.head"])["goal.head"]
    pose = goal.copy()
    pose[:, 1] += np.linspace(0, 0.2, FRAMES)
    set_column(data, 0, "robot.head", pose.astype(np.float32))
    for side in ("left_wrist", "right_wrist"):
        same = Source(data).read(next(Source(data).episodes), [f"goal.{side}"])[f"goal.{side}"]
        set_column(data, 0, f"robot.{side}", same)
    engaged = np.arange(FRAMES) >= 50
    set_column(data, 0, "operator.engaged", engaged)
    tracked = np.ones((FRAMES, 3), bool)
    tracked[:10] = False
    tracked[60:70, 2] = tracked[90:, 0] = False
    set_column(data, 0, "operator.tracked", tracked)
    stamps = 1 + np.arange(FRAMES) / 25
    stamps[30:] += 3 / 25
    set_column(data, 0, "time.sim", stamps)
    health = np.zeros((FRAMES, len(HEALTH_NAMES)), np.float32)
    health[:, HEALTH_NAMES.index("plan_age")] = np.linspace(0, 0.99, FRAMES)
    health[80:85, HEALTH_NAMES.index("status")] = 1
    set_column(data, 0, "retargeter.health", health)
    row = read_one(data)
    assert row["problems"] == []
    assert row["tracking_head_mean"] == pytest.approx(0.1 + 0.2 * 25 / 99, abs=1e-3)
    assert row["tracking_head_p95"] == pytest.approx(0.2 * 96.5 / 99, abs=1e-3)
    assert row["tracking_head_angle_p95"] == pytest.approx(0, abs=1e-3)
    assert row["tracking_left_wrist_mean"] == 0
    assert row["tracking_mean"] == pytest.approx(row["tracking_head_mean"] / 3)
    assert row["engaged_time"] == pytest.approx(2.0)
    assert row["gaps"] == 2
    assert row["gap_time"] == pytest.approx(0.8)
    assert row["gap_max"] == pytest.approx(0.4)
    assert row["missing_frames"] == 3
    assert row["plan_age_mean"] == pytest.approx(0.745)
    assert row["plan_age_max"] == pytest.approx(0.99)
    assert row["unsolved"] == 5
    assert row["idle_start"] == pytest.approx(2.0)
    assert row["idle_time"] == pytest.approx(2.0, abs=0.1)
    assert row["idle_end"] < 0.1


def test_idle_ends_are_found(data):
    entry = next(Source(data).episodes)
    names = [f"{kind}.{frame}" for kind in ("operator", "robot") for frame in
             ("head", "left_wrist", "right_wrist")]  # fmt: skip
    for name in [*names, "robot.base_pose"]:
        pose = Source(data).read(entry, [name])[name].copy()
        pose[:40], pose[80:] = pose[40], pose[79]
        if name.startswith("robot"):  # no noise
            pose[:] = pose[0] if name == "robot.base_pose" else pose[40]
        set_column(data, 0, name, pose)
    row = read_one(data)
    assert row["idle_start"] == pytest.approx(40 / 25, abs=0.25)
    assert row["idle_end"] == pytest.approx(20 / 25, abs=0.25)


def test_late_frames_are_those_of_real_time(data):
    lines = [json.loads(line) for line in (data / EPISODES_FILE).read_text().splitlines()]
    lines[0]["clock"] = "realtime"
    (data / EPISODES_FILE).write_text("".join(json.dumps(line) + "\n" for line in lines))
    stamps = np.arange(FRAMES) * 40_000_000
    stamps[50:] += 100_000_000
    set_column(data, 0, "time.wall", stamps)
    assert read_one(data)["late_frames"] == 1
    assert read_one(data, 1)["late_frames"] is None


def test_clock_that_was_set_is_named_and_harms_nothing(data, capsys):
    wall = 1_700_000_000_000_000_000 + np.arange(FRAMES) * 40_000_000
    wall[50:] += 3_600_000_000_000
    set_column(data, 0, "time.wall", wall)
    wall[50:] -= 3_590_000_000_000  # in lock-step, the machine may have taken ten seconds
    set_column(data, 1, "time.wall", wall)
    wall[70:] -= 30_000_000_000
    set_column(data, 2, "time.wall", wall)
    code, rows, _ = inspect(data, capsys)
    assert code == 1
    assert [row["problems"] for row in rows[:3]] == [
        ["the clock 'time.wall' jumps by +3600 s at row 50 of episode 0; it is replayed without"],
        [],
        ["the clock 'time.wall' jumps by -30 s at row 70 of episode 2; it is replayed without"],
    ]
    assert all(row["readable"] for row in rows)


def test_positions_that_32_bits_cannot_hold_are_named(data, capsys):
    pose = Source(data).read(next(Source(data).episodes), ["operator.head"])["operator.head"]
    for far, code in ((2000, 0), (5_411_000, 1)):
        moved = pose + np.array([far, 0, 0, 0, 0, 0, 0], np.float32)
        set_column(data, 0, "operator.head", moved)
        found, rows, _ = inspect(data, capsys)
        assert found == code
    assert rows[0]["problems"] == [
        "'operator.head' of episode 0 is up to 5411000 m from the origin, where float32 has steps "
        "of 0.5 m"
    ]


def test_where_no_facts_are_the_columns_decide(data, made):
    before = [read_one(made, i) for i in range(EPISODES)]
    (data / EPISODES_FILE).unlink()
    for path in (data / "meta/episodes").rglob("*.parquet"):
        drop = [name for name in pq.read_schema(path).names if name.startswith("xop/")]
        rewrite(path, {}, tuple(drop))
    set_column(data, 2, "robot.base_pose", np.tile([0, 0, 0.1, 1, 0, 0, 0], (FRAMES, 1)))
    with Source(data) as source:
        after = [finding.figures for finding in survey(source)]
    assert [row["success"] for row in after] == [row["success"] for row in before]
    assert [row["fall"] for row in after] == [row["fall"] or i == 2 for i, row in enumerate(before)]
    assert {row["collision"] for row in after} == {None}
    assert {row["robot"] for row in after} == {"xop_g1"}
    assert len({row["success"] for row in after}) == 2, "the seed makes only one kind"


def test_a_policy_that_drove_has_no_operator(data):
    for name in ("operator.engaged", "operator.tracked", "goal.head", "goal.left_wrist",
                 "goal.right_wrist", "retargeter.health"):  # fmt: skip
        values = Source(data).read(next(Source(data).episodes), [name])[name]
        set_column(data, 0, name, np.zeros_like(values))
    row = read_one(data)
    assert row["problems"] == []
    assert row["engaged_time"] == 0
    for name in ("tracking_p95", "gaps", "plan_age_mean", "unsolved", "hand_jerk"):
        assert row[name] is None, name
    assert row["idle_time"] < row["duration"]


def test_stale_line_of_another_length_is_not_believed(data):
    lines = [json.loads(line) for line in (data / EPISODES_FILE).read_text().splitlines()]
    lines[0] |= {"length": 7, "success": "of another", "scene": "another"}
    (data / EPISODES_FILE).write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert read_one(data)["scene"] == "empty"


def test_foreign_dataset_gives_what_it_can(foreign, capsys):
    code, rows, err = inspect(foreign, capsys)
    assert code == 0
    assert err == ""
    known = {name for name, value in rows[0].items() if value is not None}
    assert known == {
        "episode", "length", "duration", "robot", "task", "command_ldlj", "idle_start", "idle_end",
        "idle_time", "readable", "problems",
    }  # fmt: skip
    assert [row["task"] for row in rows] == ["task 0", "task 1"]
    assert main(["inspect", "--root", str(foreign)]) == 0
    out = capsys.readouterr().out
    assert "success -, a fall -" in out


# Output.


def test_table(made, capsys):
    assert main(["inspect", "--root", str(made), "--show", "episode, success,length,task"]) == 0
    out, err = capsys.readouterr()
    lines = out.splitlines()
    assert lines[0].split() == ["ep", "success", "length", "task"]
    assert lines[2].split()[:3] == ["0", "yes" if read_facts(made)[0]["success"] else "no", "100"]
    assert f"{EPISODES} episodes, {EPISODES * FRAMES} frames, 24.0 s" in out
    assert "robots: xop_g1 (6)" in out
    assert f"episodes with success {sum(row['success'] for row in read_facts(made))}," in out
    assert err == ""


def test_json_file_equals_standard_output(made, tmp_path, capsys):
    path = tmp_path / "deep" / "figures.json"
    assert main(["inspect", "--root", str(made), "--json", str(path)]) == 0
    capsys.readouterr()
    assert json.loads(path.read_text()) == inspect(made, capsys)[1]
    assert list(path.parent.iterdir()) == [path]


def test_json_that_cannot_be_written(made, tmp_path, capsys):
    (tmp_path / "file").touch()
    assert main(["inspect", "--root", str(made), "--json", str(tmp_path / "file" / "x")]) == 2
    assert "cannot be written" in capsys.readouterr().err


def test_unknown_figure_is_refused(made, capsys):
    assert main(["inspect", "--root", str(made), "--show", "episode,trackin_p95"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: unknown metric 'trackin_p95'. Did you mean 'tracking_p95'? Known")
    assert main(["inspect", "--root", str(made), "--show", " , "]) == 2
    assert "--show must name metrics" in capsys.readouterr().err


@pytest.mark.slow
def test_reader_that_has_seen_enough(made):
    command = f"{sys.executable} -m xop_lerobot.curate.cli inspect --root {made} | head -1"
    done = subprocess.run(command, shell=True, cwd=REPO, capture_output=True, text=True)
    assert done.stdout.split()[0] == "ep"
    assert "Traceback" not in done.stderr


# The command.


@pytest.mark.slow
def test_help_lists_verbs_and_loads_nothing_heavy():
    code = (
        "import sys; from xop_lerobot.curate.cli import main\n"
        "try: main(['--help'])\nexcept SystemExit as end: assert end.code == 0\n"
        "heavy = {'torch', 'mujoco', 'lerobot', 'scipy.signal', 'bokeh'} & set(sys.modules)\n"
        "sys.exit(f'heavy: {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=REPO, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "  inspect " in done.stdout
    assert "  filter " in done.stdout


def test_usage_errors(made, capsys):
    cases = {
        (): "a verb is missing. Known: inspect, filter",
        ("inspct",): "unknown verb of xop-curate 'inspct'. Known: filter",
        ("inspect",): "the following arguments are required: --root",
        ("inspect", "--rot", "x", "--root", "y"): "unknown flag of xop-curate inspect '--rot'. "
        "Known: --help, --json, --quiet, --root, --show",
        ("inspect", "--rot", "x"): "unknown flag of xop-curate inspect '--rot'. Known: --help",
        ("filter", "--root", str(made), "--where", "success"): "missing output: pass "
        "--out=DIR, --in-place, or --dry-run",
        ("filter", "--root", str(made), "--where", "success", "--out", "x", "--in-place"): "--out "
        "and --in-place exclude each other",
        ("--all",): "unknown flag of xop-curate '--all'. Known: --help",
    }
    for words, message in cases.items():
        assert main(list(words)) == 2, words
        assert message in capsys.readouterr().err


def test_missing_dataset(tmp_path, capsys):
    assert main(["inspect", "--root", str(tmp_path / "no")]) == 1
    assert capsys.readouterr().err == (
        f"error: dataset '{tmp_path / 'no'}': there is no such directory\n"
    )


def test_every_figure_is_documented():
    text = (REPO / "docs" / "use" / "curate.md").read_text()
    table = text.split("## inspect")[1].split("## filter")[0]
    for name in FIGURES:
        if not name.startswith(("tracking_head", "tracking_left", "tracking_right")):
            assert f"`{name}`" in table, name


# Filter.


def test_filter_keeps_what_holds(made, tmp_path, capsys):
    before = compute_digests(made)
    kept = [row["episode_index"] for row in read_facts(made) if row["success"]]
    out = tmp_path / "out"
    assert main(["filter", "--root", str(made), "--where", "success", "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert f"{len(kept)} of {EPISODES} episodes kept" in text
    assert f"written to {out}" in text
    assert compute_digests(made) == before
    facts = read_facts(out)
    assert [row["success"] for row in facts] == [True] * len(kept)
    assert [row["provenance"][-1]["source_episode"] for row in facts] == kept
    assert facts[0]["provenance"][-1]["arguments"] == {"where": "success"}
    dataset = LeRobotDataset("local/out", root=out)
    assert dataset.num_episodes == len(kept)
    with Source(made) as old, Source(out) as new:
        entries = [entry for entry in old.episodes if entry.index in kept]
        for entry, other in zip(entries, new.episodes, strict=True):
            names = [name for name in old.features if name not in ("episode_index", "index")]
            was, now = old.read(entry, names), new.read(other, names)
            for name in names:
                assert np.array_equal(was[name], now[name]), name


def test_filter_in_place(data, capsys):
    where = "tracking_p95 < 0.05 or not success"
    expected = [row for row in range(EPISODES) if read_one(data, row)["tracking_p95"] < 0.05
                or not read_one(data, row)["success"]]  # fmt: skip
    assert 0 < len(expected) < EPISODES
    assert main(["filter", "--root", str(data), "--where", where, "--in-place"]) == 0
    sources = [row["provenance"][-1]["source_episode"] for row in read_facts(data)]
    assert sources == expected
    assert [path.name for path in data.parent.iterdir()] == ["data"]


def test_dry_run_does_nothing(made, tmp_path, capsys):
    before = compute_digests(made)
    flags = ["--where", "success", "--dry-run", "--out", str(tmp_path / "out")]
    assert main(["filter", "--root", str(made), *flags]) == 0
    assert f"of {EPISODES} episodes kept" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()
    assert compute_digests(made) == before


def test_unknown_is_left_out_or_kept(foreign, tmp_path, capsys):
    flags = ["filter", "--root", str(foreign), "--where", "episode == 0 and tracking_p95 < 1"]
    out = tmp_path / "out"
    assert main([*flags, "--out", str(out)]) == 1
    assert capsys.readouterr().err.endswith(
        "error: 'episode == 0 and tracking_p95 < 1' holds for none of the 2 episodes: for 1 it is "
        "not known (tracking_p95 in 1). No dataset is made\n"
    )
    assert not out.exists()
    assert main([*flags, "--out", str(out), "--keep-unknown"]) == 0
    text = capsys.readouterr().out
    assert "1 of 2 episodes kept" in text
    assert "not known for 1, kept: tracking_p95 in 1" in text
    assert LeRobotDataset("local/out", root=out).num_episodes == 1


def test_expression_is_checked_before_anything_is_read(tmp_path, capsys):
    flags = ["filter", "--root", str(tmp_path), "--dry-run", "--where"]
    assert main([*flags, "sucess"]) == 2
    assert "unknown metric 'sucess'. Did you mean 'success'?" in capsys.readouterr().err
    assert main([*flags, "duration"]) == 2
    assert "must be yes or no" in capsys.readouterr().err


def test_only_the_columns_that_are_asked_for_are_read(data, capsys):
    find_file(data, 0).write_bytes(b"no parquet")
    assert main(["filter", "--root", str(data), "--where", "success", "--dry-run"]) == 0
    assert capsys.readouterr().err == ""


def test_unreadable_episode_that_is_chosen(data, tmp_path, capsys):
    find_file(data, 0).write_bytes(b"no parquet")
    flags = ["filter", "--root", str(data), "--out", str(tmp_path / "out"), "--where"]
    assert main([*flags, "duration > 0"]) == 1
    err = capsys.readouterr().err
    assert "file-000.parquet is not readable" in err
    assert '--where "(duration > 0) and readable" leaves such episodes out' in err
    assert [path.name for path in tmp_path.iterdir()] == ["data"]
    assert main([*flags, "(duration > 0) and readable"]) == 0
    assert len(read_facts(tmp_path / "out")) == EPISODES - 1


# The source.


def test_episodes_in_one_file_and_one_row_group(made, tmp_path):
    root = Path(shutil.copytree(made, tmp_path / "one"))
    tables = [pq.read_table(find_file(root, i)) for i in range(EPISODES)]
    pq.write_table(pa.concat_tables(tables), find_file(root, 0))
    for path in (root / "meta/episodes").rglob("*.parquet"):
        count = pq.read_metadata(path).num_rows
        rewrite(path, {"data/file_index": [0] * count})
    with Source(made) as one, Source(root) as other:
        for entry, again in zip(one.episodes, other.episodes, strict=True):
            names = list(one.features)
            expected, got = one.read(entry, names), other.read(again, names)
            assert all(np.array_equal(expected[name], got[name]) for name in names)


def test_columns_that_are_not_there(made):
    with Source(made) as source, pytest.raises(BadDataset) as caught:
        source.read(next(source.episodes), ["action", "operator.hat"])
    text = str(caught.value)
    assert text.startswith(f"dataset '{made}': it has no column operator.hat. Its columns: action,")


def test_arrays_have_two_dimensions_and_the_dtypes_of_the_file(made):
    with Source(made) as source:
        rows = source.read(next(source.episodes), ["action", "next.done", "time.wall", "time.sim"])
    assert {name: (array.shape, str(array.dtype)) for name, array in rows.items()} == {
        "action": ((FRAMES, 22), "float32"),
        "next.done": ((FRAMES, 1), "bool"),
        "time.wall": ((FRAMES, 1), "int64"),
        "time.sim": ((FRAMES, 1), "float64"),
    }


@pytest.mark.slow
def test_memory_does_not_grow_with_the_dataset(tmp_path):
    """Peak memory of a process that inspects 5 and 60 episodes of 2,000 frames."""
    peaks = []
    for count in (5, 60):
        root = make_synthetic(tmp_path / str(count), count, 2000)
        code = (
            "import resource, pyarrow, contextlib, io\n"
            "from xop_lerobot.curate.cli import main\n"
            f"with contextlib.redirect_stdout(io.StringIO()):\n"
            f"    assert main(['inspect', '--root', {str(root)!r}]) == 0\n"
            "print(next(l for l in open('/proc/self/status') if l.startswith('VmHWM')).split()[1])"
        )
        done = subprocess.run(
            [sys.executable, "-c", code], cwd=REPO, capture_output=True, text=True, check=True
        )
        peaks.append(int(done.stdout) / 1024)
    rows = 55 * 2000 * 216 * 4 / 1e6
    assert peaks[1] - peaks[0] < rows / 3, f"{peaks} MB; the rows that came on top are {rows} MB"


# Crashes.


def test_ctrl_c_leaves_everything_as_it_was(data, capsys, monkeypatch):
    before = compute_digests(data)
    monkeypatch.setattr(Expression, "evaluate", interrupt_at(3))
    flags = ["filter", "--root", str(data), "--where", "duration > 0"]
    assert main([*flags, "--in-place"]) == 130
    assert capsys.readouterr().err == "interrupted; nothing was changed\n"
    monkeypatch.setattr(Expression, "evaluate", interrupt_at(3))
    assert main([*flags, "--out", str(data.parent / "deep" / "out")]) == 130
    assert compute_digests(data) == before
    assert [path.name for path in data.parent.iterdir()] == ["data"]


def interrupt_at(count: int):
    """An `evaluate` that is interrupted when it is called for the `count`th time."""
    calls = []

    def evaluate(expression, values) -> bool:
        calls.append(values)
        if len(calls) == count:
            raise KeyboardInterrupt
        return True

    return evaluate


@pytest.mark.slow
def test_kill_leaves_the_source_and_the_next_run_goes_through(data):
    before = compute_digests(data)
    where = "duration > 0 and episode != 1"
    flags = ["filter", "--root", str(data), "--where", where, "--in-place"]
    code = (
        "import os, signal\n"
        "from xop_lerobot.curate.cli import main\n"
        "from xop_lerobot.curate.expression import Expression\n"
        "stock = Expression.evaluate\n"
        "def evaluate(self, values):\n"
        "    if values['episode'] == 4: os.kill(os.getpid(), signal.SIGKILL)\n"
        "    return stock(self, values)\n"
        "Expression.evaluate = evaluate\n"
        f"main({flags!r})"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=REPO, capture_output=True)
    assert done.returncode == -signal.SIGKILL
    assert compute_digests(data) == before
    assert {path.name for path in data.parent.iterdir()} == {"data", ".data.curating"}
    assert main(flags) == 0
    assert [row["episode_index"] for row in read_facts(data)] == list(range(EPISODES - 1))
    assert [path.name for path in data.parent.iterdir()] == ["data"]
