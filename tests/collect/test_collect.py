"""`xop-collect`: the same episodes however they are made, none lost, one dataset in the end."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from lerobot.datasets import LeRobotDataset

import xop_lerobot.collect.folder as folder_module
from xop_lerobot.collect.cli import collect, main, make_parser, parse_arguments
from xop_lerobot.collect.config import CollectConfig
from xop_lerobot.collect.folder import CollectFolder, FolderTaken, OtherSettings
from xop_lerobot.collect.merge import merge_attempts
from xop_lerobot.collect.run import WorkerFailed
from xop_lerobot.collect.worker import Collector
from xop_lerobot.core.errors import BadValue, UnknownName, XopError
from xop_lerobot.operator.devices import DeviceConfig, make_device
from xop_lerobot.recording.facts import read_facts

REPO = Path(__file__).parents[2]
CONFIG = CollectConfig(
    "toy",
    "wait",
    seed=2,
    device="looker",
    method="direct",
    plugins=("collect_toy",),
    width=64,
    height=48,
)
OUTCOMES = [True, False, False, True, False]
"""Of the first episodes with the seed above; see `collect_toy.Wait`."""
HOST = ("time.wall", "retargeter.health")
"""Columns that tell of the host's clock."""
FOLDERS = ("tests/helpers", "teleoperators", "robots", ".")


@pytest.fixture(scope="module")
def orders(tmp_path_factory) -> Iterator[Path]:
    """Where the workers of this module look for what `collect_toy.obey` shall do.

    Their common parent process keeps the environment that it was started with.
    """
    folder = tmp_path_factory.mktemp("orders")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(str(REPO / name) for name in FOLDERS))
        patch.setenv("XOP_TEST_ORDERS", str(folder))
        yield folder


@pytest.fixture(autouse=True)
def without_orders(orders):
    """Leave no order behind."""
    yield
    for order in orders.iterdir():
        order.unlink()


@pytest.fixture(scope="module")
def serial(orders, tmp_path_factory) -> Path:
    """Five episodes of a single worker."""
    root = tmp_path_factory.mktemp("serial") / "data"
    result = collect(CONFIG, root, 5, "local/toy", workers=1)
    assert (result.episodes, result.successes) == (5, sum(OUTCOMES))
    return root


def read_content(root: Path) -> Any:
    """All rows of a dataset, without the host's clock."""
    table = pd.concat(pd.read_parquet(path) for path in sorted(root.glob("data/*/*.parquet")))
    return table.drop(columns=list(HOST)).reset_index(drop=True)


def load(root: Path) -> Any:
    return LeRobotDataset("local/toy", root=root)


def assert_same_content(root: Path, other: Path) -> None:
    pd.testing.assert_frame_equal(read_content(root), read_content(other))
    one, two = (load(each) for each in (root, other))
    for index in range(0, len(one), 7):
        picture, twin = (each[index]["observation.images.head"] for each in (one, two))
        assert np.array_equal(picture, twin), index
    for fact, twin in zip(read_facts(root), read_facts(other), strict=True):
        changing = {"start_time", "real_fps"}
        assert {k: v for k, v in fact.items() if k not in changing} == {
            k: v for k, v in twin.items() if k not in changing
        }


# Content.


@pytest.mark.slow
def test_dataset_loads_and_says_what_succeeded(serial):
    dataset = load(serial)
    assert (dataset.num_episodes, dataset.fps) == (5, 25)
    assert dataset.meta.robot_type == "xop_toy"
    assert list(dataset.meta.tasks.index) == ["wait for a moment"]
    rows = read_content(serial)
    last = rows.groupby("episode_index").last()
    assert last["next.success"].tolist() == OUTCOMES
    assert last["next.done"].all()
    assert rows["next.done"].sum() == 5
    assert [fact["success"] for fact in read_facts(serial)] == OUTCOMES
    assert [fact["episode_index"] for fact in read_facts(serial)] == list(range(5))
    # An index of the whole dataset, without a gap, and a picture for every row.
    assert rows["index"].tolist() == list(range(dataset.num_frames))
    assert dataset[len(dataset) - 1]["observation.images.head"].shape == (3, 48, 64)
    assert not list(serial.parent.glob("*.collecting"))


@pytest.mark.slow
def test_format_is_that_of_a_recorded_dataset(serial, tmp_path):
    """`xop-record` with the same robot, task and device writes the same, row by row."""
    recorded = tmp_path / "recorded"
    flags = {
        "robot.type": "xop_toy", "robot.task": "wait", "robot.seed": 2, "robot.sim.noise": "mild",
        "robot.width": 64, "robot.height": 48, "robot.low_level.name": "toy_hold",
        "teleop.type": "xop", "teleop.device.type": "looker", "teleop.device.seed": 2,
        "teleop.retargeter.type": "direct", "teleop.retargeter.threads": 1,
        "teleop.retargeter.seed": 2, "dataset.repo_id": "local/toy", "dataset.root": recorded,
        "dataset.fps": 25, "dataset.num_episodes": 2, "dataset.single_task": "wait for a moment",
        "dataset.episode_time_s": 1.3, "dataset.streaming_encoding": "true",
        "dataset.rgb_encoder.vcodec": "h264", "dataset.rgb_encoder.preset": "ultrafast",
        "dataset.push_to_hub": "false", "dataset.no_stamp": "true", "play_sounds": "false",
    }  # fmt: skip
    code = (
        "import collect_toy, sys; from xop_lerobot.recording.record import main;"
        "sys.argv[0] = 'xop-record'; main()"
    )
    arguments = [f"--{name}={value}" for name, value in flags.items()]
    subprocess.run([sys.executable, "-c", code, *arguments], check=True, capture_output=True)
    infos = [json.loads((root / "meta/info.json").read_text()) for root in (serial, recorded)]
    for info in infos:
        for name in ("total_episodes", "total_frames", "splits"):
            info.pop(name)
    assert infos[0] == infos[1]
    assert [p.name for p in sorted((recorded / "meta/xop").iterdir())] == [
        "config.json", "episodes.jsonl",
    ]  # fmt: skip
    configs = [
        json.loads((root / "meta/xop/config.json").read_text()) for root in (serial, recorded)
    ]
    assert configs[0] == configs[1]
    ours, theirs = read_content(serial), read_content(recorded)
    assert list(ours.columns) == list(theirs.columns)
    for episode in range(2):
        # The recording stops at its success and the collection when the task is done.
        mine = ours[ours.episode_index == episode]
        yours = theirs[theirs.episode_index == episode]
        length = min(len(mine), len(yours))
        assert length > 3
        pd.testing.assert_frame_equal(
            mine[:length].drop(columns=["index"]).reset_index(drop=True),
            yours[:length].drop(columns=["index"]).reset_index(drop=True),
        )
    facts, recorded_facts = read_facts(serial)[0], read_facts(recorded)[0]
    assert list(facts) == list(recorded_facts)
    assert facts["config_hash"] == recorded_facts["config_hash"]
    schemas = [
        pd.read_parquet(next(root.glob("meta/episodes/*/*.parquet"))).dtypes.to_dict()
        for root in (serial, recorded)
    ]
    assert schemas[0] == schemas[1]


def test_operator_columns_play_again(serial):
    device = make_device(DeviceConfig("replay", path=str(serial), episode=3))
    device.connect()
    device.start(0.0)
    rows = read_content(serial).query("episode_index == 3 and `operator.engaged`")
    assert len(rows) > 20
    for index in (0, 5, len(rows) - 1):
        frame = device.read(index / 25)
        assert frame is not None
        assert frame.head == pytest.approx(rows["operator.head"].iloc[index], abs=1e-6)
        assert frame.left_wrist == pytest.approx(rows["operator.left_wrist"].iloc[index], abs=1e-6)


@pytest.mark.slow
def test_parallel_is_serial(serial, tmp_path):
    result = collect(CONFIG, tmp_path / "data", 5, "local/toy", workers=3)
    assert result.frames == len(read_content(serial))
    assert result.sim_s == pytest.approx(result.frames / 25)
    assert_same_content(serial, tmp_path / "data")


@pytest.mark.slow
def test_more_episodes_are_added(serial, tmp_path):
    root = tmp_path / "data"
    first = collect(CONFIG, root, 2, workers=1)
    assert first.episodes == 2
    second = collect(CONFIG, root, 5, workers=2)
    assert (second.episodes, second.successes) == (5, 2)
    assert second.wall_s > first.wall_s
    assert_same_content(serial, root)
    # Nothing is left to be done, and nothing changes.
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    third = collect(CONFIG, root, 4)
    assert third == dataclasses.replace(second, wall_s=third.wall_s)
    assert third.wall_s == pytest.approx(second.wall_s, abs=2)
    assert before == {path: path.stat().st_mtime_ns for path in root.rglob("*")}


@pytest.mark.slow
def test_only_successful(serial, tmp_path):
    root = tmp_path / "data"
    config = dataclasses.replace(CONFIG, only_successful=True, video=False)
    result = collect(config, root, 5, workers=1)
    assert (result.episodes, result.successes) == (5, 2)
    rows, whole = read_content(root), read_content(serial)
    assert result.frames == len(rows)
    assert result.sim_s == pytest.approx(len(whole) / 25)
    kept = whole[whole.episode_index.isin([0, 3])].reset_index(drop=True)
    drawn = ["index", "episode_index", "observation.images.head"]
    pd.testing.assert_frame_equal(
        rows.drop(columns=drawn, errors="ignore"), kept.drop(columns=drawn, errors="ignore")
    )
    attempts = json.loads((root / "meta/xop/collect.json").read_text())["attempts"]
    assert [row["failure"] for row in attempts] == ["", "too long", "too long", "", "too long"]
    assert load(root)[0]["observation.images.head"].shape == (3, 48, 64)


# Kills.


FLAGS = (
    "--robot=toy", "--task=wait", "--seed=2", "--device=looker", "--method=direct",
    "--plugins=collect_toy", "--width=64", "--height=48",
)  # fmt: skip


def wait_for(condition, seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it took too long"
        time.sleep(0.02)


def is_alive(pid: int) -> bool:
    """Whether a process runs; one that nobody has waited for yet does not."""
    try:
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except FileNotFoundError:
        return False


@pytest.mark.slow
def test_kill_and_go_on(serial, orders, tmp_path, monkeypatch):
    """Killed with episodes finished and under way: none is lost, and none is made twice."""
    root = tmp_path / "data"
    work = CollectFolder(root).work / "attempts"
    command = [sys.executable, "-m", "xop_lerobot.collect.cli", *FLAGS, f"--root={root}"]
    process = subprocess.Popen([*command, "--episodes=5", "--workers=2"], stderr=subprocess.DEVNULL)
    wait_for(lambda: len(list(work.glob("[0-9]*/attempt.json"))) >= 2)
    (orders / "wait-1").touch()
    (orders / "wait-2").touch()
    wait_for(lambda: not list(orders.glob("wait-*")) or not work.exists())
    process.send_signal(signal.SIGKILL)
    process.wait()
    workers = [int(path.stem) for path in orders.glob("*.pid")]
    assert workers
    wait_for(lambda: not any(is_alive(pid) for pid in workers))
    saved = {path: path.stat().st_mtime_ns for path in work.glob("[0-9]*/attempt.json")}
    assert 2 <= len(saved) < 5
    assert not root.exists()

    made = []
    stock = CollectFolder.exchange
    monkeypatch.setattr(
        CollectFolder,
        "exchange",
        lambda folder, indices: (
            made.extend({path: path.stat().st_mtime_ns for path in saved}.items()),
            stock(folder, indices),
        )[1],
    )
    result = collect(CONFIG, root, 5, workers=2)
    assert dict(made) == saved
    assert (result.episodes, result.successes) == (5, 2)
    assert_same_content(serial, root)
    assert not CollectFolder(root).work.exists()


def test_sigterm_ends_in_one_line(orders, tmp_path, capsys):
    (orders / "wait-1").touch()

    def terminate() -> None:
        wait_for(lambda: not list(orders.glob("wait-*")))
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=terminate).start()
    root = tmp_path / "data"
    assert main([*FLAGS, f"--root={root}", "--episodes=4", "--workers=1"]) == 130
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.splitlines()[-1] == ("interrupted; run the same command again to resume")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_worker_that_dies_is_replaced(serial, orders, tmp_path, capsys):
    (orders / "die-1").touch()
    collect(CONFIG, tmp_path / "data", 2, workers=1)
    assert (
        "episode 0: the worker process died (signal SIGKILL); retrying" in capsys.readouterr().err
    )
    assert len(read_facts(tmp_path / "data")) == 2


def test_what_a_worker_raises_ends_the_run(orders, tmp_path):
    (orders / "raise-1").touch()
    with pytest.raises(WorkerFailed, match=r"^episode 0: (.|\n)*as the test asked for"):
        collect(CONFIG, tmp_path / "data", 2, workers=1)
    assert not list(tmp_path.iterdir())


@pytest.fixture
def finished(serial, tmp_path) -> CollectFolder:
    """A folder with one dataset of five episodes, and a whole one that shall replace it."""
    folder = CollectFolder(tmp_path / "data")
    shutil.copytree(serial, folder.root)
    folder.work.mkdir()
    shutil.copytree(serial, folder.merged)
    (folder.merged / "new").touch()
    return folder


def hold(folder: CollectFolder) -> None:
    with folder.hold(CONFIG.to_settings()):
        pass


def test_cut_before_the_exchange(finished):
    """Nothing says that `merged` is whole, so it is made again."""
    hold(finished)
    assert not (finished.root / "new").exists()
    assert not finished.work.exists()


def test_cut_between_the_two_renames(finished):
    os.rename(finished.root, finished.previous)
    hold(finished)
    assert (finished.root / "new").exists()
    assert not finished.work.exists()


def test_cut_before_the_episodes_own_files_are_deleted(finished, serial):
    attempt = finished.work / "attempts" / "000003"
    attempt.mkdir(parents=True)
    rows = json.loads((serial / folder_module.COLLECT_FILE).read_text())["attempts"]
    (attempt / "attempt.json").write_text(json.dumps(rows[3]))
    hold(finished)
    assert not finished.work.exists()


class Killed(BaseException):
    pass


class Fuse:
    """Ends a run before its n-th change of a file's name."""

    def __init__(self, left: int) -> None:
        self.left = left

    def wrap(self, action):
        def run(*args, **kwargs):
            if self.left == 0:
                raise Killed
            self.left -= 1
            return action(*args, **kwargs)

        return run


@pytest.mark.slow
def test_cut_at_any_file_of_the_exchange(serial, tmp_path, monkeypatch):
    """Whatever rename or deletion is the last before a kill, the next run ends with the same."""
    config = CONFIG
    whole = tmp_path / "whole"
    folder = CollectFolder(whole)
    with folder.hold(config.to_settings()):
        collector = Collector(config, 0.0)
        for index in range(2):
            draft = folder.open_attempt(index)
            folder.close_attempt(draft, collector.make(index, draft))
        collector.close()
    assert folder.work.exists()
    for last in range(12):
        root = tmp_path / f"cut_{last}"
        shutil.copytree(folder.work, CollectFolder(root).work)
        with monkeypatch.context() as patch:
            fuse = Fuse(last)
            for module, name in ((os, "rename"), (os, "replace"), (shutil, "rmtree")):
                patch.setattr(module, name, fuse.wrap(getattr(module, name)))
            try:
                with CollectFolder(root).hold(config.to_settings()):
                    merge_attempts(
                        CollectFolder(root), range(2), "local/toy", config.to_settings(), dict
                    )
                cut = False
            except Killed:
                cut = True
        result = collect(config, root, 2, workers=1)
        assert (result.episodes, len(read_facts(root))) == (2, 2)
        assert read_content(root).equals(read_content(serial).query("episode_index < 2"))
        assert not CollectFolder(root).work.exists()
        if not cut:
            break
    else:
        pytest.fail("the exchange has more steps than were cut")
    assert last > 3


# What is refused.


def check_refused(
    config: CollectConfig, root: Path, message: str, kind: type[XopError] = FolderTaken
) -> None:
    before = sorted(root.parent.rglob("*"))
    with pytest.raises(kind) as error:
        collect(config, root, 5)
    assert str(error.value) == message
    assert sorted(root.parent.rglob("*")) == before


def test_other_settings(serial, tmp_path):
    root = tmp_path / "data"
    shutil.copytree(serial, root)
    config = dataclasses.replace(CONFIG, seed=4, cameras=("head", "scene"), noise="off")
    message = (
        f"'{root}' was made with other settings: seed 2 (asked for: 4), cameras head (asked "
        "for: head,scene), noise mild (asked for: off). Ask for the same, choose another --root, "
        "or delete it"
    )
    check_refused(config, root, message, OtherSettings)


def test_other_settings_of_an_unfinished_collection(tmp_path):
    folder = CollectFolder(tmp_path / "data")
    with folder.hold(CONFIG.to_settings()):
        folder.open_attempt(0)
        (folder.work / "attempts" / "000000").mkdir()
    message = (
        f"'{folder.root}' was made with other settings: seed 2 (asked for: 5). Ask for the "
        "same, choose another --root, or delete it"
    )
    check_refused(dataclasses.replace(CONFIG, seed=5), folder.root, message, OtherSettings)


def test_dataset_of_others(serial, tmp_path):
    root = tmp_path / "data"
    shutil.copytree(serial, root)
    (root / folder_module.COLLECT_FILE).unlink()
    message = (
        f"'{root}' holds a dataset that xop-collect did not make. Choose another --root, or "
        "delete it"
    )
    check_refused(CONFIG, root, message)


def test_directory_of_others(tmp_path):
    root = tmp_path / "data"
    root.mkdir()
    (root / "letter.txt").touch()
    message = f"'{root}' exists and is no dataset. Choose another --root, or delete it"
    check_refused(CONFIG, root, message)


def test_two_runs_at_once(tmp_path):
    root = tmp_path / "data"
    with CollectFolder(root).hold(CONFIG.to_settings()):
        message = (
            f"another xop-collect is at work on '{root}'. Wait for it, or choose another --root"
        )
        check_refused(CONFIG, root, message)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"robot": "h1"}, "unknown robot 'h1'. Known: "),
        ({"task": "sleep"}, "unknown task 'sleep'. Known: "),
        ({"method": "magic"}, "unknown method 'magic'. Known: "),
        ({"noise": "loud"}, "unknown noise preset 'loud'. Known: harsh, mild, off"),
        ({"device": "mind"}, "unknown device 'mind'. Known: "),
        ({"low_level": "falcon"}, "unknown low-level policy of toy 'falcon'. Known: toy_hold"),
        ({"fps": 30}, "robot.fps must divide the low-level policy's 50 Hz, got 30. "),
        ({"plugins": ("no_such",)}, "plugin 'no_such' cannot be imported: No module named 'no_s"),
    ],
)
def test_bad_settings_leave_nothing_behind(change, message, tmp_path):
    with pytest.raises((UnknownName, BadValue)) as error:
        collect(dataclasses.replace(CONFIG, **change), tmp_path / "data", 1)
    assert str(error.value).startswith(message)
    assert not list(tmp_path.iterdir())


def test_bad_camera_is_told_in_one_line(tmp_path):
    config = dataclasses.replace(CONFIG, cameras=("tail",))
    with pytest.raises(WorkerFailed, match=r"^episode 0: unknown camera of toy 'tail'\. Known: "):
        collect(config, tmp_path / "data", 1)
    assert not list(tmp_path.iterdir())


# The command line.


def test_flags():
    config, args = parse_arguments(
        "--robot g1 --task box_pick_and_place --episodes 9 --seed 4 --root out --repo-id me/boxes "
        "--workers 3 --cameras head,scene --low-level falcon --fps 50 --width 64 --height 48 "
        "--noise off --method direct --only-successful --images".split()
    )
    assert config == CollectConfig(
        "g1", "box_pick_and_place", 4, ("head", "scene"), "falcon", fps=50, width=64, height=48,
        noise="off", method="direct", only_successful=True, video=False,
    )  # fmt: skip
    assert (args.episodes, args.root, args.repo_id, args.workers) == (9, Path("out"), "me/boxes", 3)


def test_help_states_units_and_defaults():
    text = " ".join(make_parser().format_help().split())
    assert "rate of control and dataset [Hz]; divides 50 (default: 25)" in text
    assert "cameras, comma-separated (default: head)" in text
    for action in make_parser()._actions:
        assert action.help


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--colour red", "error: unknown flag of xop-collect '--colour'. Known: --cameras, "),
        ("--episodes many", "error: argument --episodes: invalid int value: 'many'"),
        ("--episodes 0", "error: episodes must be at least 1, got 0"),
    ],
)
def test_bad_flags(flags, message, capsys, tmp_path):
    root = tmp_path / "data"
    assert main(f"--robot g1 --task t --episodes 1 --root {root} {flags}".split()) == 2
    assert capsys.readouterr().err.startswith(message)


def test_a_full_disk_ends_in_a_line(tmp_path, capsys, monkeypatch):
    def is_full(*_: object) -> None:
        raise OSError(28, "No space left on device", "data/file-000.parquet")

    monkeypatch.setattr("xop_lerobot.collect.cli.collect", is_full)
    flags = ["--robot=g1", "--task=dual_point_touch", "--episodes=1", f"--root={tmp_path}/a"]
    assert main(flags) == 1
    assert capsys.readouterr().err == (
        "error: [Errno 28] No space left on device: 'data/file-000.parquet'. Run the same "
        "command again to resume\n"
    )


def test_last_line_is_json(serial, tmp_path, capsys):
    root = tmp_path / "data"
    shutil.copytree(serial, root)
    assert main([*FLAGS, f"--root={root}", "--episodes=5"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert list(result) == ["episodes", "successes", "frames", "sim_s", "wall_s", "root"]
    assert (result["episodes"], result["successes"], result["root"]) == (5, 2, str(root))
