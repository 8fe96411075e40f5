"""Motion statistics of recorded people and of the simulated person, computed alike."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from xop_lerobot.core.transforms import quat_conjugate, quat_log, quat_multiply
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.recording import load_recording
from xop_lerobot.tasks.person.body import SIDES, Body
from xop_lerobot.tasks.person.hands import compute_reach_time
from xop_lerobot.tasks.person.mind import Mind

RATE = 60.0
"""Rate to which motions are resampled [Hz]."""
SMOOTH_S = 0.1
"""Window over which positions are averaged before they are differentiated [s]."""


@dataclass(frozen=True)
class Motion:
    """Motion of one person, evenly sampled.

    Attributes:
        name: Name of the recording or of the simulated person.
        simulated: Whether the person is simulated.
        time: Time [s]. Shape (n,).
        head: Position of the head [m]. Shape (n, 3).
        turns: Angular speed of the head [rad/s]. Shape (n,).
        hands: Positions of the wrists relative to the head, axes of the room [m]. Shape (2, n, 3).
    """

    name: str
    simulated: bool
    time: np.ndarray
    head: np.ndarray
    turns: np.ndarray
    hands: np.ndarray

    @property
    def speeds(self) -> Mapping[str, np.ndarray]:
        """Speeds of the head and of the hands in the room [m/s]. Shapes (n,)."""
        named = {"head": self.head}
        for side, hand in zip(SIDES, self.hands, strict=True):
            named[f"{side} hand"] = self.head + hand
        return {name: np.linalg.norm(_differentiate(path), axis=1) for name, path in named.items()}


def load_motion(path: Path) -> Motion:
    """Load a recording.

    Raises:
        BadRecording: If it is missing or malformed.
    """
    recording = load_recording(path)
    stamps = np.arange(0, recording.duration, 1 / RATE)
    return _make_motion(
        path.stem, [recording.frame_at(float(stamp)) for stamp in stamps], simulated=False
    )


def simulate_motion(seed: int, duration: float = 30.0) -> Motion:
    """Simulate a person who stands, walks, turns and reaches at random, without a robot."""
    frames = list(simulate_frames(seed, duration))
    return _make_motion(f"simulated {seed}", frames, simulated=True)


def simulate_frames(seed: int, duration: float, rate: float = RATE) -> Iterator[OperatorFrame]:
    """Yield the frames of that person at `rate` [Hz]."""
    mind = Mind(seed)
    body, rng = mind.body, np.random.default_rng((seed, 9))
    resting = 0.0
    for time in np.arange(0, duration, 1 / rate):
        body.advance(float(time))
        if not body.is_moving and time >= resting:
            _move_at_random(mind, body, rng)
            resting = time + float(rng.uniform(0.3, 3.0))
        yield body.make_frame(float(time))


def _move_at_random(mind: Mind, body: Body, rng: np.random.Generator) -> None:
    """Begin a walk of a step or two, or a reach of one hand."""
    posture = body.posture
    if rng.random() < 0.5:
        from dataclasses import replace  # noqa: PLC0415

        step = np.array([*rng.uniform(-1.2, 1.2, 2), rng.uniform(-1.5, 1.5)])
        body.walk(replace(posture, place=posture.place + step))
        return
    room = body.compute_hands_in_room()
    side = int(rng.integers(2))
    offset = rng.uniform(-0.25, 0.25, 3)
    goal = room[side].copy()
    goal[:3] += offset
    duration = compute_reach_time(mind, float(np.linalg.norm(offset)))
    body.move(body.with_hands_in_room(posture, {SIDES[side]: goal}), duration)


def compute_figures(motion: Motion) -> dict[str, float]:
    """Compute medians, 95th percentiles and jerks of head and hands, by name with unit."""
    speeds = motion.speeds
    hands = np.concatenate([speeds[f"{side} hand"] for side in SIDES])
    reach = np.concatenate([np.linalg.norm(_differentiate(hand), axis=1) for hand in motion.hands])
    return {
        "length [s]": float(motion.time[-1]),
        "head median [m/s]": float(np.median(speeds["head"])),
        "head 95 % [m/s]": float(np.percentile(speeds["head"], 95)),
        "head turn 95 % [rad/s]": float(np.percentile(motion.turns, 95)),
        "hand median [m/s]": float(np.median(hands)),
        "hand 95 % [m/s]": float(np.percentile(hands, 95)),
        "hand against head 95 % [m/s]": float(np.percentile(reach, 95)),
        "head jerk RMS [m/s³]": _compute_jerk(motion.head),
        "hand jerk RMS [m/s³]": _compute_jerk(motion.head + motion.hands[0]),
    }


def compute_spectrum(motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Compute the power spectral density of the head's velocity, summed over the three axes.

    Returns:
        Frequencies without zero [Hz], and the one-sided density [m²/s²/Hz]. Shapes (k,).
    """
    velocity = np.gradient(motion.head, 1 / RATE, axis=0)
    window = np.hanning(len(velocity))[:, None]
    power = (np.abs(np.fft.rfft(velocity * window, axis=0)) ** 2).sum(axis=1)
    frequency = np.fft.rfftfreq(len(velocity), 1 / RATE)
    return frequency[1:], 2 * power[1:] / (RATE * float((window**2).sum()))


def _make_motion(name: str, frames: list[OperatorFrame], *, simulated: bool) -> Motion:
    head = np.array([frame.head for frame in frames])
    turn = quat_log(quat_multiply(quat_conjugate(head[:-1, 3:]), head[1:, 3:])) * RATE
    turns = np.linalg.norm(_smooth(np.vstack([turn, turn[-1:]])), axis=1)
    wrists = np.array([[f.left_wrist[:3], f.right_wrist[:3]] for f in frames]).swapaxes(0, 1)
    return Motion(
        name, simulated, np.arange(len(frames)) / RATE, head[:, :3], turns, wrists - head[:, :3]
    )


def _smooth(values: np.ndarray) -> np.ndarray:
    """Return the moving average over `SMOOTH_S`, with the end values repeated. Shape (n, d)."""
    size = max(1, round(SMOOTH_S * RATE)) | 1
    padded = np.pad(values, ((size // 2, size // 2), (0, 0)), mode="edge")
    kernel = np.ones(size) / size
    return np.stack([np.convolve(column, kernel, "valid") for column in padded.T], axis=1)


def _differentiate(values: np.ndarray) -> np.ndarray:
    return np.gradient(_smooth(values), 1 / RATE, axis=0)


def _compute_jerk(path: np.ndarray) -> float:
    """Compute the RMS of the third derivative of a path smoothed twice [m/s³]."""
    jerk = np.diff(_smooth(_smooth(path)), n=3, axis=0) * RATE**3
    return float(np.sqrt((jerk**2).sum(axis=1).mean()))
