"""Checks before a dataset is created or resumed: rates, columns, cameras and encoding."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot.utils.constants import ACTION, DEFAULT_FEATURES, OBS_IMAGES, OBS_STATE

from xop_lerobot.core.errors import BadDataset, XopError
from xop_lerobot.morphology.body import Body
from xop_lerobot.recording.columns import is_own_column
from xop_lerobot.recording.lerobot_patches import ENCODER, fits

if TYPE_CHECKING:
    from xop_lerobot.session import RobotInfo

PICTURES = f"{OBS_IMAGES}."
_OTHERS = ("intervention",)
"""Columns that LeRobot's rollouts add to those of the robot."""


class DatasetExists(XopError, FileExistsError):
    """The directory of a new dataset already exists."""

    def __init__(self, root: Path) -> None:
        super().__init__(
            f"dataset directory '{root}' exists already. Choose another --dataset.root, delete "
            "it, or add episodes to it with --resume=true"
        )


class NotMade(XopError):
    """The directory of a new dataset cannot be created."""

    def __init__(self, root: Path, reason: str) -> None:
        super().__init__(f"dataset directory '{root}' cannot be made: {reason}")


class WrongFps(XopError, ValueError):
    """Robot and dataset have different rates."""

    def __init__(self, robot_fps: int, dataset_fps: int) -> None:
        super().__init__(
            f"the robot runs at {robot_fps} Hz (--robot.fps) and the dataset at {dataset_fps} Hz "
            f"(--dataset.fps); they must be equal. Use --dataset.fps={robot_fps}"
        )


class BatchedEncoding(XopError, ValueError):
    """Videos would be encoded after their episodes are saved."""

    def __init__(self, size: int) -> None:
        super().__init__(
            f"--dataset.video_encoding_batch_size must be 1, got {size}: an episode is saved with "
            "its videos, so that a later failure cannot lose them. To save sooner, use "
            "--dataset.streaming_encoding=true"
        )


class NotResumable(XopError, ValueError):
    """A dataset cannot be resumed; it has not been changed."""

    def __init__(self, root: object, faults: Iterable[str]) -> None:
        super().__init__(
            f"'{root}' cannot be added to: {'; '.join(faults)}. Record with the same "
            "settings, or start another --dataset.root without --resume=true"
        )


def check_encoding(options: Mapping[str, Any]) -> None:
    """Refuse encoder settings that may lose images.

    LeRobot encodes batches of videos after their episodes are saved. Here each episode has its own
    files, closed when it is saved: a batch would look for the rows of all its episodes in one of
    them, and a killed process would lose its images.

    Raises:
        BatchedEncoding: If a batch is larger than one episode.
        LeRobotMisfit: If LeRobot's streaming encoder does not fit the patch that waits for it.
    """
    size = options.get("batch_encoding_size", 1)
    if size > 1:
        raise BatchedEncoding(size)
    if options.get("streaming_encoding"):
        fits(ENCODER)


def find_unreadable(folder: Path, repo_id: str, error: Exception) -> BadDataset:
    """Explain why a dataset could not be opened to resume it, and what to do.

    Args:
        folder: Directory of the dataset.
        repo_id: Name of the dataset on the Hub.
        error: LeRobot's exception, from JSON, Parquet or the Hub.
    """
    first = (str(error).splitlines() or [""])[0]
    fault = f"it cannot be read ({type(error).__name__}: {first}). "
    if (folder / "meta" / "info.json").exists():
        fault += f"`xop-curate repair --root {folder} --out DIR` restores what is complete"
    else:
        fault = (
            f"there is no dataset, and '{repo_id}' was not found on the Hub either. "
            "Omit --resume to create it"
        )
    return BadDataset(folder, fault)


def check_resumable(
    root: Path,
    robot_type: str | None,
    features: Mapping[str, Mapping[str, Any]],
    info: RobotInfo,
    own: Collection[str],
) -> None:
    """Check that a dataset has exactly the columns that the robot records.

    Args:
        root: Directory of the dataset.
        robot_type: Robot type it was recorded with, None if unknown.
        features: Features of the dataset.
        info: The robot to record.
        own: This project's columns for that robot; the dataset must have all or none.

    Raises:
        NotResumable: If it does not, with every difference.
    """
    if robot_type not in (None, info.name):
        raise NotResumable(root, [f"it is of {robot_type}, and the robot is {info.name}"])
    state = Body(info.morphology).state_keys
    faults = [
        *_compare_own(features, own),
        *_compare_names(ACTION, features, info.morphology.layout.keys),
        *_compare_names(OBS_STATE, features, state),
        *_compare_cameras(features, info),
    ]
    filled = {ACTION, OBS_STATE, *DEFAULT_FEATURES, *_OTHERS}
    others = [
        key
        for key in features
        if key not in filled and not key.startswith(PICTURES) and not is_own_column(key)
    ]
    if others:
        faults.append(f"it has columns that are not recorded here ({', '.join(others)})")
    if faults:
        raise NotResumable(root, faults)


def check_storage(
    root: Path, features: Mapping[str, Mapping[str, Any]], *, use_videos: bool
) -> None:
    """Check that images are stored in the format that the flags ask for.

    Raises:
        NotResumable: If it stores image files and the flags ask for videos, or vice versa.
    """
    stored = {features[key]["dtype"] for key in features if key.startswith(PICTURES)}
    wanted = "video" if use_videos else "image"
    if stored - {wanted}:
        flag = str(not use_videos).lower()
        fault = f"its images are of dtype {', '.join(sorted(stored))}; use --dataset.video={flag}"
        raise NotResumable(root, [fault])


def _compare_own(features: Iterable[str], own: Collection[str]) -> Iterator[str]:
    known = [key for key in features if is_own_column(key)]
    missing = [key for key in own if key not in known]
    extra = [key for key in known if key not in own]
    if known and missing:
        yield f"of this project's columns it has some and lacks {_list_some(missing)}"
    if extra:
        yield f"it has columns of another version ({_list_some(extra)})"


def _compare_names(
    column: str, features: Mapping[str, Mapping[str, Any]], names: Iterable[str]
) -> Iterator[str]:
    if column not in features:
        yield f"it has no column {column}"
        return
    known, wanted = features[column].get("names") or (), list(names)
    missing = [name for name in wanted if name not in known]
    extra = [name for name in known if name not in wanted]
    if missing:
        yield f"its {column} lacks {_list_some(missing)}"
    if extra:
        yield f"its {column} has {_list_some(extra)}, which the robot lacks"


def _compare_cameras(features: Mapping[str, Mapping[str, Any]], info: RobotInfo) -> Iterator[str]:
    known = {
        key.removeprefix(PICTURES): tuple(features[key]["shape"])
        for key in features
        if key.startswith(PICTURES)
    }
    if known.keys() != info.cameras.keys():
        yield (
            f"its cameras are {_name(known)}, and the robot's {_name(info.cameras)}; "
            f"use --robot.cameras={_name(known)}"
        )
    for camera in known.keys() & info.cameras.keys():
        (height, width, *_), (robot_height, robot_width, *_) = known[camera], info.cameras[camera]
        if (height, width) != (robot_height, robot_width):
            yield (
                f"its images of camera '{camera}' are {width} x {height}, and the robot's "
                f"{robot_width} x {robot_height}; use --robot.width={width} "
                f"--robot.height={height}"
            )
            return


def _name(cameras: Iterable[str]) -> str:
    return f"[{','.join(cameras)}]"


def _list_some(names: Sequence[str], most: int = 3) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
