"""A few small pictures of an episode, evenly over its time."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from PIL import Image

from xop_lerobot.core.errors import BadDataset
from xop_lerobot.curate.source import EpisodeEntry, Source
from xop_lerobot.curate.video import Cut, decode
from xop_lerobot.evaluation.film import choose_moments

_QUALITY = 72


class Still(NamedTuple):
    """A picture.

    Attributes:
        frame: Which frame of the episode.
        jpeg: The picture.
    """

    frame: int
    jpeg: bytes


def list_cameras(source: Source) -> list[str]:
    """List the features that are pictures."""
    return [
        key for key, feature in source.features.items() if feature["dtype"] in ("video", "image")
    ]


def read_stills(
    source: Source, entry: EpisodeEntry, camera: str, number: int, width: int
) -> list[Still]:
    """Read pictures of an episode; of a video only what is needed for them is decoded.

    Args:
        source: The dataset.
        entry: The episode.
        camera: Key of the feature.
        number: How many pictures, evenly from the first to the last.
        width: Width that they are made smaller to [pixel].

    Raises:
        BadDataset: If they cannot be read.
    """
    is_video = source.features[camera]["dtype"] == "video"
    # Where a video is not to be found, the faults of the episode say so.
    if not entry.has_rows or not number or (is_video and camera not in entry.videos):
        return []
    moments = choose_moments(entry.length, number).tolist()
    read = _read_video if is_video else _read_images
    stills = [Still(frame, _shrink(each, width)) for frame, each in
              zip(moments, read(source, entry, camera, moments), strict=True)]  # fmt: skip
    return stills


def _read_video(
    source: Source, entry: EpisodeEntry, camera: str, moments: list[int]
) -> Iterator[np.ndarray]:
    span = entry.videos[camera]
    for frame in moments:
        # A cut of its own for each, since finding a place is faster than decoding all before it.
        start = span.start + frame / source.fps
        cut = Cut(source.root, span.file, start, start + 1 / source.fps)
        picture = next(decode(cut, source.fps, {0}), None)
        if picture is None:
            raise BadDataset(
                source.root,
                f"{span.file} shows nothing at {start:.3f} s, frame {frame} of episode "
                f"{entry.index}",
            )
        yield picture[1]


def _read_images(
    source: Source, entry: EpisodeEntry, camera: str, moments: list[int]
) -> Iterator[np.ndarray]:
    column = source.read_table(entry, [camera])[camera]
    for frame in moments:
        held = column[frame].as_py()
        content = held.get("bytes") if isinstance(held, dict) else None
        if not content:
            raise BadDataset(
                source.root, f"{entry.file} has no picture '{camera}' in frame {frame} of "
                f"episode {entry.index}"
            )  # fmt: skip
        try:
            yield np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))
        except (OSError, ValueError) as error:
            raise BadDataset(
                source.root,
                f"picture '{camera}' of episode {entry.index} is not readable ({error})",
            ) from error


def _shrink(picture: np.ndarray, width: int) -> bytes:
    image = Image.fromarray(picture)
    if image.width > width:
        height = max(round(image.height * width / image.width), 1)
        image = image.resize((width, height), Image.Resampling.LANCZOS)
    stream = io.BytesIO()
    image.save(stream, "JPEG", quality=_QUALITY)
    return stream.getvalue()
