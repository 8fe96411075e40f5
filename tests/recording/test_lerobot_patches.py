"""The table of patches is checked against LeRobot, and each leaves LeRobot as it was."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest
from lerobot.datasets import (
    LeRobotDataset,
    aggregate,
    dataset_metadata,
    dataset_writer,
    image_writer,
    video_utils,
)

from xop_lerobot.recording import lerobot_patches
from xop_lerobot.recording.lerobot_patches import PATCHES, Patch, Patched, Use, fits, replaced

ROOT = Path(__file__).parents[2]
STANDING_IN = [patch for patch in PATCHES if patch.use in (Use.REPLACED, Use.WRAPPED)]


@pytest.fixture(autouse=True)
def say_again(monkeypatch):
    monkeypatch.setattr(lerobot_patches, "_said", set())


def get_name(patch: Patch) -> str:
    return patch.name


def test_all_fit_this_lerobot(caplog):
    assert [patch.name for patch in PATCHES if not fits(patch)] == []
    assert caplog.messages == []


def test_each_is_in_the_table():
    listed = [each for each in vars(lerobot_patches).values() if isinstance(each, Patch)]
    assert listed == list(PATCHES)
    assert len({patch.name for patch in PATCHES}) == len(PATCHES)


def test_the_version_is_the_one_that_is_installed():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    (pinned,) = [each for each in project["dependencies"] if each.startswith("lerobot[")]
    assert pinned.endswith(f"=={lerobot_patches.MADE_FOR}")


@pytest.mark.parametrize("patch", STANDING_IN, ids=get_name)
def test_lerobot_is_left_as_it_was(patch, monkeypatch):
    owner, name = lerobot_patches._find_owner(next(iter(patch.expects)))
    # A robot of another test watches `lerobot-rollout` for as long as the process lives.
    monkeypatch.setattr(owner, name, lerobot_patches.get_stock(patch))
    before = dict(vars(owner))
    patched = Patched()
    patched.put(patch, lambda: None)
    assert getattr(owner, name) is not before[name]
    assert lerobot_patches.get_stock(patch) is before[name]
    patched.undo()
    patched.undo()
    assert dict(vars(owner)) == before


def test_who_comes_later_is_left_alone():
    """The first does not take the second's away; both gone, LeRobot's own is there again."""
    (patch,) = [patch for patch in PATCHES if patch.name == "load_episodes"]
    stock, later = dataset_metadata.load_episodes, lambda: None
    first, second = Patched(), Patched()
    first.put(patch, lambda: None)
    second.put(patch, later)
    first.undo()
    assert dataset_metadata.load_episodes is later
    second.undo()
    assert dataset_metadata.load_episodes is stock


def test_an_instance_is_patched_alone():
    class Metadata(dataset_metadata.LeRobotDatasetMetadata):
        def __init__(self) -> None:
            pass

    one, other = Metadata(), Metadata()
    patched = Patched()
    patched.put(lerobot_patches.EPISODE_METADATA, lambda: "ours", one)
    assert one.save_episode() == "ours"  # type: ignore[call-arg]
    assert "save_episode" not in vars(other)
    patched.undo()
    assert vars(one) == {}


def test_a_block_that_fails_leaves_lerobot_as_it_was():
    stock = dataset_writer.embed_images
    with pytest.raises(ZeroDivisionError), replaced(lerobot_patches.EMBEDDING, lambda _: 1 / 0):
        dataset_writer.embed_images(None)  # type: ignore[arg-type]
    assert dataset_writer.embed_images is stock


class Other:
    """A class of LeRobot's that has nothing of what is expected."""


class Renamed:
    """One in which a single attribute, which is set where it is made, has another name."""

    def __init__(self) -> None:
        self.queue = self.threads = None
        self._processes = None


def take_nothing() -> None:
    """A function of LeRobot's that takes nothing."""


@pytest.mark.parametrize(
    ("module", "name", "moved", "text"),
    [
        (
            dataset_metadata.LeRobotDatasetMetadata, "save_episode", take_nothing,
            "'metadata of an episode', made for 0.6.1: "
            "lerobot.datasets.dataset_metadata.LeRobotDatasetMetadata.save_episode() must take "
            "episode_metadata, and takes none. Episode metadata is only in "
            "meta/xop/episodes.jsonl, where `xop-curate` reads it.",
        ),
        (
            dataset_metadata, "LeRobotDatasetMetadata", Other,
            "'files of an episode', made for 0.6.1: "
            "lerobot.datasets.dataset_metadata.LeRobotDatasetMetadata must have _pq_writer, "
            "_close_writer, latest_episode, episodes, and has no _pq_writer, _close_writer, "
            "latest_episode, episodes. Each save closes and opens the whole dataset instead, which "
            "takes up to seconds.",
        ),
        (
            dataset_metadata, "LeRobotDatasetMetadata", Other,
            "'save that failed', made for 0.6.1: "
            "lerobot.datasets.dataset_metadata.LeRobotDatasetMetadata must have _pq_writer, "
            "_finalized, _metadata_buffer, and has no _pq_writer, _finalized, _metadata_buffer. If "
            "an episode cannot be saved, the dataset may be left unreadable: `xop-curate repair` "
            "restores what is complete.",
        ),
        (
            image_writer, "AsyncImageWriter", Renamed,
            "'queue of the image writer', made for 0.6.1: "
            "lerobot.datasets.image_writer.AsyncImageWriter must have queue, threads, processes, "
            "and has no processes. Where a disk is slower than the cameras, images fill the "
            "memory. Use --dataset.streaming_encoding=true.",
        ),
        (
            dataset_writer, "embed_images", take_nothing,
            "'embed_images', made for 0.6.1: lerobot.datasets.dataset_writer.embed_images() must "
            "take dataset, and takes none. Saving an episode takes some seconds longer.",
        ),
        (
            dataset_metadata, "load_episodes", None,
            "'load_episodes', made for 0.6.1: lerobot.datasets.dataset_metadata.load_episodes() is "
            "expected, and lerobot.datasets.dataset_metadata has no load_episodes. Merging takes "
            "about a second more for each episode.",
        ),
        (
            aggregate, "tqdm", Other,
            "'bars of aggregate_datasets', made for 0.6.1: lerobot.datasets.aggregate.tqdm must "
            "have tqdm, and has no tqdm. LeRobot's progress bars show among the command's lines.",
        ),
    ],
)  # fmt: skip
def test_what_can_be_done_without_is_warned_of_once(
    monkeypatch, caplog, module, name, moved, text
):  # fmt: skip
    """Those of the two commands and of the encoder are tested where they are used."""
    named = re.match("'(.*?)'", text)
    assert named is not None
    (patch,) = [patch for patch in PATCHES if patch.name == named[1]]
    monkeypatch.setattr(module, name, moved)
    assert not fits(patch)
    assert not fits(patch)
    assert caplog.messages == [f"LeRobot {version('lerobot')} does not fit the patch {text}"]


def test_a_misfit_is_not_patched(monkeypatch):
    monkeypatch.setattr(dataset_writer, "embed_images", take_nothing)
    with replaced(lerobot_patches.EMBEDDING, lambda table: table):
        assert dataset_writer.embed_images is take_nothing


def test_each_place_of_a_patch_is_told(monkeypatch):
    monkeypatch.setattr(video_utils, "StreamingVideoEncoder", Other)
    monkeypatch.setattr(dataset_writer, "DatasetWriter", Other)
    told = lerobot_patches.find_misfit(lerobot_patches.ENCODER)
    assert "_dropped_frames, and has no _frame_queues, _threads, _dropped_frames; " in told
    assert "lerobot.datasets.dataset_writer.DatasetWriter must have _streaming_encoder" in told


def test_parameters_in_another_order_do_not_fit_a_subclass(monkeypatch):
    def add_frame(self, task, frame) -> None:
        """LeRobot's loops would hand over the task first."""

    monkeypatch.setattr(LeRobotDataset, "add_frame", add_frame)
    with pytest.raises(lerobot_patches.LeRobotMisfit, match="must take frame, and takes task, fr"):
        fits(lerobot_patches.DATASET)
