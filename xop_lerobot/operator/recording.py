"""Operator recordings: poses of head and wrists over time, checked before use."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile, is_zipfile

import numpy as np
from numpy.lib.format import MAGIC_PREFIX

from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadRecording
from xop_lerobot.core.state import FRAMES
from xop_lerobot.core.transforms import interpolate_poses
from xop_lerobot.operator.frame import OperatorFrame

POSE_KEYS = tuple(f"{frame}_pose" for frame in FRAMES)
PINCH_KEYS = ("left_pinch", "right_pinch")
REQUIRED_KEYS = ("t", *POSE_KEYS, *PINCH_KEYS)
OPTIONAL_KEYS = ("tracked", "mode")
NORM_TOLERANCE = 1e-3
"""Largest accepted deviation of a quaternion's norm from 1."""
MIN_SAMPLES = 2
LONGEST_STEP_S = 60.0
"""Longest accepted time between samples [s]; a longer one means an adjusted clock, or other
units."""
FARTHEST_M = 10_000.0
"""Largest accepted distance from the origin along an axis [m]. Datasets store positions as float32,
as LeRobot loads them, which resolves a millimetre up to there; map coordinates would be off by half
a metre."""


@dataclass(frozen=True)
class Recording:
    """T samples of a person, in the operator's world.

    Attributes:
        t: Times, strictly increasing from 0 [s]. Shape (T,).
        poses: Head, left and right wrist, x y z qw qx qy qz. Shape (T, 3, 7).
        pinch: Distance of thumb and index tip, left and right [m]. Shape (T, 2).
        tracked: Whether each limb was tracked. Shape (T, 3), bool.
        mode: 0 stationary, 1 mobile; None if the recording states no modes. Shape (T,).
        engaged: Whether the person was engaged; None if always. Shape (T,), bool.
    """

    t: np.ndarray
    poses: np.ndarray
    pinch: np.ndarray
    tracked: np.ndarray
    mode: np.ndarray | None = None
    engaged: np.ndarray | None = None

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return float(self.t[-1])

    def is_engaged_at(self, stamp: float) -> bool:
        """Whether the person was engaged at `stamp` [s], by the last sample before it."""
        if self.engaged is None:
            return True
        # Sums of lock-step periods round; a nanosecond of tolerance saves a tick.
        last = np.searchsorted(self.t, stamp + 1e-9, side="right") - 1
        return bool(self.engaged[max(int(last), 0)])

    def frame_at(self, stamp: float) -> OperatorFrame:
        r"""Interpolate at any time; the first and last sample are held beyond the ends.

        Positions are interpolated linearly, orientations as :math:`q_0 \exp(u \log(q_0^{-1} q_1))`
        along the shorter arc; `tracked` is that of the nearest sample, the mode that of the last
        one.

        Args:
            stamp: Time on the recording's clock [s].
        """
        t = float(np.clip(stamp, self.t[0], self.t[-1]))
        i = int(np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 2))
        u = (t - self.t[i]) / (self.t[i + 1] - self.t[i])
        poses = interpolate_poses(self.poses[i], self.poses[i + 1], u)
        nearest = i + (u >= 0.5)
        mode = None if self.mode is None else Mode(int(self.mode[i + (u >= 1)]))
        return OperatorFrame(
            stamp,
            *poses,
            pinch=(1 - u) * self.pinch[i] + u * self.pinch[i + 1],
            tracked=self.tracked[nearest].copy(),
            mode=mode,
        )


def load_recording(path: str | Path) -> Recording:
    """Read an ``.npz`` operator recording.

    Raises:
        BadRecording: If it is missing or malformed; names the file and the fault.
    """
    path = Path(path)
    if path.is_dir():
        raise BadRecording(path, "it is a directory, but no dataset (there is no meta/info.json)")
    if not path.is_file():
        raise BadRecording(path, "there is no such file")
    if not is_zipfile(path):
        with path.open("rb") as file:
            is_array = file.read(len(MAGIC_PREFIX)) == MAGIC_PREFIX
        raise BadRecording(
            path,
            "it is a single array, not an .npz archive"
            if is_array
            else "it is not a readable .npz archive, as np.savez writes it",
        )
    try:
        with np.load(path, allow_pickle=False) as archive:
            # Other keys are not read: they may contain pickled objects, which are refused.
            names = [key for key in (*REQUIRED_KEYS, *OPTIONAL_KEYS) if key in archive.files]
            missing = [key for key in REQUIRED_KEYS if key not in names]
            if missing:
                raise BadRecording(
                    path,
                    f"missing {', '.join(missing)}. Expected: {', '.join(REQUIRED_KEYS)}; "
                    f"optional: {', '.join(OPTIONAL_KEYS)}. Found: {', '.join(archive.files)}",
                )
            arrays = {key: archive[key] for key in names}
    except (BadZipFile, ValueError, OSError, EOFError) as error:
        if isinstance(error, BadRecording):
            raise
        raise BadRecording(path, f"it is not a readable .npz archive ({error})") from error
    return make_recording(arrays, path)


def make_recording(arrays: Mapping[str, np.ndarray], source: object) -> Recording:
    """Validate the arrays of a recording and make it.

    Args:
        arrays: The required and optional keys of an operator recording.
        source: Their origin, for messages.

    Raises:
        BadRecording: Naming the first fault and its place.
    """
    t = _check_array(arrays, "t", (None,), source)
    n = len(t)
    if n < MIN_SAMPLES:
        raise BadRecording(source, f"it has {n} samples; at least {MIN_SAMPLES} are needed")
    steps = np.diff(t)
    if (steps <= 0).any():
        i = int(np.argmax(steps <= 0))
        raise BadRecording(
            source,
            f"t must increase strictly, but t[{i}] = {t[i]:g} s is followed by "
            f"t[{i + 1}] = {t[i + 1]:g} s",
        )
    if (steps > LONGEST_STEP_S).any():
        i = int(np.argmax(steps))
        raise BadRecording(
            source,
            f"t must be in seconds, from a monotonic clock: its steps may be up to "
            f"{LONGEST_STEP_S:g} s long, but t[{i}] = {t[i]:.10g} s is followed by "
            f"t[{i + 1}] = {t[i + 1]:.10g} s",
        )
    tracked = _check_tracked(arrays, n, source)
    poses = np.stack([_check_poses(arrays, key, n, source) for key in POSE_KEYS], axis=1)
    pinch = np.stack([_check_pinch(arrays, key, n, source) for key in PINCH_KEYS], axis=1)
    mode = _check_mode(arrays, n, source)
    poses = hold_untracked(poses, tracked)
    _check_distances(poses, source)
    return Recording(t - t[0], poses, pinch, tracked, mode)


def hold_untracked(poses: np.ndarray, tracked: np.ndarray) -> np.ndarray:
    """Replace each untracked pose by the last tracked one (at the start by the first).

    Args:
        poses: Shape (T, 3, 7).
        tracked: Shape (T, 3), bool.

    Returns:
        Poses in which an untracked limb stands still. Shape (T, 3, 7).
    """
    held = poses.copy()
    index = np.arange(len(poses))
    for limb in range(poses.shape[1]):
        seen = tracked[:, limb]
        if seen.any():
            last = np.maximum.accumulate(np.where(seen, index, -1))
            held[:, limb] = poses[np.where(last < 0, np.argmax(seen), last), limb]
    return held


def _check_array(
    arrays: Mapping[str, np.ndarray], key: str, shape: tuple[int | None, ...], source: object
) -> np.ndarray:
    array = np.asarray(arrays[key])
    wanted = "(" + ", ".join("T" if size is None else str(size) for size in shape) + ")"
    if len(shape) == 1:
        wanted = wanted.replace(")", ",)")
    fits = array.ndim == len(shape) and all(
        size in (None, actual) for size, actual in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise BadRecording(source, f"{key} must have shape {wanted}, got {array.shape}")
    if array.dtype.kind not in "fiu":
        raise BadRecording(source, f"{key} must hold numbers, got dtype {array.dtype}")
    array = array.astype(float)
    if not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        at = ", ".join(map(str, index))
        raise BadRecording(source, f"{key} must be finite, but {key}[{at}] = {array[index]}")
    return array


def _check_poses(arrays: Mapping[str, np.ndarray], key: str, n: int, source: object) -> np.ndarray:
    poses = _check_array(arrays, key, (n, 7), source)
    norm = np.linalg.norm(poses[:, 3:], axis=1)
    faulty = np.abs(norm - 1) > NORM_TOLERANCE
    if faulty.any():
        i = int(np.argmax(faulty))
        raise BadRecording(
            source,
            f"{key}[{i}, 3:] must be a unit quaternion (qw qx qy qz), its norm is {norm[i]:g}",
        )
    poses[:, 3:] /= norm[:, None]
    return poses


def _check_distances(poses: np.ndarray, source: object) -> None:
    """Check that positions are near enough to the origin for float32. Shape (T, 3, 7)."""
    distances = np.abs(poses[:, :, :3]).max(axis=2)
    if (distances > FARTHEST_M).any():
        i, limb = np.unravel_index(int(np.argmax(distances)), distances.shape)
        raise BadRecording(source, describe_distance(f"{POSE_KEYS[limb]}[{i}]", distances[i, limb]))


def describe_distance(name: str, distance: float) -> str:
    """Explain that a position is too far from the origin, and what to do.

    Args:
        name: Name of the position.
        distance: Its largest coordinate [m].
    """
    return (
        f"{name} is {distance:.0f} m from the origin, where the 32 bits of a dataset are no longer "
        f"exact to a millimetre. Move the origin, of all poses alike, to within {FARTHEST_M:.0f} m"
    )


def _check_pinch(arrays: Mapping[str, np.ndarray], key: str, n: int, source: object) -> np.ndarray:
    pinch = _check_array(arrays, key, (n,), source)
    if (pinch < 0).any():
        i = int(np.argmax(pinch < 0))
        raise BadRecording(source, f"{key} must not be negative, but {key}[{i}] = {pinch[i]:g} m")
    return pinch


def _check_tracked(arrays: Mapping[str, np.ndarray], n: int, source: object) -> np.ndarray:
    if "tracked" not in arrays:
        return np.ones((n, 3), dtype=bool)
    tracked = np.asarray(arrays["tracked"])
    if tracked.shape != (n, 3):
        raise BadRecording(source, f"tracked must have shape ({n}, 3), got {tracked.shape}")
    if tracked.dtype != bool:
        raise BadRecording(source, f"tracked must have dtype bool, got {tracked.dtype}")
    if not tracked[:, 0].any():
        raise BadRecording(source, "tracked says that the head is never seen")
    return tracked.copy()


def _check_mode(arrays: Mapping[str, np.ndarray], n: int, source: object) -> np.ndarray | None:
    if "mode" not in arrays:
        return None
    mode = _check_array(arrays, "mode", (n,), source)
    faulty = ~np.isin(mode, [int(m) for m in Mode])
    if faulty.any():
        i = int(np.argmax(faulty))
        raise BadRecording(
            source, f"mode must be 0 (stationary) or 1 (mobile), but mode[{i}] = {mode[i]:g}"
        )
    return mode.astype(int)
