"""One closed-loop trial: a simulated person performs a task with a robot, in lock-step.

The loop contains all of teleoperation, from the person's eyes to the motors, like LeRobot's own
loop but without LeRobot: it never waits and records nothing, and equal seeds give equal trials.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from xop_lerobot.core.state import FRAMES
from xop_lerobot.evaluation.methods import make_retargeter_config, resolve_low_level
from xop_lerobot.low_level.factory import make_policy, resolve_policy
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.operator.devices import DeviceConfig
from xop_lerobot.operator.display import View
from xop_lerobot.plant.config import SimulationConfig
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.plant.simulation import Simulation
from xop_lerobot.retarget.plan import Status
from xop_lerobot.session import RobotInfo, TaskStatus, Tick
from xop_lerobot.tasks.task import TASKS, make_task
from xop_lerobot.teleoperation import Teleoperation, TeleoperationConfig

if TYPE_CHECKING:
    from xop_lerobot.tasks.stage import Stage

FILM_HZ = 25
"""Highest rate of recorded positions [Hz]."""


@dataclass(frozen=True)
class TrialSetup:
    """Setup of a trial, except for the seed.

    Attributes:
        robot: Name of the robot.
        task: Name of the task.
        method: Name of the method.
        variant: Variant of the method; see `parse_variant`.
        low_level: Low-level policy; empty for the robot's own.
        low_level_path: Its file; empty for its default.
        noise: Preset of the sensor noise.
        scene: Scene; empty for the task's own.
        heights: Heights that override the task's defaults; see `Task.choose_heights`.
        fps: Rate of the control loop [Hz].
        time_limit: Time after which the trial ends [s]; 0 for the task's own limit. Beyond the
            task's own it has failed, and only its completion time is still measured.
    """

    robot: str
    task: str
    method: str = "mpc"
    variant: str = ""
    low_level: str = ""
    low_level_path: str = ""
    noise: str = "mild"
    scene: str = ""
    fps: int = 25
    time_limit: float = 0.0
    heights: str = ""

    @property
    def place(self) -> str:
        """The task, with its heights if not the default."""
        return f"{self.task} {self.heights}".strip()

    @property
    def goes_beyond(self) -> bool:
        """Whether the trial goes on beyond its task's time limit."""
        return self.time_limit > TASKS[self.task].time_limit

    @property
    def resolved(self) -> TrialSetup:
        """Copy with the defaults of empty names filled in.

        Raises:
            UnknownName: If a name is unknown, listing the known ones.
            BadValue: If the variant contradicts itself or the method, or the heights are out of
                the robot's reach.
        """
        morphology = make_morphology(self.robot)
        make_retargeter_config(morphology, self.method, self.variant)
        task = make_task(self.task, morphology, self.heights)
        return dataclasses.replace(
            self,
            low_level=resolve_low_level(morphology, self.method, self.low_level),
            scene=self.scene or task.choose_scene(task.morphology),
        )


@dataclass(frozen=True)
class Trace:
    """True trajectory of a trial, with n control steps (ticks).

    Attributes:
        time: Robot clock [s]. Shape (n,).
        engaged: Whether the person is engaged. Shape (n,), bool.
        mode: Mode of the robot. Shape (n,).
        qpos: Generalised position of the robot. Shape (n, nq).
        qvel: Generalised velocity. Shape (n, nv).
        effort: Actuator forces [N m or N]. Shape (n, nu).
        command: Command executed from this tick on. Shape (n, k).
        frames: Poses of head, wrists and palms. Shapes (n, 7).
        goals: Goals of head and wrists, nan if there are none. Shapes (n, 7).
        objects: Poses of the task's objects. Shapes (n, 7).
        fallen: Whether the robot has fallen. Shape (n,), bool.
        collision: Whether it touched anything but the ground during the tick. Shape (n,), bool.
        solve_s: Duration of each solve of the retargeter [s]. Shape (m,).
        failed: Whether no sample of the solve had finite cost. Shape (m,), bool.
        intervened: Whether the retargeter slowed or vetoed the plan. Shape (m,), bool.
    """

    time: np.ndarray
    engaged: np.ndarray
    mode: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    effort: np.ndarray
    command: np.ndarray
    frames: Mapping[str, np.ndarray]
    goals: Mapping[str, np.ndarray]
    objects: Mapping[str, np.ndarray]
    fallen: np.ndarray
    collision: np.ndarray
    solve_s: np.ndarray
    failed: np.ndarray
    intervened: np.ndarray


@dataclass(frozen=True)
class Film:
    """Recorded positions of the whole scene, from which images are rendered later.

    Attributes:
        fps: Frame rate [Hz].
        qpos: Positions of robot and objects. Shape (p, nq of the scene), float32.
        mocap_pos: Positions of the furniture. Shape (p, m, 3), float32.
        mocap_quat: Orientations of the furniture, wxyz. Shape (p, m, 4), float32.
    """

    fps: int
    qpos: np.ndarray
    mocap_pos: np.ndarray
    mocap_quat: np.ndarray


@dataclass(frozen=True)
class Trial:
    """Result of one trial.

    Attributes:
        setup: Setup, with resolved names.
        seed: Seed of placement, person, sensors and samples.
        status: Final status of the task, within its time limit.
        completion_s: Time from the first engagement to success, also to one that comes after the
            task's time limit; nan without any [s].
        sim_s: Simulated duration after settling [s].
        wall_s: Computing time on this machine [s].
        fallen: Whether the robot fell within the task's time limit.
        trace: Trajectory within the task's time limit.
        film: Positions for rendering, to the end.
    """

    setup: TrialSetup
    seed: int
    status: TaskStatus
    completion_s: float
    sim_s: float
    wall_s: float
    fallen: bool
    trace: Trace
    film: Film

    @property
    def dt(self) -> float:
        """Control period [s]."""
        return 1 / self.setup.fps


@dataclass
class TraceRows:
    """Collects the ticks of a closed loop."""

    ticks: list[dict[str, Any]] = field(default_factory=list)
    solves: list[tuple[float, bool, bool]] = field(default_factory=list)

    def add(self, tick: Tick, command: np.ndarray) -> None:
        """Add one tick; without a view, the trace has no frames and objects.

        Args:
            tick: The tick, after the decision.
            command: Its command after limits. Shape (k,).
        """
        state, view = tick.state, tick.view
        goals = tick.goal.poses if tick.goal is not None else {}
        nothing = np.full(7, np.nan)
        self.ticks.append(
            {
                "time": state.time,
                "engaged": tick.engaged,
                "mode": int(state.mode),
                "qpos": state.true_qpos,
                "qvel": state.true_qvel,
                "effort": state.effort,
                "command": command,
                "frames": {} if view is None else dict(view.frames),
                "goals": {name: goals.get(name, nothing) for name in FRAMES},
                "objects": {} if view is None else {n: o.pose for n, o in view.objects.items()},
                "fallen": state.fallen,
                "collision": state.collision,
            }
        )
        health = tick.health
        if tick.engaged and health.get("plan_age", np.inf) == 0:
            failed, intervened = health.get("status", Status.OK), health.get("intervention", 0)
            self.solves.append((health.get("solve_time", 0.0), failed != Status.OK, intervened > 0))

    def make_trace(self) -> Trace:
        """Stack the ticks into arrays."""
        columns: dict[str, Any] = {}
        for name, first in self.ticks[0].items():
            values = [tick[name] for tick in self.ticks]
            if isinstance(first, dict):
                columns[name] = {
                    key: np.array([value[key] for value in values], float) for key in first
                }
            else:
                columns[name] = np.array(values)
        solves = np.array(self.solves, float).reshape(-1, 3).T
        return Trace(**columns, solve_s=solves[0], failed=solves[1] > 0, intervened=solves[2] > 0)


class _Filming:
    """Records the positions of the whole scene, at most at `FILM_HZ`."""

    def __init__(self, stage: Stage, fps: int) -> None:
        self._data = stage.plant.data
        self._every = max(1, fps // FILM_HZ)
        self.fps = fps // self._every
        self._count = 0
        self._rows: list[tuple[np.ndarray, ...]] = []

    def note(self) -> None:
        """Record the positions, if due."""
        if self._count % self._every == 0:
            data = self._data
            self._rows.append(
                tuple(
                    np.array(each, np.float32)
                    for each in (data.qpos, data.mocap_pos, data.mocap_quat)
                )
            )
        self._count += 1

    def make_film(self) -> Film:
        """Stack the positions into arrays."""
        return Film(self.fps, *(np.stack(column) for column in zip(*self._rows, strict=True)))


def make_stage(setup: TrialSetup, seed: int) -> Stage:
    """Build robot, scene and task of a resolved `setup`."""
    from xop_lerobot.tasks.stage import Stage  # noqa: PLC0415

    config = SimulationConfig(scene=setup.scene, noise=setup.noise, seed=seed)
    morphology = make_morphology(setup.robot)
    return Stage(morphology, setup.task, config, setup.heights, setup.time_limit)


@contextmanager
def closed_loop(
    plant: Simulation,
    config: TeleoperationConfig,
    low_level: str = "",
    low_level_path: str = "",
    *,
    fps: int = 25,
    seed: int = 0,
    realtime: bool = False,
) -> Iterator[tuple[PolicyLoop, Teleoperation]]:
    """Yield a policy loop and the teleoperation that drives it.

    One tick is `Teleoperation.step`, then `PolicyLoop.execute`.
    """
    morphology, path = plant.morphology, low_level_path or None
    name, scene = resolve_policy(morphology, low_level), plant.config.scene
    info = RobotInfo(morphology.name, morphology, name, path, scene, fps, seed, realtime)
    loop = PolicyLoop(morphology, plant, make_policy(name, path))
    teleoperation = Teleoperation(config, info)
    try:
        yield loop, teleoperation
    finally:
        teleoperation.disconnect()
        loop.close()


def run_trial(
    setup: TrialSetup,
    seed: int,
    watch: Callable[[Stage, View, Tick], None] | None = None,
) -> Trial:
    """Run one trial.

    Args:
        setup: Its setup.
        seed: Seed of placement, person, sensors and samples.
        watch: Called once per tick, before the simulation advances; for rendering and debugging.

    Raises:
        UnknownName: If a name in `setup` is unknown.
        PolicyFileError: If the low-level policy's file is missing.
    """
    begin = perf_counter()
    setup = setup.resolved
    stage = make_stage(setup, seed)
    config = TeleoperationConfig(
        device=DeviceConfig(type="simulated", seed=seed),
        retargeter=make_retargeter_config(
            stage.plant.morphology, setup.method, setup.variant, seed
        ),
    )
    policy = (setup.low_level, setup.low_level_path)
    with closed_loop(stage.plant, config, *policy, fps=setup.fps, seed=seed) as pair:
        loop, teleoperation = pair
        teleoperation.connect()
        loop.reset(seed, start=stage.start)
        stage.reset(seed)
        teleoperation.reset(stage.obstacles)
        return _drive(setup, seed, stage, loop, teleoperation, begin, watch)


def _drive(
    setup: TrialSetup,
    seed: int,
    stage: Stage,
    loop: PolicyLoop,
    teleoperation: Teleoperation,
    begin: float,
    watch: Callable[[Stage, View, Tick], None] | None,
) -> Trial:
    """Run the closed loop until the task is over.

    Beyond the task's time limit only the completion time is measured.
    """
    rows, filming = TraceRows(), _Filming(stage, setup.fps)
    dt, start = 1 / setup.fps, loop.state.time
    limit = TASKS[setup.task].time_limit
    status, fallen, in_time = stage.status, False, True
    engaged_at = succeeded_at = float("nan")
    while True:
        state = loop.state
        view = stage.view(state)
        action, tick = teleoperation.step(Tick(state, view=view))
        if tick.engaged and np.isnan(engaged_at):
            engaged_at = state.time
        if in_time:
            rows.add(tick, action.command)
        filming.note()
        if watch is not None:
            watch(stage, view, tick)
        loop.execute(action, dt)
        now = stage.update()
        if now.success and np.isnan(succeeded_at):
            succeeded_at = loop.state.time
        gave_up = teleoperation.device.is_finished(loop.state.time) and not now.success
        if gave_up and not now.failure:
            now = dataclasses.replace(now, failure="the person gave up")
        if in_time:
            status, fallen = now, loop.state.fallen
            in_time = now.success or loop.state.time - start < limit - dt / 2
        if now.done or gave_up:
            break
    return Trial(
        setup=setup,
        seed=seed,
        status=status,
        completion_s=succeeded_at - engaged_at,
        sim_s=loop.state.time - start,
        wall_s=perf_counter() - begin,
        fallen=fallen,
        trace=rows.make_trace(),
        film=filming.make_film(),
    )
