"""`xop-record`: record an `XopDataset` directly, with the flags of `lerobot-record`.

It adds: an episode ends on success, lock-step runs as fast as the machine allows, and Ctrl-C ends
without a traceback. Example:

    xop-record --robot.type=xop_g1 --teleop.type=xop --teleop.device.type=scripted \
        --dataset.repo_id=local/walk --dataset.root=outputs/walk --dataset.fps=25 \
        --dataset.num_episodes=2 --dataset.episode_time_s=20 --dataset.single_task=walk \
        --dataset.push_to_hub=false
"""
# No `from __future__ import annotations` here: LeRobot's parser reads the annotation of `record`.

import logging
import sys
import time
from collections.abc import Iterator, MutableMapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lerobot.configs import parser
from lerobot.datasets import (
    VideoEncodingManager,
    aggregate_pipeline_dataset_features,
    create_initial_features,
)
from lerobot.processor import make_default_processors
from lerobot.robots import Robot
from lerobot.scripts.lerobot_record import RecordConfig
from lerobot.utils.feature_utils import combine_feature_dicts
from lerobot.utils.import_utils import (
    make_device_from_device_class,
    register_third_party_plugins,
)
from lerobot.utils.keyboard_input import init_keyboard_listener
from lerobot.utils.robot_utils import precise_sleep
from lerobot.utils.utils import init_logging, log_say
from lerobot.utils.visualization_utils import (
    init_visualization,
    log_visualization_data,
    shutdown_visualization,
)

from lerobot_robot_xop import XopRobotConfig
from lerobot_teleoperator_xop import XopConfig
from lerobot_teleoperator_xop.terminal import listen_while_recording
from xop_lerobot.core.command_line import INTERRUPTED, make_output_readable
from xop_lerobot.core.errors import BadValue, XopError
from xop_lerobot.core.shutdown import stop_on_sigterm
from xop_lerobot.morphology.morphology import list_robot_types
from xop_lerobot.recording.dataset import XopDataset
from xop_lerobot.recording.host import own_loop
from xop_lerobot.recording.lockstep import count_ticks
from xop_lerobot.recording.opening import check_storage
from xop_lerobot.recording.step import record_step

if TYPE_CHECKING:
    from lerobot_robot_xop.xop_robot import XopRobot
    from lerobot_teleoperator_xop.xop import Xop

logger = logging.getLogger(__name__)


@dataclass
class XopRecordConfig(RecordConfig):
    """The flags of `lerobot-record`, and additional ones."""

    # End an episode as soon as its task is accomplished
    stop_on_success: bool = True
    # Slow a lock-step simulation down to real time, to watch it or to drive it by hand
    pace: bool = False


@dataclass
class Recording:
    """Records one episode after another.

    Attributes:
        config: Flags.
        robot: Connected robot.
        teleop: Connected teleoperator.
        dataset: Dataset to add to.
        events: Keyboard events: `exit_early`, `rerecord_episode`, `stop_recording`.
    """

    config: XopRecordConfig
    robot: "XopRobot"
    teleop: "Xop"
    dataset: XopDataset
    events: MutableMapping[str, bool]

    @property
    def realtime(self) -> bool:
        """Whether the robot's clock is the wall clock."""
        return self.robot.config.clock == "realtime"

    def run(self) -> None:
        """Record the number of episodes that `config` asks for."""
        wanted = self.dataset.num_episodes + self.config.dataset.num_episodes
        while self.dataset.num_episodes < wanted and not self.events["stop_recording"]:
            log_say(f"Recording episode {self.dataset.num_episodes}", self.config.play_sounds)
            self.run_episode()
            if self.events["rerecord_episode"]:
                self.events["rerecord_episode"] = self.events["exit_early"] = False
                self.dataset.clear_episode_buffer()
                continue
            self.dataset.save_episode()

    def run_episode(self) -> None:
        """Record one episode, until its time, task, operator or a key ends it."""
        config = self.config
        fps, duration = config.dataset.fps, config.dataset.episode_time_s
        limit = None if self.realtime else count_ticks(duration, fps)
        self.dataset.begin(self.events, limit, stop_on_success=config.stop_on_success)
        if self.realtime:
            # Resets happen inside an observation; do it before the episode's time starts.
            self.robot.get_observation()
        start = time.perf_counter()
        while not self.events["exit_early"]:
            tick_start = time.perf_counter()
            self.record_step()
            if self.realtime or config.pace:
                precise_sleep(max(0.0, tick_start + 1 / fps - time.perf_counter()))
            if self.realtime and time.perf_counter() - start >= duration:
                break
        self.events["exit_early"] = False

    def record_step(self) -> None:
        """Record one control step."""
        config = self.config
        observation, action = record_step(
            self.robot, self.teleop, self.dataset, config.dataset.single_task
        )
        if config.display_data:
            log_visualization_data(
                config.display_mode,
                observation=observation,
                action=action,
                compress_images=config.display_compressed_images,
            )


@parser.wrap()
def record(config: XopRecordConfig) -> XopDataset:
    """Record episodes of an xop robot with an xop teleoperator."""
    init_logging()
    robot_config, teleop_config = check_types(config)
    robot: XopRobot = make_device_from_device_class(robot_config)
    with own_loop():
        teleop: Xop = make_device_from_device_class(teleop_config)
    with stop_on_sigterm(), show_data(config):
        try:
            dataset = open_dataset(config, robot, teleop)
            try:
                record_episodes(config, robot, teleop, dataset)
            finally:
                dataset.finalize()
        finally:
            robot.disconnect()
            teleop.disconnect()
    if config.dataset.push_to_hub and dataset.num_episodes > 0:
        dataset.push_to_hub(tags=config.dataset.tags, private=config.dataset.private)
    return dataset


def record_episodes(
    config: XopRecordConfig, robot: "XopRobot", teleop: "Xop", dataset: XopDataset
) -> None:
    """Connect both devices and record into `dataset`."""
    teleop.connect()
    robot.connect()
    if teleop.config.keys and not teleop.has_keys:
        listener, events = listen_while_recording(teleop)
    else:
        listener, events = init_keyboard_listener()
    try:
        with VideoEncodingManager(dataset):
            Recording(config, robot, teleop, dataset, events).run()
    finally:
        if listener is not None:
            listener.stop()


@contextmanager
def show_data(config: XopRecordConfig) -> Iterator[None]:
    """Show observations and actions in LeRobot's viewer, if the flags ask for it."""
    if not config.display_data:
        yield
        return
    init_visualization(
        config.display_mode,
        session_name="recording",
        ip=config.display_ip,
        port=config.display_port,
    )
    try:
        yield
    finally:
        shutdown_visualization(config.display_mode)


def check_types(config: XopRecordConfig) -> tuple[XopRobotConfig, XopConfig]:
    """Return the configurations of robot and teleoperator, which must be of this project.

    Raises:
        BadValue: If one is not; `lerobot-record` accepts all types.
    """
    robot, teleop = config.robot, config.teleop
    if isinstance(robot, XopRobotConfig) and isinstance(teleop, XopConfig):
        return robot, teleop
    raise BadValue(
        f"xop-record takes --robot.type={list_robot_types()} and --teleop.type=xop, got "
        f"{robot.type} and {teleop.type if teleop else 'none'}. Use lerobot-record for others"
    )


def open_dataset(config: XopRecordConfig, robot: "XopRobot", teleop: "Xop") -> XopDataset:
    """Create the dataset that the flags describe, or open it to resume.

    Raises:
        XopError: If it cannot be created or resumed; see `XopDataset`.
    """
    flags = config.dataset
    columns = teleop.config.record.columns
    bound = XopDataset.bind(robot.config.session, extra_columns=columns)
    options = {
        "root": flags.root,
        "batch_encoding_size": flags.video_encoding_batch_size,
        "rgb_encoder": flags.rgb_encoder,
        "depth_encoder": flags.depth_encoder,
        "encoder_threads": flags.encoder_threads,
        "streaming_encoding": flags.streaming_encoding,
        "encoder_queue_maxsize": flags.encoder_queue_maxsize,
        "image_writer_processes": flags.num_image_writer_processes,
        "image_writer_threads": flags.num_image_writer_threads_per_camera * len(robot.cameras),
    }
    if config.resume:
        dataset = bound.resume(flags.repo_id, **options)
        try:
            check_storage(dataset.root, dataset.meta.features, use_videos=flags.video)
        except XopError:
            dataset.finalize()
            raise
        return dataset
    flags.stamp_repo_id()
    return bound.create(
        flags.repo_id,
        flags.fps,
        build_features(robot, use_videos=flags.video),
        robot_type=robot.name,
        use_videos=flags.video,
        **options,
    )


def build_features(robot: Robot, *, use_videos: bool) -> dict[str, dict]:
    """Build LeRobot's own features of a robot: `action`, `observation.state` and images."""
    teleop_step, _, observation_step = make_default_processors()
    return combine_feature_dicts(
        aggregate_pipeline_dataset_features(
            pipeline=teleop_step,
            initial_features=create_initial_features(action=robot.action_features),
            use_videos=use_videos,
        ),
        aggregate_pipeline_dataset_features(
            pipeline=observation_step,
            initial_features=create_initial_features(observation=robot.observation_features),
            use_videos=use_videos,
        ),
    )


def main() -> None:
    """Run `xop-record`; a user error ends in one line instead of a traceback."""
    make_output_readable()
    register_third_party_plugins()
    try:
        record()  # pyright: ignore[reportCallIssue]  the parser makes the argument
    except KeyboardInterrupt:
        print("interrupted; saved episodes are kept", file=sys.stderr)
        sys.exit(INTERRUPTED)
    except XopError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
