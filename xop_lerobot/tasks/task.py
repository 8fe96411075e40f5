"""The interface of a task, and the registry of tasks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from xop_lerobot.core.registry import Registry
from xop_lerobot.operator.display import SeenObject
from xop_lerobot.session import TaskStatus
from xop_lerobot.tasks.heights import HeightRange, check_heights, parse_heights

if TYPE_CHECKING:
    import mujoco

    from xop_lerobot.morphology.morphology import Morphology
    from xop_lerobot.plant.simulation import Simulation


class Task(ABC):
    """A task: furniture and objects around a robot, and a criterion of success.

    `add_to` puts everything into the robot's full model, `bind` finds it again in the compiled
    one, `reset` places it at random, and `update` looks at the physics after every control step.

    Args:
        morphology: The robot that has to do it; sizes and places are made for its reach.
    """

    name: ClassVar[str]
    instruction: ClassVar[str]
    """What is to be done, in words; LeRobot's `task` of every frame."""
    time_limit: ClassVar[float]
    """Time after which an episode is over [s]."""
    room: ClassVar[str] = "room"
    """Scene, where none is asked for, of robots that keep clear of walls."""

    furniture: tuple[str, ...] = ()
    """Bodies that stand still and that a robot may run into."""
    handled: tuple[str, ...] = ()
    """Those of `furniture` that the hands may touch."""
    close_by: tuple[str, ...] = ()
    """Those that hands may not touch, but must pass so closely that the person sees to it."""
    ends_on_collision: ClassVar[bool] = False
    """Whether running into furniture or a wall loses the episode."""
    passable: tuple[str, ...] = ()
    """Geoms of `furniture` over which hands work, so that a planner must not keep clear of them."""

    heights: Mapping[str, HeightRange] = {}
    """Heights that a user asks for, by name; the others are drawn as usual."""

    def __init__(self, morphology: Morphology) -> None:
        self.morphology = morphology

    @property
    def height_limits(self) -> Mapping[str, HeightRange]:
        """Heights that a user may set, by name, with the robot's range [m]."""
        return {}

    def choose_heights(self, text: str) -> None:
        """Draw places from other heights than usual, from the next `reset` on.

        Args:
            text: As `parse_heights` reads it.

        Raises:
            UnknownName: If the task has no such height, listing those that it has.
            BadValue: If it is malformed, or out of the robot's reach.
        """
        heights = parse_heights(text)
        check_heights(heights, self.height_limits, self.name, self.morphology.name)
        self.heights = heights

    def draw_height(
        self,
        rng: np.random.Generator,
        name: str,
        about: float,
        spread: HeightRange,
        margin: float = 0.0,
    ) -> float:
        """Draw a height over the floor [m].

        Args:
            rng: Source; one number is drawn of it in either case.
            name: Of what.
            about: Height about which it usually is [m].
            spread: How far below and above it usually is [m].
            margin: Stay so far within the ends of a range that a user asks for [m].
        """
        if name in self.heights:
            low, high = self.heights[name]
            return float(rng.uniform(low + margin, high - margin))
        return about + rng.uniform(*spread)

    @classmethod
    def choose_scene(cls, morphology: Morphology) -> str:
        """Default scene for a robot."""
        return cls.room if morphology.hull_points else "empty"

    @property
    def hints(self) -> Mapping[str, float]:
        """Hints: knowledge of a practised person, by name; lengths in metres."""
        return {}

    @property
    def start_arms(self) -> Mapping[str, float]:
        """Arm joints that are not at rest at the start [rad]."""
        return {}

    @abstractmethod
    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add furniture and objects to the model of a robot in a scene."""

    @abstractmethod
    def bind(self, plant: Simulation) -> None:
        """Find what `add_to` added in the compiled model of `plant`."""

    @abstractmethod
    def reset(self, rng: np.random.Generator) -> None:
        """Place everything for a new episode, the robot at its start; same draw, same places."""

    @abstractmethod
    def update(self) -> TaskStatus:
        """Return the status of the episode from the physics, once per control step."""

    @property
    @abstractmethod
    def objects(self) -> Mapping[str, SeenObject]:
        """Visible objects of the task, by name."""


TASKS: Registry[type[Task]] = Registry(
    "task",
    {
        "box_pick_and_place": "xop_lerobot.tasks.box_pick_and_place:BoxPickAndPlace",
        "dual_point_reach": "xop_lerobot.tasks.dual_point_reach:DualPointReach",
        "dual_point_touch": "xop_lerobot.tasks.dual_point_touch:DualPointTouch",
        "non_prehensile_transport": (
            "xop_lerobot.tasks.non_prehensile_transport:NonPrehensileTransport"
        ),
    },
)


def make_task(name: str, morphology: Morphology, heights: str = "") -> Task:
    """Make the task `name` for a robot.

    Args:
        name: Name of the task.
        morphology: The robot.
        heights: Heights over the task's usual ones; see `Task.choose_heights`.

    Raises:
        UnknownName: If there is no such task or height, listing the known ones.
        BadValue: If the heights are malformed, or out of the robot's reach.
    """
    task = get_task(name)(morphology)
    task.choose_heights(heights)
    return task


def get_task(name: str) -> type[Task]:
    """Return the class of the task `name`.

    Raises:
        UnknownName: Listing the known tasks.
    """
    return TASKS[name]


class Hold:
    """A stopwatch that restarts whenever its condition is not met.

    Args:
        needed: Time for which it has to be met [s].
    """

    def __init__(self, needed: float) -> None:
        self.needed = needed
        self.reset()

    def reset(self) -> None:
        """Restart."""
        self._since: float | None = None
        self.duration = 0.0

    def update(self, time: float, met: bool) -> bool:
        """Update with the condition at `time` [s]; return whether it has held for long enough."""
        if not met:
            self.reset()
            return False
        if self._since is None:
            self._since = time
        self.duration = time - self._since
        # Half a physics step absorbs what floating point leaves of sums of 0.02.
        return self.duration >= self.needed - 0.0025
