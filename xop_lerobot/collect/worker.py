"""Worker of `xop-collect`: robot, simulated operator, and one dataset per episode.

Robot and teleoperator are the LeRobot devices that `lerobot-record` uses, in lock-step, and frames
go through the same `XopDataset`. The teleoperator is created for each episode, which takes a few
hundredths of a second, and the robot is reset with a seed made of the collection's seed and the
episode's index: an episode cannot depend on those before it.
"""

from __future__ import annotations

import logging
import time
from functools import cached_property
from typing import TYPE_CHECKING, Any

import av
import av.logging
from lerobot.configs.video import RGBEncoderConfig
from lerobot.utils.import_utils import make_device_from_device_class

from xop_lerobot.collect.config import CollectConfig, import_plugins
from xop_lerobot.collect.folder import DATASET, Attempt
from xop_lerobot.collect.run import get_index
from xop_lerobot.recording.dataset import XopDataset
from xop_lerobot.recording.host import own_loop
from xop_lerobot.recording.lockstep import count_ticks
from xop_lerobot.recording.record import build_features
from xop_lerobot.recording.step import record_step
from xop_lerobot.session import TaskStatus, get_session

if TYPE_CHECKING:
    from pathlib import Path

    from lerobot_robot_xop.xop_robot import XopRobot
    from lerobot_teleoperator_xop.xop import Xop
    from xop_lerobot.tasks.task import Task

_GRACE_S = 10.0
"""Time over the task's limit after which an episode is ended anyway [s]."""
_QUEUE = 60
"""Length of the encoder's queue [images]; lock-step waits when it is full."""


class Collector:
    """Makes single episodes of a collection, in any order.

    Args:
        config: Configuration of the collection.
        run: Start time of this run [s since the epoch].
    """

    def __init__(self, config: CollectConfig, run: float) -> None:
        import_plugins(config.plugins)
        _quieten_logs()
        self.config, self.run = config, run
        self.robot: XopRobot = make_device_from_device_class(config.make_robot_config())
        self.session = get_session(self.robot.config.session)
        self.robot.connect()

    def make(self, job: Any, folder: Path) -> Attempt:
        """Make an episode.

        Args:
            job: The episode: its index, or an object with an `index`.
            folder: Folder of the episode; its dataset is `DATASET` in it.
        """
        cpu = time.process_time()
        index = get_index(job)
        with own_loop():
            teleop: Xop = make_device_from_device_class(self.config.make_teleop_config())
        teleop.connect()
        try:
            dataset = self._create(folder / DATASET)
            try:
                self.begin(job, teleop, dataset)
                frames = self._run(job, teleop, dataset)
                outcome = self._outcome
                success = outcome is not None and outcome.success
                kept = success or not self.config.only_successful
                if kept:
                    dataset.save_episode()
                else:
                    dataset.clear_episode_buffer()
            finally:
                dataset.finalize()
        finally:
            teleop.disconnect()
        return Attempt(
            index,
            success,
            failure="" if success or outcome is None else outcome.failure,
            kept=kept,
            frames=frames,
            run=self.run,
            elapsed=time.time() - self.run,
            cpu_s=time.process_time() - cpu,
        )

    def _create(self, root: Path) -> XopDataset:
        config = self.config
        return XopDataset.bind(self.session.name).create(
            "local/episode",
            config.fps,
            build_features(self.robot, use_videos=config.video),
            root=root,
            robot_type=self.robot.name,
            use_videos=config.video,
            # As in configs/record_*.yaml: the setting that costs the planner least.
            rgb_encoder=RGBEncoderConfig(vcodec="h264", preset="ultrafast"),
            encoder_threads=1,
            streaming_encoding=config.video,
            encoder_queue_maxsize=_QUEUE,
            image_writer_threads=0 if config.video else len(config.cameras),
        )

    def _run(self, job: Any, teleop: Xop, dataset: XopDataset) -> int:
        """Run the episode until task, operator or time limit ends it; return its length."""
        self.session.begin_episode(get_index(job))
        events = {"exit_early": False}
        dataset.begin(events, self.get_limit(job))
        frames = 0
        while not events["exit_early"]:
            record_step(self.robot, teleop, dataset, self.get_instruction(job, frames))
            frames += 1
            outcome = self._outcome
            if outcome is not None and outcome.done:
                break
        return frames

    @property
    def _outcome(self) -> TaskStatus | None:
        """Status of the task after the last action."""
        tick = self.session.tick
        return None if tick is None else tick.outcome

    # Hooks for other kinds of collection.

    def begin(self, job: Any, teleop: Xop, dataset: XopDataset) -> None:
        """Prepare the first frame of an episode."""

    def get_limit(self, job: Any) -> int:
        """Largest number of frames of an episode."""
        del job
        return count_ticks(self._task.time_limit + _GRACE_S, self.config.fps)

    def get_instruction(self, job: Any, frame: int) -> str:
        """Instruction of the task at a frame of an episode."""
        del job, frame
        return self._task.instruction

    @cached_property
    def _task(self) -> Task:
        return self.config.make_task()

    def close(self) -> None:
        """Release the robot; may be called twice."""
        self.robot.disconnect()


def _quieten_logs() -> None:
    """Silence the log output of encoders and decoders."""
    av.logging.set_libav_level(av.logging.ERROR)
    logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)
