"""Task scene: a simulated robot, a task and its furniture."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from xop_lerobot.core.command import RobotAction
from xop_lerobot.morphology.scene import build_scene_spec
from xop_lerobot.operator.display import View
from xop_lerobot.plant.config import SimulationConfig
from xop_lerobot.plant.simulation import Simulation
from xop_lerobot.retarget.obstacles import Obstacle, make_obstacles
from xop_lerobot.session import TaskStatus
from xop_lerobot.tasks.layout import add_task_camera, find_palms
from xop_lerobot.tasks.task import Task, make_task

if TYPE_CHECKING:
    from xop_lerobot.core.state import RobotState
    from xop_lerobot.morphology.morphology import Morphology

AFTER_SUCCESS_S = 1.0
"""Duration of an episode after its success [s]."""


def find_scene(task: Task, scene: str = "") -> str:
    """Return `scene`, or the task's default scene for its robot if empty."""
    return scene or task.choose_scene(task.morphology)


class Stage:
    """A plant with a task's furniture, and the task that judges it.

    The policy loop drives `plant` like any other. After each of its resets `reset` places the
    furniture, and after each control step `update` returns the task's status. An episode is over
    `AFTER_SUCCESS_S` after its success, when it has failed, when the robot has fallen, or when the
    task's time is up.

    Args:
        morphology: The robot.
        task: Name of the task.
        config: Settings of the plant. If missing, or with an empty `scene`, the task's default
            scene is used.
        heights: Heights that override the task's defaults; see `Task.choose_heights`.
        time_limit: Time after which an episode is over [s]; 0 for the task's own.

    Attributes:
        plant: The robot among the furniture.
        task: The task.
        scene: Name of the scene.
        start: Start action: the robot at rest, with the task's arm angles.

    Raises:
        UnknownName: If there is no such task, height or scene; lists the known ones.
        BadValue: If the heights are malformed, or out of the robot's reach.
    """

    def __init__(
        self,
        morphology: Morphology,
        task: str,
        config: SimulationConfig | None = None,
        heights: str = "",
        time_limit: float = 0.0,
    ) -> None:
        self.morphology, self.task = morphology, make_task(task, morphology, heights)
        self.time_limit = time_limit or self.task.time_limit
        config = config or SimulationConfig(scene="")
        self.scene = find_scene(self.task, config.scene)
        spec = build_scene_spec(morphology, "full", self.scene)
        self.task.add_to(spec)
        add_task_camera(spec)
        self.start = _make_start(morphology, self.task)
        model = spec.compile()
        self.plant = Simulation(
            morphology,
            dataclasses.replace(config, scene=self.scene),
            model=model,
            standing=_make_standing(morphology, self.task),
        )
        self.task.bind(self.plant)
        self._sites = {**morphology.frames, **find_palms(morphology, model)}
        self._hands = _find_hands(self.plant, self._sites)
        walls = {each.name for each in make_obstacles(model)}
        self._solid = walls | set(self.task.furniture)
        self.reset(config.seed)

    def reset(self, seed: int) -> None:
        """Place everything by `seed`; call it after the plant's own reset."""
        with self.plant.lock:
            self.task.reset(np.random.default_rng(np.random.SeedSequence([seed, 1])))
            self.plant.rearrange()
            self._began = self.plant.time
            self._success_time: float | None = None
            self._collisions: set[tuple[str, str]] = set()
            self.status = self._judge()

    def update(self) -> TaskStatus:
        """Update the task's status by the physics, once per control step."""
        with self.plant.lock:
            self._note_touches()
            self.status = self._judge()
        return self.status

    @property
    def time(self) -> float:
        """Time since the start of the episode [s]."""
        return self.plant.time - self._began

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """Current walls and furniture, except the task's `passable` geoms.

        Those that hands work at or pass closely are marked as handled.
        """
        with self.plant.lock:
            near = (*self.task.handled, *self.task.close_by)
            known = make_obstacles(self.plant.model, self.task.furniture, self.plant.data, near)
        return tuple(each for each in known if each.name not in self.task.passable)

    def view(self, state: RobotState) -> View:
        """What a person could see now.

        Args:
            state: Published state of the robot.
        """
        with self.plant.lock:
            frames = {name: self.plant.get_site_pose(site) for name, site in self._sites.items()}
            objects = dict(self.task.objects)
        return View(
            time=state.time,
            task=self.task.name,
            frames=frames,
            objects=objects,
            mode=state.mode,
            fallen=state.fallen,
            success=self.status.success,
            hints={**self.task.hints, **self._find_lowest()},
        )

    def _find_lowest(self) -> dict[str, float]:
        """The hint `lowest`, if heights are set: the least of them [m]."""
        lows = [low for low, _ in self.task.heights.values()]
        return {"lowest": min(lows)} if lows else {}

    def close(self) -> None:
        """Close the plant; may be called twice."""
        self.plant.close()

    def _note_touches(self) -> None:
        """Record collisions of the robot."""
        handled = set(self.task.handled)
        for part, other in self.plant.take_touches():
            if other in self._solid and not (part in self._hands and other in handled):
                self._collisions.add((part, other))

    def _judge(self) -> TaskStatus:
        """Judge the task, and decide whether the episode is over."""
        time, fallen = self.plant.time, self.plant.has_fallen
        collisions = tuple(sorted(self._collisions))
        status = dataclasses.replace(self.task.update(), collisions=collisions)
        if fallen and not status.failure:
            status = dataclasses.replace(status, failure="the robot fell")
        if collisions and self.task.ends_on_collision and not status.failure:
            failure = "the {} touched {}".format(*collisions[0])
            status = dataclasses.replace(status, failure=failure)
        failed = bool(status.failure) and self._success_time is None
        if status.success and not failed and self._success_time is None:
            self._success_time = time
        over = failed or self.time >= self.time_limit - 1e-6
        won = self._success_time
        if won is not None:
            over = time - won >= AFTER_SUCCESS_S
        return dataclasses.replace(status, success=won is not None, done=over)


def _make_start(morphology: Morphology, task: Task) -> RobotAction:
    """Rest action with the task's arm angles."""
    rest = morphology.rest_action()
    arms = rest.arms.copy()
    for name, angle in task.start_arms.items():
        arms[morphology.arm_names.index(name)] = angle
    return dataclasses.replace(rest, arms=arms)


def _make_standing(morphology: Morphology, task: Task) -> np.ndarray:
    """Standing posture with the task's arm angles. Shape (nq,)."""
    standing = morphology.standing_qpos()
    if task.start_arms:
        model = morphology.build_spec("planning").compile()
        for name, angle in task.start_arms.items():
            standing[model.joint(name).qposadr[0]] = angle
    return standing


def _find_hands(plant: Simulation, sites: dict[str, str]) -> set[str]:
    """Names of the bodies that carry the palms, and of their descendants."""
    model = plant.model
    hands = {int(model.site(sites[palm]).bodyid[0]) for palm in sites if palm.endswith("_palm")}
    for body in range(model.nbody):
        if int(model.body_parentid[body]) in hands:
            hands.add(body)
    return {model.body(body).name for body in hands}
