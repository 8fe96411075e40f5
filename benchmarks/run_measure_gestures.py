"""Count falsely recognised gestures, in recordings and in hours of simulated work.

    python -m benchmarks.run_measure_gestures recording.npz outputs/dataset --hours 1 --seed 0

Motion comes from recordings (`.npz`, or the episodes of a dataset), played repeatedly, and from a
simulated person who stands, walks, turns and reaches. Hands close and open at random, for 0.1 to
15 s, as in work. `turned` also gives each hand a new orientation with every grasp, uniform over all
rotations; real hands are not, so it shows how well the hand's orientation alone prevents gestures.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.person_comparison import simulate_frames
from xop_lerobot.core.command_line import make_output_readable
from xop_lerobot.core.errors import XopError
from xop_lerobot.core.transforms import make_pose
from xop_lerobot.operator.dataset_recording import is_dataset, load_dataset_recording
from xop_lerobot.operator.engagement import Clutch, ClutchRequest
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.gestures import GestureConfig, Hands
from xop_lerobot.operator.recording import Recording, load_recording

RATE = 50
"""Rate of the streams [Hz]."""
SHUT, OPEN = 0.008, 0.07
"""Distance between thumb and index tip of a closed and an open hand [m]."""
NAMES = ("engage", "mode", "upright", "success", "end", "redo", "stop")


def play(recordings: list[Recording], length: float) -> Iterator[OperatorFrame]:
    """Yield the frames of recordings one after another, repeatedly, for at least `length` [s]."""
    start = 0.0
    while start < length:
        for recording in recordings:
            for t in np.arange(0, recording.duration, 1 / RATE):
                yield dataclasses.replace(recording.frame_at(float(t)), time=start + float(t))
            start += recording.duration + 1 / RATE


def work(
    frames: Iterator[OperatorFrame], rng: np.random.Generator, *, turned: bool
) -> Iterator[OperatorFrame]:
    """Let the hands close and open at random.

    Args:
        frames: Frames whose pinch is replaced.
        rng: Random generator.
        turned: Whether each hand also gets a random orientation with every grasp.
    """
    closed, until = np.zeros(2, dtype=bool), np.zeros(2)
    quats: list[np.ndarray | None] = [None, None]
    for frame in frames:
        for hand in range(2):
            if frame.time < until[hand]:
                continue
            closed[hand] = not closed[hand]
            shortest, longest = (0.1, 15) if closed[hand] else (0.1, 5)
            until[hand] = frame.time + np.exp(rng.uniform(np.log(shortest), np.log(longest)))
            if turned and not closed[hand]:
                quat = rng.normal(size=4)
                quats[hand] = quat / np.linalg.norm(quat)
        wrists = {}
        for name, quat in zip(("left_wrist", "right_wrist"), quats, strict=True):
            if quat is not None:
                wrists[name] = make_pose(frame.pose(name)[:3], quat)
        yield dataclasses.replace(frame, pinch=np.where(closed, SHUT, OPEN), **wrists)


def count(frames: Iterator[OperatorFrame]) -> tuple[float, int, Counter[str]]:
    """Count gestures; returns the stream's length [h], its pinches, and gestures by name."""
    hands, clutch = Hands(GestureConfig(), has_person=True), Clutch()
    counts: Counter[str] = Counter()
    first = last = None
    pinches, closed, engaged = 0, np.zeros(2, dtype=bool), False
    for frame in frames:
        first, last = frame.time if first is None else first, frame.time
        now = frame.pinch < 0.018  # between SHUT and OPEN
        pinches += int((now & ~closed).sum())
        closed = now
        asked = hands.read(frame)
        counts["mode"] += asked.mode
        counts["upright"] += bool(asked.toggle)
        counts.update(request.value for request in asked.requests)
        if clutch.update(frame, engaged) is not ClutchRequest.NOTHING:
            counts["engage"] += 1
            engaged = not engaged
    hours = 0.0 if first is None or last is None else (last - first) / 3600
    return hours, pinches, counts


def load(path: Path) -> list[Recording]:
    """Load a recording, or every episode of a dataset."""
    if not is_dataset(path):
        return [load_recording(path)]
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    number = LeRobotDatasetMetadata("local/data", root=path).total_episodes
    return [load_dataset_recording(path, episode) for episode in range(number)]


def main() -> None:
    """Count gestures and print a line for each kind of motion."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("recordings", nargs="*", type=Path, help=".npz recordings, datasets")
    parser.add_argument(
        "--hours", type=float, default=0.1, help="length of each kind of motion [h]"
    )
    parser.add_argument("--seed", type=int, default=0, help="random seed (default: 0)")
    settings = parser.parse_args()
    length = 3600 * settings.hours
    try:
        recordings = [each for path in settings.recordings for each in load(path)]
    except XopError as error:
        raise SystemExit(f"error: {error}") from None
    print(f"{'motion':28}{'hours':>7}{'pinches':>9}" + "".join(f"{n:>9}" for n in NAMES))
    streams: dict[str, Iterator[OperatorFrame]] = {}
    if recordings:
        streams["recorded"] = play(recordings, 0.001)
    for turned in (False, True):
        kind = ", turned" if turned else ""
        if recordings:
            rng = np.random.default_rng((settings.seed, turned))
            streams[f"recorded, working{kind}"] = work(play(recordings, length), rng, turned=turned)
        rng = np.random.default_rng((settings.seed, turned, 1))
        simulated = simulate_frames(settings.seed, length, rate=RATE)
        streams[f"simulated, working{kind}"] = work(simulated, rng, turned=turned)
    for name, frames in streams.items():
        hours, pinches, counts = count(frames)
        print(f"{name:28}{hours:7.3f}{pinches:9d}" + "".join(f"{counts[n]:9d}" for n in NAMES))


if __name__ == "__main__":
    make_output_readable()
    main()
