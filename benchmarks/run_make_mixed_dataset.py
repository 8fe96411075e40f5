"""Record a small dataset of mixed episodes and a killed session, to test `xop-curate` on.

    .venv/bin/python -m benchmarks.run_make_mixed_dataset --out outputs/mixed

A simulated G1 follows a synthetic person who crouches and stands up again. Some crouch well, some
not deeply enough; some robots are pushed over, some headsets lose tracking, some people stand idle
before or after. No planner runs (`--teleop.retargeter.type=direct`) and the images are tiny, so
that 30 episodes take about a minute. The same seed makes the same episodes.

    OUT/session        the episodes, as `xop-record` writes them
    OUT/kinds.json     the kind of each: success, failure, fall, tracking_loss, idle_start, …
    OUT/killed         a session of `xop-record`, killed (`kill -9`) in the middle of an episode
"""

from __future__ import annotations

import argparse
import json
import logging
import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from tqdm import tqdm

from xop_lerobot.core.command_line import make_output_readable
from xop_lerobot.core.errors import BadValue, XopError
from xop_lerobot.session import TaskStatus
from xop_lerobot.tasks.task import TASKS, Task

if TYPE_CHECKING:
    import mujoco

    from lerobot_robot_xop.xop_robot import XopRobot
    from xop_lerobot.operator.display import SeenObject
    from xop_lerobot.plant.simulation import Simulation
    from xop_lerobot.recording.dataset import XopDataset

FPS = 25
RATE_HZ = 50
HANDS = {
    "left": ((0.173, 0.234, -0.555), (0.737, -0.667, 0.074, 0.080)),
    "right": ((0.173, -0.234, -0.555), (0.737, 0.667, 0.074, -0.080)),
}
"""Positions of the wrists from the head [m] and orientations wxyz: those of a G1 at rest, so that
its arms need not move when the person engages."""
KILLED_EPISODES = 3
"""Episodes that the killed session saves first."""
SESSION = "mixed"
ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "HF_DATASETS_DISABLE_PROGRESS_BARS": "1",
    # The killed process leaves resources behind on purpose.
    "PYTHONWARNINGS": "ignore:resource_tracker,ignore:Cannot enable progress bars",
}


@dataclass(frozen=True)
class Kind:
    """One kind of episode.

    Attributes:
        depth: Depth of the crouch [m].
        idle_start: Time for which the person stands still before [s].
        idle_end: Time for which the person stands still after [s].
        lost: Indices of the frames (head, left wrist, right wrist) that the headset loses on the
            way down.
        lost_s: Duration of the loss [s].
        push: Force that pushes the robot over [N].
    """

    depth: float = 0.28
    idle_start: float = 0.2
    idle_end: float = 0.2
    lost: tuple[int, ...] = ()
    lost_s: float = 0.0
    push: float = 0.0


KINDS: Mapping[str, Kind] = {
    "success": Kind(),
    "failure": Kind(depth=0.05),
    "fall": Kind(push=900.0),
    "tracking_loss": Kind(lost=(0, 1), lost_s=0.8),
    "idle_start": Kind(idle_start=2.0),
    "idle_both": Kind(idle_start=1.4, idle_end=1.6),
}
ORDER = (
    "success", "failure", "success", "idle_start", "success", "fall", "success", "tracking_loss",
    "success", "idle_both",
)  # fmt: skip
"""Kinds of ten consecutive episodes; repeated from then on."""


@TASKS.register("crouch")
class Crouch(Task):
    """Lower the head by 12 cm and bring it back up to within 5 cm."""

    name = "crouch"
    instruction = "crouch and stand up again"
    time_limit = 20.0
    push: ClassVar[float] = 0.0
    """Force on the trunk from 1.0 s to 1.3 s after the start [N]; set per episode by `Recorder`."""

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add nothing."""

    def bind(self, plant: Simulation) -> None:
        """Remember the plant."""
        self._plant = plant
        self._trunk = plant.model.body(self.morphology.base_body).id

    def reset(self, rng: np.random.Generator) -> None:
        """Measure the head's height and forget the last crouch."""
        del rng
        self._start, self._begin = self._height, self._plant.time
        self._was_low = self._success = False

    @property
    def _height(self) -> float:
        return float(self._plant.get_site_pose(self.morphology.frames["head"])[2])

    def update(self) -> TaskStatus:
        """Track the head's depth, and push the robot during its push."""
        lowered = self._start - self._height
        self._was_low |= lowered > 0.12
        self._success |= self._was_low and lowered < 0.05 and not self._plant.has_fallen
        pushed = 1.0 < self._plant.time - self._begin < 1.3
        self._plant.data.xfrc_applied[self._trunk, 0] = self.push if pushed else 0.0
        return TaskStatus(success=self._success and not self._plant.has_fallen, done=False)

    @property
    def objects(self) -> Mapping[str, SeenObject]:
        """No objects."""
        return {}


def make_motion(kind: Kind, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Make an operator recording of one kind: stand, crouch, stand up, stand.

    Args:
        kind: Kind of the episode.
        rng: Random generator of speed, depth and sway.

    Returns:
        The arrays of an operator recording (docs/how_it_works/operator.md), at 50 Hz.
    """
    down, low, up = rng.uniform(0.7, 1.0), rng.uniform(0.1, 0.3), rng.uniform(0.7, 1.0)
    depth = kind.depth * rng.uniform(0.9, 1.1)
    marks = np.cumsum([kind.idle_start + rng.uniform(0, 0.1), down, low, up, kind.idle_end])
    t = np.arange(0.0, marks[-1], 1 / RATE_HZ)
    lowered = depth * (_rise(t, marks[0], down) - _rise(t, marks[2], up))

    def sway(size: float) -> np.ndarray:
        """Return postural sway of amplitude `size` [m], as in docs/how_it_works/operator.md."""
        rates, phases = rng.uniform(0.1, 0.6, 3), rng.uniform(0, 2 * np.pi, 3)
        return size * np.sin(2 * np.pi * rates * t[:, None] + phases)

    pose = np.tile([0.0, 0, 1.6, 1, 0, 0, 0], (len(t), 1))
    pose[:, :3] += sway(0.002)
    pose[:, 2] -= lowered
    motion = {"t": t, "head_pose": pose}
    for side, (offset, quat) in HANDS.items():
        wrist = np.concatenate([pose[:, :3] + offset, np.tile(quat, (len(t), 1))], axis=1)
        wrist[:, :3] += sway(0.001)
        wrist[:, 0] += 0.5 * lowered
        motion |= {f"{side}_wrist_pose": wrist, f"{side}_pinch": np.full(len(t), 0.08)}
    motion["tracked"] = np.ones((len(t), 3), bool)
    if kind.lost:
        gone = (t >= marks[0] + 0.2) & (t < marks[0] + 0.2 + kind.lost_s)
        motion["tracked"][np.ix_(gone, kind.lost)] = False
    return motion


def _rise(t: np.ndarray, start: float, duration: float) -> np.ndarray:
    """Return a minimum-jerk movement from 0 to 1. Shape (T,)."""
    s = np.clip((t - start) / duration, 0, 1)
    return s**3 * (10 - 15 * s + 6 * s**2)


class Recorder:
    """Record single episodes of given kinds into one dataset.

    Args:
        root: Directory of the dataset, which must not exist.
        seed: Seed of the robot and of the person's motions.
        size: Width and height of an image [pixel].
    """

    def __init__(self, root: Path, seed: int, size: tuple[int, int]) -> None:
        from lerobot.configs.video import RGBEncoderConfig

        from lerobot_robot_xop.config_xop import XopG1Config
        from lerobot_robot_xop.xop_robot import XopG1
        from xop_lerobot.recording.dataset import XopDataset
        from xop_lerobot.recording.record import build_features
        from xop_lerobot.session import get_session

        self._seed, self._session = seed, get_session(SESSION)
        self.robot: XopRobot = XopG1(
            XopG1Config(
                session=SESSION, fps=FPS, seed=seed, task="crouch", width=size[0], height=size[1]
            )
        )
        self.robot.connect()
        self._teleop = self._make_teleop("unused")
        self.dataset: XopDataset = XopDataset.bind(SESSION).create(
            f"local/{root.name}",
            FPS,
            build_features(self.robot, use_videos=True),
            root=root,
            robot_type=self.robot.name,
            rgb_encoder=RGBEncoderConfig(vcodec="h264", preset="ultrafast"),
            encoder_threads=1,
            streaming_encoding=True,
        )

    def _make_teleop(self, path: str) -> Any:
        from lerobot_teleoperator_xop import Xop, XopConfig
        from xop_lerobot.operator.devices.config import DeviceConfig
        from xop_lerobot.retarget.config import RetargeterConfig

        teleop = Xop(
            XopConfig(
                session=SESSION,
                device=DeviceConfig(type="replay", path=path, hold_s=0.2),
                retargeter=RetargeterConfig(type="direct"),
            )
        )
        teleop.host.remove()
        return teleop

    def record(self, index: int, name: str, ticks: int | None = None) -> None:
        """Record episode `index` of the kind `name`, or only its first `ticks`, unsaved."""
        from xop_lerobot.recording.step import record_step

        rng = np.random.default_rng([self._seed, index])
        Crouch.push = KINDS[name].push
        self._session.begin_episode(index)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "person.npz"
            motion: dict[str, Any] = dict(make_motion(KINDS[name], rng))
            np.savez(path, **motion)
            teleop = self._make_teleop(str(path))
            teleop.connect()
        events = {"exit_early": False}
        self.dataset.begin(events, ticks)
        try:
            while not events["exit_early"]:
                record_step(self.robot, teleop, self.dataset, Crouch.instruction)
        finally:
            teleop.disconnect()
        if ticks is None:
            self.dataset.save_episode()

    def close(self) -> None:
        """Finalize the dataset and disconnect the robot."""
        self.dataset.finalize()
        self.robot.disconnect()


def make_session(root: Path, seed: int, size: tuple[int, int], kinds: Sequence[str]) -> None:
    """Record a session with an episode of each of `kinds`."""
    recorder = Recorder(root, seed, size)
    try:
        for index, kind in enumerate(tqdm(kinds, desc="episodes", disable=None)):
            recorder.record(index, kind)
    except BaseException:
        shutil.rmtree(root, ignore_errors=True)
        raise
    finally:
        recorder.close()


def make_killed(root: Path, seed: int, size: tuple[int, int]) -> None:
    """Record a session and kill this process in the middle of its last, unsaved episode."""
    recorder = Recorder(root, seed, size)
    for index in range(KILLED_EPISODES):
        recorder.record(index, ORDER[index])
    recorder.record(KILLED_EPISODES, "success", ticks=20)
    os.kill(os.getpid(), signal.SIGKILL)


def main() -> int:
    """Record all sessions; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="directory for the results")
    parser.add_argument("--episodes", type=int, default=30, help="episodes of OUT/session")
    parser.add_argument("--seed", type=int, default=0, help="random seed")
    parser.add_argument("--width", type=int, default=48, help="width of an image [pixel]")
    parser.add_argument("--height", type=int, default=36, help="height of an image [pixel]")
    parser.add_argument("--only-session", action="store_true", help="do not make OUT/killed")
    args = parser.parse_args()
    try:
        make_all(args)
    except XopError as error:
        sys.exit(f"error: {error}")
    return 0


def make_all(args: argparse.Namespace) -> None:
    """Record the complete session, then the one that is killed.

    Raises:
        BadValue: If there are too few episodes, or the directory is not empty.
        XopError: If a session does not end as expected.
    """
    least = KILLED_EPISODES + 1
    if args.episodes < least:
        raise BadValue(f"--episodes must be at least {least}, got {args.episodes}")
    if args.out.exists() and any(args.out.iterdir()):
        raise BadValue(f"'{args.out}' is not empty. Choose another --out, or delete it")
    args.out.mkdir(parents=True, exist_ok=True)
    session, size = args.out / "session", (args.width, args.height)
    kinds = [ORDER[index % len(ORDER)] for index in range(args.episodes)]
    run(make_session, session, args.seed, size, kinds)
    (args.out / "kinds.json").write_text(json.dumps(kinds) + "\n", encoding="utf-8")
    if not args.only_session:
        run(make_killed, args.out / "killed", args.seed + 1, size, expected=-signal.SIGKILL)


def run(target: Callable[..., None], *arguments: Any, expected: int = 0) -> None:
    """Run `target` in its own process, forked from one that has done the slow imports.

    Raises:
        XopError: If the process does not end with the exit code `expected`.
    """
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["lerobot.datasets", "lerobot_robot_xop.xop_robot"])
    process = context.Process(target=_run_calmly, args=(target, *arguments))
    process.start()
    process.join()
    if process.exitcode != expected:
        raise XopError(f"'{target.__name__}' ended with exit code {process.exitcode}")


def _run_calmly(target: Callable[..., None], *arguments: Any) -> None:
    """Run `target` without the log messages of the video codecs."""
    import av.logging

    av.logging.set_libav_level(av.logging.ERROR)
    logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)
    target(*arguments)


if __name__ == "__main__":
    make_output_readable()
    sys.exit(main())
