"""Configurations of the robots. Imports neither MuJoCo nor heavy parts of LeRobot."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from lerobot.robots.config import RobotConfig

from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.yaml_words import fill_nulls, find_text, find_word, recover_typed
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.plant.config import NOISE_PRESETS, NoiseConfig, SimulationConfig
from xop_lerobot.recording.rollout_pictures import watch_rollouts
from xop_lerobot.tasks.heights import parse_heights
from xop_lerobot.tasks.task import get_task

POLICY_HZ = 50
"""Rate of every low-level policy [Hz]; the control rate must divide it."""
CLOCKS = ("lockstep", "realtime")


@dataclass
class SceneConfig:
    """Scene of the simulation, and sensor noise."""

    scene: str = ""  # name of the scene; default: the task's own, or empty
    noise: str = "off"  # sensor noise: off, mild or harsh
    sensors: NoiseConfig = field(default_factory=NoiseConfig)  # values that override the preset's
    viewer_port: int = 8012  # port of the browser viewer, used without a display

    def __post_init__(self) -> None:
        """Restore words that YAML parsed as other types, such as `off`."""
        if self.noise is not None:
            self.noise = find_word(self.noise, NOISE_PRESETS)
        fill_nulls(self)


@dataclass
class LowLevelConfig:
    """Policy that turns whole-body commands into motor targets."""

    name: str = "default"  # policy; default: the robot's own
    path: str | None = None  # the policy's file, if it takes one

    def __post_init__(self) -> None:
        """Restore words that YAML parsed as other types."""
        fill_nulls(self)


@dataclass(kw_only=True)
class XopRobotConfig(RobotConfig):
    """Settings common to all robots of this project."""

    session: str = "default"  # pairs this robot with the teleoperator of the same session
    fps: int = 25  # control rate [Hz]; must divide 50 and equal --dataset.fps
    clock: str = "lockstep"  # lockstep: only send_action advances time; realtime: wall clock
    task: str = ""  # task to set up: dual_point_touch, …; empty for none
    task_heights: str = ""  # override heights: support=0.35,table=0.6:0.7 [m]
    seed: int = 0  # in lockstep equal seeds give bit-identical episodes
    cameras: list[str] | str = field(
        default_factory=lambda: ["head"]
    )  # [head, scene] or head,scene
    width: int = 320  # image width [px]
    height: int = 240  # image height [px]
    viewer: bool = False  # show the simulation in a window, or in the browser
    sim: SceneConfig = field(default_factory=SceneConfig)  # scene and sensor noise
    low_level: LowLevelConfig = field(default_factory=LowLevelConfig)  # low-level policy

    morphology: ClassVar[str]
    """Name of the robot's morphology."""

    def __post_init__(self) -> None:
        """Validate all values, in place of LeRobot's own check, which expects camera objects.

        Raises:
            BadValue: If a number is out of its range, or heights are given without a task.
            UnknownName: If there is no such task, clock or noise, listing the known ones.
        """
        fill_nulls(self)
        self.task, self.sim.scene = find_text(self.task), find_text(self.sim.scene)
        self.task_heights = find_text(self.task_heights)
        if parse_heights(self.task_heights) and not self.task:
            raise BadValue(
                f"robot.task_heights={self.task_heights} needs a task. Pass --robot.task"
            )
        recover_typed(self, "robot", "session")
        recover_typed(self.low_level, "robot.low_level", "path")
        if self.fps < 1 or POLICY_HZ % self.fps:
            divisors = [n for n in range(1, POLICY_HZ + 1) if POLICY_HZ % n == 0]
            raise BadValue(
                f"robot.fps must divide the low-level policy's {POLICY_HZ} Hz, got {self.fps}. "
                f"Use one of {', '.join(map(str, divisors))}"
            )
        if self.clock not in CLOCKS:
            raise UnknownName("robot.clock", self.clock, CLOCKS)
        if isinstance(self.cameras, str):
            names = find_text(self.cameras.strip("[] ")).split(",")
            self.cameras = [name.strip() for name in names if name.strip()]
        if len(set(self.cameras)) < len(self.cameras):
            raise BadValue(f"robot.cameras names a camera twice: {', '.join(self.cameras)}")
        self.make_simulation_config()
        watch_rollouts(XopRobotConfig)

    @property
    def scene(self) -> str:
        """Name of the scene.

        Raises:
            UnknownName: If there is no such task, listing the known ones.
        """
        if self.sim.scene or not self.task:
            return self.sim.scene or "empty"
        return get_task(self.task).choose_scene(make_morphology(self.morphology))

    def make_simulation_config(self) -> SimulationConfig:
        """Make the configuration of the simulated plant.

        Raises:
            BadValue: If a size or the seed is out of its range.
            UnknownName: If there is no such noise, listing the known ones.
        """
        return SimulationConfig(
            scene=self.scene,
            noise=self.sim.noise,
            sensors=self.sim.sensors,
            seed=self.seed,
            width=self.width,
            height=self.height,
            viewer=self.viewer,
            viewer_port=self.sim.viewer_port,
        )


@RobotConfig.register_subclass("xop_g1")
@dataclass(kw_only=True)
class XopG1Config(XopRobotConfig):
    """Unitree G1 with 29 joints."""

    morphology: ClassVar[str] = "g1"


@RobotConfig.register_subclass("xop_rby1")
@dataclass(kw_only=True)
class XopRby1Config(XopRobotConfig):
    """Rainbow Robotics RB-Y1 on two wheels."""

    morphology: ClassVar[str] = "rby1"


@RobotConfig.register_subclass("xop_rby1m")
@dataclass(kw_only=True)
class XopRby1MConfig(XopRobotConfig):
    """Rainbow Robotics RB-Y1 M on four mecanum wheels."""

    morphology: ClassVar[str] = "rby1m"
