"""Images of an episode: a strip of labelled frames, a video and a GIF."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from xop_lerobot.core.errors import BadShape, BadValue, UnknownName

LABEL_HEIGHT = 22
"""Height of the caption above an image [px]."""
GAP = 4
"""White space between images [px]."""
FONT_SIZE = 15


def choose_moments(count: int, number: int = 8) -> np.ndarray:
    """Choose `number` of `count` frames, evenly from first to last. Shape (<= number,)."""
    if count < 1:
        raise BadValue("the episode has no frame to show")
    return np.unique(np.linspace(0, count - 1, min(number, count)).round().astype(int))


def build_strip(cameras: Mapping[str, np.ndarray], fps: float, number: int = 8) -> np.ndarray:
    """Arrange frames of an episode side by side, one row per camera, captioned with their times.

    Args:
        cameras: Frames of each camera, all equally long. Shapes (T, height, width, 3), uint8.
        fps: Frame rate [Hz].
        number: Number of frames shown.

    Returns:
        The strip. Shape (rows, columns, 3), uint8.

    Raises:
        BadShape: If a camera's frames are not an RGB video, or the lengths differ.
        BadValue: If there is no camera or no frame.
    """
    count = check_cameras(cameras)
    moments = choose_moments(count, number)
    rows = []
    for name, frames in cameras.items():
        cells = [_put_label(frames[index], f"{name}  {index / fps:.1f} s") for index in moments]
        rows.append(_join(cells, axis=1))
    width = max(row.shape[1] for row in rows)
    return _join([_pad(row, row.shape[0], width) for row in rows], axis=0)


def write_strip(
    path: Path, cameras: Mapping[str, np.ndarray], fps: float, number: int = 8
) -> np.ndarray:
    """Write the strip of `cameras` as an image and return it; arguments as in `build_strip`."""
    strip = build_strip(cameras, fps, number)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(strip).save(path)
    return strip


def build_film(cameras: Mapping[str, np.ndarray], fps: int) -> Iterable[np.ndarray]:
    """Yield one image per frame with all cameras side by side, of even width and height."""
    count = check_cameras(cameras)
    for index in range(count):
        cells = [
            _put_label(frames[index], f"{name}  {index / fps:.1f} s")
            for name, frames in cameras.items()
        ]
        height = max(cell.shape[0] for cell in cells)
        picture = _join([_pad(cell, height, cell.shape[1]) for cell in cells], axis=1)
        # H.264 stores colour at half the resolution, so both sides must be even.
        yield _pad(picture, -(-picture.shape[0] // 2) * 2, -(-picture.shape[1] // 2) * 2)


def write_video(path: Path, frames: Iterable[np.ndarray], fps: int) -> int:
    """Write `frames` as an H.264 video for browsers, and return their number.

    Args:
        path: File to write, ``.mp4``.
        frames: Images of one, even size. Shapes (height, width, 3), uint8.
        fps: Frame rate [Hz].
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    count = 0
    with av.open(str(path), "w", options={"movflags": "+faststart"}) as container:
        stream: Any = None
        for frame in frames:
            if stream is None:
                stream = container.add_stream(
                    "h264", rate=Fraction(fps), options={"crf": "23", "preset": "veryfast"}
                )
                stream.height, stream.width = frame.shape[:2]
                stream.pix_fmt = "yuv420p"
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
            container.mux(stream.encode(picture))
            count += 1
        if stream is None:
            raise BadValue(f"'{path}': there is no frame to write")
        container.mux(stream.encode())
    return count


def write_gif(path: Path, frames: Iterable[np.ndarray], fps: int, every: int = 3) -> int:
    """Write every `every`-th image as a looping real-time GIF, and return their number."""
    pictures = [
        Image.fromarray(frame).quantize(96)
        for index, frame in enumerate(frames)
        if index % every == 0
    ]
    if not pictures:
        raise BadValue(f"'{path}': there is no frame to write")
    path.parent.mkdir(parents=True, exist_ok=True)
    pictures[0].save(
        path, save_all=True, append_images=pictures[1:], duration=1000 * every // fps, loop=0
    )
    return len(pictures)


def read_camera(dataset: Any, camera: str, episode: int = 0) -> np.ndarray:
    """Decode all frames of a camera of one episode of a `LeRobotDataset`, in order.

    Args:
        dataset: A `lerobot.datasets.LeRobotDataset` with videos.
        camera: Name of the camera, ``"head"``.
        episode: Index of the episode.

    Returns:
        Frames. Shape (T, height, width, 3), uint8.

    Raises:
        UnknownName: If the dataset has no such camera; lists its cameras.
        BadValue: If the video has fewer frames than the episode.
    """
    prefix = "observation.images."
    key = f"{prefix}{camera}"
    if key not in dataset.meta.video_keys:
        known = [name.removeprefix(prefix) for name in dataset.meta.video_keys]
        raise UnknownName("camera", camera, known)
    meta = dataset.meta.episodes[episode]
    length = int(meta["length"])
    # Episodes share a file; the metadata states where each begins.
    begin = float(meta[f"videos/{key}/from_timestamp"])
    half_frame = 0.5 / dataset.meta.fps
    frames: list[np.ndarray] = []
    with av.open(str(dataset.root / dataset.meta.get_video_file_path(episode, key))) as film:
        for picture in film.decode(video=0):
            if picture.time is not None and picture.time >= begin - half_frame:
                frames.append(picture.to_ndarray(format="rgb24"))
            if len(frames) == length:
                return np.stack(frames)
    raise BadValue(f"camera '{camera}' has {len(frames)} of the {length} frames of its episode")


def check_cameras(cameras: Mapping[str, np.ndarray]) -> int:
    """Return the number of frames that all `cameras` have.

    Raises:
        BadShape: If one is not an RGB video, or the lengths differ.
        BadValue: If there is no camera.
    """
    if not cameras:
        raise BadValue("there is no camera to show")
    count = len(next(iter(cameras.values())))
    for name, frames in cameras.items():
        if frames.ndim != 4 or frames.shape[0] != count or frames.shape[3] != 3:
            raise BadShape(f"camera '{name}'", (count, "height", "width", 3), frames.shape)
    return count


def _put_label(picture: np.ndarray, text: str) -> np.ndarray:
    """Add a caption, black on white, above an image."""
    height, width = picture.shape[:2]
    canvas = Image.new("RGB", (width, height + LABEL_HEIGHT), "white")
    canvas.paste(Image.fromarray(picture), (0, LABEL_HEIGHT))
    font = ImageFont.load_default(FONT_SIZE)
    ImageDraw.Draw(canvas).text((4, 2), text, fill="black", font=font)
    return np.asarray(canvas)


def _pad(picture: np.ndarray, height: int, width: int) -> np.ndarray:
    """Pad with white below and to the right up to `height` and `width`."""
    missing = ((0, height - picture.shape[0]), (0, width - picture.shape[1]), (0, 0))
    return np.pad(picture, missing, constant_values=255)


def _join(pictures: list[np.ndarray], axis: int) -> np.ndarray:
    """Join images with a white gap between them."""
    shape = list(pictures[0].shape)
    shape[axis] = GAP
    gap = np.full(shape, 255, np.uint8)
    parts = [part for picture in pictures for part in (picture, gap)][:-1]
    return np.concatenate(parts, axis=axis)
