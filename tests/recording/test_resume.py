"""Adding to a dataset: what does not fit is named, before the robot moves, and nothing changes."""

from __future__ import annotations

import json
import logging
import shutil
from pathlib import Path

import pytest
from lerobot.datasets import LeRobotDataset
from toy_robot import make_teleop, make_toy

from tests.recording.test_dataset import STREAMING, create, tick
from tests.recording.test_lerobot_cli import TELEOP, record_flags, run
from tests.recording.test_rollback import read_files
from xop_lerobot.core.errors import BadDataset, BadValue
from xop_lerobot.recording.dataset import XopDataset
from xop_lerobot.recording.facts import CONFIG_FILE, CONFIGS_DIR, read_facts
from xop_lerobot.recording.opening import NotResumable
from xop_lerobot.recording.record import build_features

pytestmark = pytest.mark.slow

HINT = "Record with the same settings, or start another --dataset.root without --resume=true"


@pytest.fixture
def session(request) -> str:
    return request.node.name


def record_episode(session: str, root: Path, **settings) -> None:
    robot, teleop = make_toy(session, **settings), make_teleop(session)
    teleop.connect()
    robot.connect()
    if root.exists():
        dataset = XopDataset.bind(session).resume("local/toy", root=root, **STREAMING)
    else:
        dataset = create(session, robot, root, **STREAMING)
    for _ in range(2):
        tick(robot, teleop, dataset)
    dataset.save_episode()
    dataset.finalize()
    teleop.disconnect()
    robot.disconnect()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """A dataset of one episode with one camera of 64 x 48."""
    root = tmp_path_factory.mktemp("recorded") / "data"
    record_episode("recorded", root)
    return root


def refuse(session: str, root: Path, **settings) -> str:
    """Try to add to a dataset; return why that is refused, after a look at its files."""
    before = read_files(root)
    robot = make_toy(session, **settings)
    with pytest.raises(NotResumable) as refusal:
        XopDataset.bind(session).resume("local/toy", root=root, image_writer_threads=1)
    robot.disconnect()
    assert read_files(root) == before
    text = str(refusal.value)
    assert text.startswith(f"'{root}' cannot be added to: ")
    assert text.endswith(f". {HINT}")
    assert "\n" not in text
    return text.removeprefix(f"'{root}' cannot be added to: ").removesuffix(f". {HINT}")


SIZE = (
    "its images of camera 'head' are 64 x 48, and the robot's {} x {}; use --robot.width=64 "
    "--robot.height=48"
)
MISFITS = {
    "width": ({"width": 96}, SIZE.format(96, 48)),
    "height": ({"height": 64}, SIZE.format(64, 64)),
    "turned": ({"width": 48, "height": 64}, SIZE.format(48, 64)),
    "no camera": (
        {"cameras": []},
        "its cameras are [head], and the robot's []; use --robot.cameras=[head]",
    ),
    "another camera": (
        {"cameras": "back"},
        "its cameras are [head], and the robot's [back]; use --robot.cameras=[head]",
    ),
    "one camera more": (
        {"cameras": "head,back"},
        "its cameras are [head], and the robot's [head,back]; use --robot.cameras=[head]",
    ),
    "one camera more, and larger": (
        {"cameras": "head,back", "width": 96},
        "its cameras are [head], and the robot's [head,back]; use --robot.cameras=[head]; "
        + SIZE.format(96, 48),
    ),
}


@pytest.mark.parametrize("misfit", MISFITS)
def test_other_cameras_and_sizes(session, recorded, misfit):
    settings, expected = MISFITS[misfit]
    assert refuse(session, recorded, **settings) == expected


def change_info(root: Path, copy: Path, change) -> Path:
    """A copy of a dataset whose `info.json` is changed."""
    shutil.copytree(root, copy)
    path = copy / "meta" / "info.json"
    info = json.loads(path.read_text())
    change(info)
    path.write_text(json.dumps(info))
    return copy


def set_names(column: str, change):
    def apply(info: dict) -> None:
        feature = info["features"][column]
        feature["names"] = change(feature["names"])
        feature["shape"] = [len(feature["names"])]

    return apply


def add_column(name: str):
    return lambda info: info["features"].update(
        {name: {"dtype": "int64", "shape": [1], "names": None}}
    )


CHANGES = {
    "another robot": (
        lambda info: info.update(robot_type="xop_g1"),
        "it is of xop_g1, and the robot is xop_toy",
    ),
    "other joints": (
        set_names("action", lambda names: ["grip.pos", *names[1:]]),
        "its action lacks lift.pos; its action has grip.pos, which the robot lacks",
    ),
    "a smaller state": (
        set_names("observation.state", lambda names: names[4:]),
        "its observation.state lacks lift.pos, left_shoulder.pos, left_elbow.pos and 1 more",
    ),
    "a labelled column": (
        add_column("subtask_index"),
        "it has columns that are not recorded here (subtask_index)",
    ),
    "a column of ours is gone": (
        lambda info: info["features"].pop("robot.effort"),
        "of this project's columns it has some and lacks robot.effort",
    ),
    "a column of a later version": (
        add_column("operator.gaze"),
        "it has columns of another version (operator.gaze)",
    ),
}


@pytest.mark.parametrize("change", CHANGES)
def test_other_columns(session, recorded, tmp_path, change):
    apply, expected = CHANGES[change]
    assert refuse(session, change_info(recorded, tmp_path / "data", apply)) == expected


def test_a_rollouts_interventions_are_added_to(session, recorded, tmp_path):
    """LeRobot's DAgger fills this column itself."""
    root = change_info(recorded, tmp_path / "data", add_column("intervention"))
    robot = make_toy(session)
    XopDataset.bind(session).resume("local/toy", root=root).finalize()
    robot.disconnect()


def test_what_is_no_dataset(session, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    robot, bound = make_toy(session), XopDataset.bind(session)
    with pytest.raises(BadValue) as refusal:
        bound.resume("local/toy")
    assert str(refusal.value) == (
        "--resume=true needs --dataset.root, the directory of the dataset"
    )
    (tmp_path / "empty").mkdir()
    for name in ("empty", "absent"):
        with pytest.raises(BadDataset) as absent:
            bound.resume("local/toy", root=tmp_path / name)
        assert str(absent.value) == (
            f"dataset '{tmp_path}/{name}': there is no dataset, and 'local/toy' was not found on "
            "the Hub either. Omit --resume to create it"
        )
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]
    robot.disconnect()


@pytest.mark.parametrize("damage", ["", "{", '{"features": 3}'])
def test_a_damaged_dataset_is_repaired(session, recorded, tmp_path, damage):
    root = tmp_path / "data"
    shutil.copytree(recorded, root)
    (root / "meta" / "info.json").write_text(damage)
    robot = make_toy(session)
    with pytest.raises(BadDataset) as refusal:
        XopDataset.bind(session).resume("local/toy", root=root)
    text = str(refusal.value)
    assert text.startswith(f"dataset '{root}': it cannot be read (")
    assert text.endswith(f"`xop-curate repair --root {root} --out DIR` restores what is complete")
    robot.disconnect()


def test_the_configuration_is_written_with_an_episode(session, recorded, tmp_path):
    """A session that records nothing changes nothing, and none loses another one's."""
    root = tmp_path / "data"
    shutil.copytree(recorded, root)
    before = read_files(root)
    robot = make_toy(session, seed=7)
    XopDataset.bind(session).resume("local/toy", root=root).finalize()
    robot.disconnect()
    assert read_files(root) == before

    record_episode(f"{session}-7", root, seed=7)
    assert (root / CONFIG_FILE).read_bytes() == before[str(CONFIG_FILE)]
    hashes = [row["config_hash"] for row in read_facts(root)]
    assert len(set(hashes)) == 2
    configs = {path.stem: json.loads(path.read_text()) for path in (root / CONFIGS_DIR).iterdir()}
    assert [configs[each]["robot"]["seed"] for each in hashes] == [0, 7]
    assert LeRobotDataset("local/toy", root=root).num_episodes == 2


@pytest.mark.parametrize("command", ["xop-record", "lerobot-record"])
def test_the_commands_refuse_in_a_line(recorded, monkeypatch, command):
    """Before either device is connected."""
    connected = []
    monkeypatch.setattr("toy_robot.XopToy.connect", lambda *_: connected.append("robot"))
    monkeypatch.setattr("toy_robot.Xop.connect", lambda *_: connected.append("teleop"))
    before = read_files(recorded)
    robot = ("--robot.type=xop_toy", "--robot.width=96", "--robot.height=48")
    flags = [*robot, *TELEOP, *record_flags(recorded), "--resume=true", "--play_sounds=false"]
    with pytest.raises((SystemExit, NotResumable), match=SIZE.format(96, 48)):
        run(monkeypatch, command, *flags)
    assert not connected
    assert read_files(recorded) == before


def test_pictures_in_files_are_not_added_to_as_videos(recorded, monkeypatch, caplog):
    robot = ("--robot.type=xop_toy", "--robot.width=64", "--robot.height=48")
    flags = [*robot, *TELEOP, *record_flags(recorded, video="false", streaming_encoding="false")]
    with caplog.at_level(logging.ERROR), pytest.raises(SystemExit) as stop:
        run(monkeypatch, "xop-record", *flags, "--resume=true", "--play_sounds=false")
    assert str(stop.value) == (
        f"error: '{recorded}' cannot be added to: its images are of dtype video; use "
        f"--dataset.video=true. {HINT}"
    )


def test_what_is_recorded_is_what_would_be_checked(session):
    """The check's idea of the columns is that of LeRobot."""
    robot = make_toy(session, cameras="head,back")
    features = build_features(robot, use_videos=True)
    info = robot._info
    assert features["action"]["names"] == list(info.morphology.layout.keys)
    pictures = {key: value["shape"] for key, value in features.items() if "images" in key}
    assert pictures == {
        f"observation.images.{camera}": shape for camera, shape in info.cameras.items()
    }
    picture = robot.observation_features["head"]
    assert isinstance(picture, tuple)
    assert len(picture) == 3
    robot.disconnect()
