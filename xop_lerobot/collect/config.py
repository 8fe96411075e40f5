"""Configuration of `xop-collect`: task, robot, simulated operator and their settings."""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import sys
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from xop_lerobot.core.command_line import CommandParser
from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.yaml_words import find_text

if TYPE_CHECKING:
    from lerobot_robot_xop import XopRobotConfig
    from lerobot_teleoperator_xop import XopConfig
    from xop_lerobot.collect.folder import Attempt
    from xop_lerobot.morphology.morphology import Morphology
    from xop_lerobot.tasks.task import Task


@dataclass(frozen=True)
class CollectConfig:
    """Everything that decides the content of a dataset; equal configurations give equal episodes.

    Attributes:
        robot: Name of the robot's morphology, such as `g1`.
        task: Name of the task.
        seed: Seed of the session; with the episode's index it seeds all randomness.
        cameras: Recorded cameras.
        low_level: Low-level policy; `default` is the robot's own.
        low_level_path: Its file; empty for its default.
        fps: Rate of control loop and dataset [Hz].
        width: Image width [px].
        height: Image height [px].
        noise: Preset of the sensor noise.
        method: Method of retargeting: `mpc`, `direct`, …
        variant: Its variant: a binding, constraints and a preset, joined by `_`.
        only_successful: Whether failed episodes are left out.
        video: Whether images are stored as H.264 video, else as PNG.
        scene: Scene; empty for the task's own.
        heights: Heights that override the task's defaults; see `Task.choose_heights`.
        device: Operator device that drives the robot.
        plugins: Modules to import first, which may register robots, tasks and devices.
    """

    robot: str
    task: str
    seed: int = 0
    cameras: tuple[str, ...] = ("head",)
    low_level: str = "default"
    low_level_path: str = ""
    fps: int = 25
    width: int = 320
    height: int = 240
    noise: str = "mild"
    method: str = "mpc"
    variant: str = ""
    only_successful: bool = False
    video: bool = True
    scene: str = ""
    heights: str = ""
    device: str = "simulated"
    plugins: tuple[str, ...] = ()

    maker: ClassVar[str] = "xop_lerobot.collect.worker:Collector"
    """Class that makes the episodes in a worker, called with the configuration and the start time
    of the run [s since the epoch]. Named, not imported: it imports torch, which planning a run does
    not need."""

    def check(self) -> None:
        """Check everything that does not need a robot; imports the plugins.

        Raises:
            UnknownName: If there is no such robot, task, height, policy, noise, method or device.
            BadValue: If a number is out of its range, or a plugin cannot be imported.
        """
        from xop_lerobot.operator.devices import make_device  # noqa: PLC0415 MuJoCo

        import_plugins(self.plugins)
        self.make_task()
        self.make_robot_config()
        make_device(self.make_teleop_config().device)

    def to_settings(self) -> dict[str, Any]:
        """Return the settings that runs on one dataset must share, as plain values for JSON."""
        settings = dataclasses.asdict(self)
        del settings["plugins"]
        if not self.heights:  # equal to collections from before heights existed
            del settings["heights"]
        return {**settings, "cameras": list(self.cameras)}

    def describe(self, attempt: Attempt) -> str:
        """Describe the outcome of an episode in a few words."""
        return "success" if attempt.success else attempt.failure or "no success"

    @property
    def morphology(self) -> Morphology:
        """The robot.

        Raises:
            UnknownName: Listing the known robots.
        """
        from xop_lerobot.morphology.morphology import make_morphology  # noqa: PLC0415 MuJoCo

        return make_morphology(self.robot)

    def make_task(self) -> Task:
        """Make the task, to read its instruction, time limit and scene.

        Raises:
            UnknownName: If there is no such task or height, listing the known ones.
            BadValue: If the heights are malformed, or out of the robot's reach.
        """
        from xop_lerobot.tasks.task import make_task  # noqa: PLC0415 MuJoCo

        return make_task(self.task, self.morphology, self.heights)

    def make_robot_config(self) -> XopRobotConfig:
        """Make the configuration of the robot as a LeRobot device.

        Raises:
            BadValue: If a number is out of its range.
            UnknownName: If a name is unknown, listing the known ones.
        """
        from lerobot.robots.config import RobotConfig  # noqa: PLC0415 torch

        from lerobot_robot_xop.config_xop import LowLevelConfig, SceneConfig  # noqa: PLC0415
        from xop_lerobot.evaluation.methods import resolve_low_level  # noqa: PLC0415 MuJoCo

        low_level = resolve_low_level(self.morphology, self.method, self.low_level)
        kind: type[XopRobotConfig] = RobotConfig.get_choice_class(f"xop_{self.robot}")
        return kind(
            task=self.task,
            task_heights=self.heights,
            fps=self.fps,
            seed=self.seed,
            cameras=list(self.cameras),
            width=self.width,
            height=self.height,
            sim=SceneConfig(scene=self.scene, noise=self.noise),
            low_level=LowLevelConfig(low_level, self.low_level_path or None),
        )

    def make_teleop_config(self) -> XopConfig:
        """Make the configuration of the teleoperator as a LeRobot device.

        Rollouts take one thread: the workers share the cores, and episodes are the same, including
        the configuration, with any number of workers.

        Raises:
            BadValue: If the variant contradicts the method.
            UnknownName: If a name is unknown, listing the known ones.
        """
        from lerobot_teleoperator_xop import XopConfig  # noqa: PLC0415 torch
        from xop_lerobot.evaluation.methods import make_retargeter_config  # noqa: PLC0415 MuJoCo
        from xop_lerobot.operator.devices.config import DeviceConfig  # noqa: PLC0415

        return XopConfig(
            device=DeviceConfig(type=self.device, seed=self.seed),
            retargeter=make_retargeter_config(
                self.morphology, self.method, self.variant, self.seed
            ),
        )


def import_plugins(names: tuple[str, ...]) -> None:
    """Import user modules.

    Raises:
        BadValue: If one cannot be found.
    """
    for name in names:
        if str(Path.cwd()) not in sys.path:
            sys.path.append(str(Path.cwd()))
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            raise BadValue(
                f"plugin '{name}' cannot be imported: {error}. Name a module that is installed or "
                "lies in this directory"
            ) from error


def add_config(
    parser: CommandParser, kind: type[CollectConfig] = CollectConfig, **texts: str
) -> None:
    """Add the flags of the configuration, except robot and task.

    Args:
        parser: Parser of the command.
        kind: Configuration class that defines the defaults.
        texts: Help texts that replace the usual ones, by flag.
    """
    defaults = {each.name: each.default for each in fields(kind) if each.default is not MISSING}

    def add(name: str, text: str, **options: Any) -> None:
        default = defaults[name.replace("-", "_")]
        shown = ",".join(default) if isinstance(default, tuple) else default
        text = texts.get(name) or f"{text} (default: {'none' if shown == '' else shown})"
        if default == "":  # shown as "none" in the help, so accept that word
            options.setdefault("type", find_text)
        parser.add_argument(f"--{name}", help=text, default=default, **options)

    add("seed", "seed of everything random", type=int)
    add("cameras", "cameras, comma-separated", type=split)
    add("low-level", "low-level policy; default: the robot's own")
    add("low-level-path", "file of the low-level policy; empty: its default")
    add("fps", "rate of control and dataset [Hz]; divides 50", type=int)
    add("width", "image width [pixel]", type=int)
    add("height", "image height [pixel]", type=int)
    add("noise", "sensor noise: off, mild or harsh")
    add("method", "mpc, mpc_no_sync, mpc_table1, mpc_table1_charitable, direct or direct_amo")
    add("variant", "binding, constraints and preset joined by _, such as v2_upright")
    add("scene", "scene; empty: the task's own")
    add("heights", "heights that override the task's, such as support=0.35,table=0.6:0.7 [m]")
    add("plugins", "modules to import first, comma-separated", type=split)
    parser.add_argument(
        "--images", action="store_true", help="store images as PNG instead of h264 video"
    )


def add_worker_flags(parser: CommandParser) -> None:
    """Add `--workers` and `--ray`."""
    parser.add_argument(
        "--workers", type=int, default=0, help="processes; 0: one per core (default: 0)"
    )
    parser.add_argument(
        "--ray",
        default="",
        metavar="ADDRESS",
        help="run the episodes on a Ray cluster: local, auto, HOST:PORT or ray://HOST:PORT "
        "(default: none)",
    )


def split(text: str) -> tuple[str, ...]:
    """Split comma-separated names."""
    names = find_text(text.strip("[] ")).split(",")
    return tuple(name.strip() for name in names if name.strip())


def read_config[C: CollectConfig](kind: type[C], arguments: argparse.Namespace, **more: Any) -> C:
    """Make a configuration from the flags named as its fields.

    Args:
        kind: Configuration class.
        arguments: The flags.
        more: Fields without a flag of the same name.
    """
    names = {each.name for each in fields(kind)} & vars(arguments).keys()
    values = {name: getattr(arguments, name) for name in names}
    return kind(**{**values, "video": not arguments.images, **more})
