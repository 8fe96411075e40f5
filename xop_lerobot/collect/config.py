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
    """Everything that determines a dataset's content; equal configurations give equal episodes.

    Attributes:
        robot: Name of the robot's morphology, `g1` for one.
        task: Name of the task.
        seed: Seed of the session; with the episode's index it decides all that is random.
        cameras: Cameras that are recorded.
        low_level: Low-level policy; `default` is the robot's own.
        low_level_path: Its file; empty for its default.
        fps: Rate of the control loop and of the dataset [Hz].
        width: Width of a picture [pixel].
        height: Height of a picture [pixel].
        noise: Preset of the sensors' noise.
        method: How the operator's motion becomes commands: `mpc`, `direct`, …
        variant: Variant of it: a binding, constraints and a preset, with `_` between.
        only_successful: Whether episodes that did not succeed are left out.
        video: Whether pictures are stored as h264 video, else as PNG.
        scene: Scene that the robot stands in; empty takes the task's own.
        heights: Heights over the task's usual ones; see `Task.choose_heights`.
        device: Operator device that drives the robot.
        plugins: Modules that are imported first, and may register robots, tasks and devices.
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
    """Class that makes the episodes in a worker, from the configuration and when the run began
    [s since the epoch]; it brings torch, which who only asks for a plan can do without."""

    def check(self) -> None:
        """Check all that can be checked before a robot is made; imports the plugins.

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
        """Return what must be the same for two runs to work on one dataset, fit for JSON."""
        settings = dataclasses.asdict(self)
        del settings["plugins"]
        if not self.heights:  # as in collections that were made before there were any
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

        The rollouts take one thread: the workers share the cores among them, and the episodes
        come out the same, configuration included, with any number of workers.

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
    """Import the user's own modules.

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
    """Add the flags that configure the simulation of an episode, except robot and task.

    Args:
        parser: Parser of the command.
        kind: Configuration whose defaults are shown.
        texts: What the help says of a flag instead.
    """
    defaults = {each.name: each.default for each in fields(kind) if each.default is not MISSING}

    def add(name: str, text: str, **options: Any) -> None:
        default = defaults[name.replace("-", "_")]
        shown = ",".join(default) if isinstance(default, tuple) else default
        text = texts.get(name) or f"{text} (default: {'none' if shown == '' else shown})"
        if default == "":  # "none" is what the help says of it
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
    add("method", "mpc, mpc_no_sync, mpc_table1, direct or direct_amo")
    add("variant", "binding, constraints and preset with _ between, such as v2_upright")
    add("scene", "scene; empty: the task's own")
    add("heights", "heights over the task's own, as support=0.35,table=0.6:0.7 [m]")
    add("plugins", "modules to import first, comma-separated", type=split)
    parser.add_argument(
        "--images", action="store_true", help="store images as PNG instead of h264 video"
    )


def add_crew(parser: CommandParser) -> None:
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
    """Read comma-separated names."""
    names = find_text(text.strip("[] ")).split(",")
    return tuple(name.strip() for name in names if name.strip())


def read_config[C: CollectConfig](kind: type[C], arguments: argparse.Namespace, **more: Any) -> C:
    """Make a configuration from the flags named as its fields.

    Args:
        kind: Its class.
        arguments: The flags.
        more: Fields that have no flag of their name.
    """
    names = {each.name for each in fields(kind)} & vars(arguments).keys()
    values = {name: getattr(arguments, name) for name in names}
    return kind(**{**values, "video": not arguments.images, **more})
