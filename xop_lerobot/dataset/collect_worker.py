"""One worker of `xop-collect`: robot, simulated operator and one dataset for each episode.

The robot and the teleoperator are the LeRobot devices that `lerobot-record` uses, run in
lock-step, and the frames go through the same `XopDataset`. The teleoperator is made anew for each
episode, which takes a few hundredths of a second, and the robot starts over with a seed made of
the collection's and the episode's index: an episode can't depend on those before it.
"""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING

import av
import av.logging
from lerobot.configs.video import RGBEncoderConfig
from lerobot.utils.import_utils import make_device_from_device_class

from xop_lerobot.dataset.collect_config import CollectConfig, import_plugins
from xop_lerobot.dataset.collect_folder import Attempt, CollectFolder
from xop_lerobot.dataset.host import count_ticks
from xop_lerobot.dataset.record import build_features
from xop_lerobot.dataset.tick import run_tick
from xop_lerobot.dataset.xop_dataset import XopDataset
from xop_lerobot.link import get_session

if TYPE_CHECKING:
    from pathlib import Path

    from lerobot_robot_xop.xop_robot import XopRobot
    from lerobot_teleoperator_xop.xop import Xop

_GRACE_S = 10.0
"""How long after a task's own time limit an episode is ended all the same [s]."""
_QUEUE = 60
"""Pictures that may wait for the encoder; lock-step waits when it is full."""


class Collector:
    """Makes single episodes of a collection, in any order.

    Args:
        config: What is collected.
        folder: Where to.
        run: When this run began [s since the epoch].
    """

    def __init__(self, config: CollectConfig, folder: CollectFolder, run: float) -> None:
        import_plugins(config.plugins)
        _calm_down()
        self.config, self.folder, self.run = config, folder, run
        task = config.make_task()
        self._instruction = task.instruction
        self._limit = count_ticks(task.time_limit + _GRACE_S, config.fps)
        self.robot: XopRobot = make_device_from_device_class(config.make_robot_config())
        self._session = get_session(self.robot.config.session)
        self.robot.connect()

    def collect(self, index: int) -> Attempt:
        """Make episode `index`, and let it count."""
        cpu = time.process_time()
        folder = self.folder.open_attempt(index)
        teleop: Xop = make_device_from_device_class(self.config.make_teleop_config())
        # LeRobot's own loop is not used here, so it needs no help.
        teleop.host.remove()
        teleop.connect()
        try:
            dataset = self._create(folder / "dataset")
            try:
                frames = self._run(index, teleop, dataset)
                outcome = self._session.outcome
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
        failure = "" if success else str(getattr(outcome, "failure", ""))
        attempt = Attempt(
            index,
            success,
            failure,
            kept,
            frames,
            run=self.run,
            elapsed=time.time() - self.run,
            cpu_s=time.process_time() - cpu,
        )
        self.folder.close_attempt(folder, attempt)
        return attempt

    def _create(self, root: Path) -> XopDataset:
        config = self.config
        return XopDataset.bind(self._session.name).create(
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

    def _run(self, index: int, teleop: Xop, dataset: XopDataset) -> int:
        """Run the episode until its task, its operator or its time is over; return its frames."""
        self._session.begin_episode(index)
        events = {"exit_early": False}
        dataset.begin(events, self._limit)
        frames = 0
        while not events["exit_early"]:
            run_tick(self.robot, teleop, dataset, self._instruction)
            frames += 1
            outcome = self._session.outcome
            if outcome is not None and outcome.done:
                break
        return frames

    def close(self) -> None:
        """Let go of the robot; may be called twice."""
        self.robot.disconnect()


def _calm_down() -> None:
    """Leave out what encoders and decoders tell of themselves."""
    av.logging.set_libav_level(av.logging.ERROR)
    logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)
