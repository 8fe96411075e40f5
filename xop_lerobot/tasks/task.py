"""Interface of a task, and the registry of tasks."""

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
    """A task: furniture and objects around a robot, and a success criterion.

    `add_to` adds everything to the robot's full model, `bind` finds it in the compiled model,
    `reset` places it at random, and `update` evaluates the physics after every control step.

    Args:
        morphology: The robot; sizes and places suit its reach.
    """

    name: ClassVar[str]
    instruction: ClassVar[str]
    """Task description; LeRobot's `task` of every frame."""
    time_limit: ClassVar[float]
    """Time after which an episode is over [s]."""
    room: ClassVar[str] = "room"
    """Default scene of robots that avoid walls."""

    furniture: tuple[str, ...] = ()
    """Static bodies that the robot may collide with."""
    handled: tuple[str, ...] = ()
    """Those of `furniture` that the hands may touch."""
    close_by: tuple[str, ...] = ()
    """Those that hands must not touch but pass so closely that avoiding them is left to the
    operator."""
    ends_on_collision: ClassVar[bool] = False
    """Whether colliding with furniture or a wall fails the episode."""
    passable: tuple[str, ...] = ()
    """Geoms of `furniture` above which hands work, so the planner must not avoid them."""

    heights: Mapping[str, HeightRange] = {}
    """Heights set by the user, by name; the others are drawn from the task's defaults."""

    def __init__(self, morphology: Morphology) -> None:
        self.morphology = morphology

    @property
    def height_limits(self) -> Mapping[str, HeightRange]:
        """Allowed range of each height that a user may set, by name [m]."""
        return {}

    def choose_heights(self, text: str) -> None:
        """Override the task's default heights, from the next `reset` on.

        Args:
            text: Heights in the format of `parse_heights`.

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
        """Draw a height above the floor [m].

        Args:
            rng: Random generator; exactly one number is drawn in either case.
            name: Name of the height.
            about: Centre of the default range [m].
            spread: Lower and upper offset of the default range [m].
            margin: Margin to the ends of a range set by the user [m].
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
        """Knowledge of a practised person, by name; lengths [m]."""
        return {}

    @property
    def start_arms(self) -> Mapping[str, float]:
        """Start angles of arm joints that differ from rest [rad]."""
        return {}

    @abstractmethod
    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add furniture and objects to the model of a robot in a scene."""

    @abstractmethod
    def bind(self, plant: Simulation) -> None:
        """Find the bodies of `add_to` in the compiled model of `plant`."""

    @abstractmethod
    def reset(self, rng: np.random.Generator) -> None:
        """Place everything for a new episode, with the robot at its start.

        Args:
            rng: Random generator; equal states give equal places.
        """

    @abstractmethod
    def update(self) -> TaskStatus:
        """Return the status of the episode by the physics, once per control step."""

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
        heights: Heights that override the task's defaults; see `Task.choose_heights`.

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
    """Stopwatch that restarts whenever its condition is not met.

    Args:
        needed: Time for which the condition must be met [s].
    """

    def __init__(self, needed: float) -> None:
        self.needed = needed
        self.reset()

    def reset(self) -> None:
        """Restart."""
        self._since: float | None = None
        self.duration = 0.0

    def update(self, time: float, met: bool) -> bool:
        """Update with the condition at `time` [s]; return whether it has held long enough."""
        if not met:
            self.reset()
            return False
        if self._since is None:
            self._since = time
        self.duration = time - self._since
        # Half a physics step of tolerance for rounding in sums of 0.02 s.
        return self.duration >= self.needed - 0.0025
