"""May a dataset be added to: does it hold what the robot would record, and nothing more?"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot.utils.constants import ACTION, DEFAULT_FEATURES, OBS_IMAGES, OBS_STATE

from xop_lerobot.core.errors import XopError
from xop_lerobot.morphology.body import Body
from xop_lerobot.recording.columns import is_own_column

if TYPE_CHECKING:
    from xop_lerobot.session import RobotInfo

PICTURES = f"{OBS_IMAGES}."
_OTHERS = ("intervention",)
"""Columns that LeRobot's rollouts fill beside those of the robot."""


class NotResumable(XopError, ValueError):
    """A dataset cannot be added to; nothing of it has been changed."""

    def __init__(self, root: object, faults: Iterable[str]) -> None:
        super().__init__(
            f"'{root}' cannot be added to: {'; '.join(faults)}. Record as it was recorded, or "
            "begin another --dataset.root without --resume=true"
        )


def check_resumable(
    root: Path,
    robot_type: str | None,
    features: Mapping[str, Mapping[str, Any]],
    info: RobotInfo,
    own: Collection[str],
) -> None:
    """Check that a dataset has the columns that are recorded of a robot, and no others.

    Args:
        root: Directory of the dataset.
        robot_type: The robot that it was recorded with, None where that is not known.
        features: Its columns.
        info: The robot that would be recorded.
        own: This project's columns of that robot, of which it may have all or none.

    Raises:
        NotResumable: If not, with every difference.
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
    """Check that the pictures of a dataset are stored as they would be recorded.

    Raises:
        NotResumable: If it has files of pictures and not videos, or the other way round.
    """
    stored = {features[key]["dtype"] for key in features if key.startswith(PICTURES)}
    wanted = "video" if use_videos else "image"
    if stored - {wanted}:
        flag = str(not use_videos).lower()
        fault = f"its pictures are of dtype {', '.join(sorted(stored))}; use --dataset.video={flag}"
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
        yield f"its {column} has {_list_some(extra)}, which the robot has not"


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
                f"its pictures of camera '{camera}' are {width} x {height}, and the robot's "
                f"{robot_width} x {robot_height}; use --robot.width={width} "
                f"--robot.height={height}"
            )
            return


def _name(cameras: Iterable[str]) -> str:
    return f"[{','.join(cameras)}]"


def _list_some(names: Sequence[str], most: int = 3) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
