"""`xop-bench`: time of one step of the model predictive controller, and of its parts.

    xop-bench --robot g1 --mode mobile --samples 30 --horizon 3 --threads 2 --json bench.json
    xop-bench --robot rby1 --mode stationary --profile

A robot follows a moving goal in lock-step, with sensor noise. Every solve is timed in full (state
synchronisation and plan). Right after it, the same number of physics steps is rolled out by one
bare call of `mujoco.rollout`, with the same model, start state, controls and threads, so that
anything that slows the machine affects both.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np

from xop_lerobot.core.command import Mode, RobotAction
from xop_lerobot.core.command_line import CommandParser, format_table, make_output_readable
from xop_lerobot.core.errors import BadValue, UnknownName, XopError
from xop_lerobot.core.state import Goal, RobotState
from xop_lerobot.core.transforms import (
    compute_heading,
    make_pose,
    quat_from_rpy,
    quat_from_yaw,
    quat_multiply,
    quat_rotate,
)
from xop_lerobot.evaluation.bench_report import KEYS, describe_machine, summarise
from xop_lerobot.evaluation.trial import closed_loop
from xop_lerobot.low_level.policy import POLICY_DT
from xop_lerobot.morphology.morphology import make_morphology, read_robot, say_robots
from xop_lerobot.operator.goal import GoalVelocity
from xop_lerobot.plant.config import NOISE_PRESETS, SimulationConfig
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.plant.simulation import Simulation
from xop_lerobot.retarget.config import PRESETS, RetargeterConfig
from xop_lerobot.retarget.model.kinematics import SiteKinematics
from xop_lerobot.retarget.mpc import MpcRetargeter
from xop_lerobot.retarget.rollout import PolicyRollout
from xop_lerobot.retarget.sync.state_sync import StateSync
from xop_lerobot.teleoperation import TeleoperationConfig

LEAD_IN_S = 1.0
"""Time for which the goal stays at the initial pose [s]."""
CURVE_SPEED = 0.3
"""Speed of the moving goal [m/s]."""
CURVE_TURN = 0.3
"""Largest turn rate of the moving goal [rad/s], a radius of 1 m."""
CURVE_PERIOD = 16.0
"""Period of the moving goal's left and right turns [s]."""
CURVE_S = 20.0
"""Duration of the moving goal's path [s]."""
WAIST = np.array([-0.05, 0.0, -0.42])
"""Position of a person's waist relative to the head, in the heading frame [m]; bends pivot
there."""


@dataclass(frozen=True)
class BenchConfig:
    """Configuration of a benchmark.

    Attributes:
        robot: Name of the robot.
        mode: Mode of the robot.
        samples: Rollouts per solve; 0 for the preset's.
        horizon: Length of a rollout in control steps of 20 ms; 0 for the preset's.
        threads: Physics threads; 0 for one per core.
        steps: Number of timed solves.
        warmup: Number of untimed solves before them.
        preset: Preset of the retargeter.
        low_level: Low-level policy; empty for the robot's own.
        low_level_path: Its file; empty for its default.
        scene: Scene; its static boxes are obstacles.
        noise: Preset of the sensor noise.
        seed: Seed of sensors and samples.
    """

    robot: str
    mode: Mode
    samples: int = 0
    horizon: int = 0
    threads: int = 0
    steps: int = 200
    warmup: int = 20
    preset: str = "default"
    low_level: str = ""
    low_level_path: str = ""
    scene: str = "empty"
    noise: str = "mild"
    seed: int = 0

    def __post_init__(self) -> None:
        for name, low in (("samples", 0), ("horizon", 0), ("threads", 0), ("steps", 1)):
            if getattr(self, name) < low:
                raise BadValue(f"{name} must be at least {low}, got {getattr(self, name)}")


class BareRollout:
    """Lower bound: one call of `mujoco.rollout` for all physics steps of a solve.

    It records the policy outputs of a `PolicyRollout` as controls.

    Args:
        rollout: Rollout of the planner.
        num_threads: Number of threads, as the planner's.
    """

    def __init__(self, rollout: PolicyRollout, num_threads: int) -> None:
        self.model, self.substeps = rollout.model, rollout.substeps
        self._pool = mujoco.rollout.Rollout(nthread=num_threads if num_threads > 1 else 0)
        self._data = [mujoco.MjData(self.model) for _ in range(max(num_threads, 1))]
        self._targets: list[np.ndarray] = []
        act = rollout.policy.act

        def listen(*arguments: Any, **named: Any) -> Any:
            output = act(*arguments, **named)
            self._targets.append(output.targets)
            return output

        # Wrap `act` of this instance only; other policies and methods stay unchanged.
        vars(rollout.policy)["act"] = listen

    def forget(self) -> None:
        """Discard the record of the last solve."""
        self._targets.clear()

    def run(self, state: RobotState, num_samples: int, horizon: int) -> float:
        """Repeat the rollouts of the last solve from `state`; return the time [s].

        Raises:
            BadValue: If the planner did not call its policy once per control step.
        """
        asked = self._targets
        # With ramped targets the policy is called once more, with one sample: for the command that
        # the ramp starts from.
        ramps = len(asked) == horizon + 1 and asked[0].shape == (1, self.model.nu)
        begins = [np.repeat(asked[0], num_samples, axis=0), *asked[1:-1]] if ramps else asked
        asked = asked[1:] if ramps else asked
        shapes = [targets.shape for targets in asked]
        if shapes != [(num_samples, self.model.nu)] * horizon:
            raise BadValue(
                f"a solve of {num_samples} samples and {horizon} steps must ask the policy "
                f"{horizon} times for {num_samples} x {self.model.nu} targets, "
                f"it asked for {shapes}"
            )
        model = self.model
        start = np.zeros((num_samples, 1 + model.nq + model.nv + model.na))
        start[:, 1 : 1 + model.nq] = state.qpos
        start[:, 1 + model.nq : 1 + model.nq + model.nv] = state.qvel
        controls = np.repeat(np.stack(asked, axis=1), self.substeps, axis=1)
        if ramps:
            first = np.repeat(np.stack(begins, axis=1), self.substeps, axis=1)
            shares = np.tile(np.arange(1, self.substeps + 1) / self.substeps, horizon)
            controls = first + shares[:, None] * (controls - first)
        out = np.empty((num_samples, controls.shape[1], start.shape[1]))
        begin = perf_counter()
        self._pool.rollout(model, self._data, start, controls, state=out)
        return perf_counter() - begin

    def close(self) -> None:
        """Stop the threads."""
        self._pool.close()


def run_bench(config: BenchConfig) -> dict[str, Any]:
    """Time the solves of a robot that follows a moving goal.

    Returns:
        The metrics of `KEYS`, the settings, the machine, and ``profile``: median time by part.

    Raises:
        UnknownName: If a name in `config` is unknown.
    """
    morphology = make_morphology(config.robot)
    settings = RetargeterConfig(
        num_samples=config.samples,
        horizon=config.horizon,
        threads=config.threads,
        preset=config.preset,
        seed=config.seed,
    )
    sensors = SimulationConfig(scene=config.scene, noise=config.noise, seed=config.seed)
    plant, policy = Simulation(morphology, sensors), (config.low_level, config.low_level_path)
    teleoperated = TeleoperationConfig(retargeter=settings)
    with closed_loop(plant, teleoperated, *policy, fps=50, seed=config.seed) as pair:
        loop, teleoperation = pair
        retargeter = teleoperation.retargeter
        assert isinstance(retargeter, MpcRetargeter)
        with closing(BareRollout(retargeter.rollout, settings.num_threads)) as bare:
            loop.reset(config.seed)
            sync = StateSync(morphology, retargeter.rollout.model)
            rows = _time_solves(config, loop, retargeter, sync, bare)
    used = retargeter.configs[config.mode]
    return {
        **summarise(rows),
        "robot": config.robot,
        "mode": config.mode.name.lower(),
        "samples": used.num_samples,
        "horizon": used.horizon,
        "threads": settings.num_threads,
        "wanted_hz": used.control_hz,
        "physics_steps": used.num_samples * used.horizon * retargeter.rollout.substeps,
        "low_level": teleoperation.info.low_level,
        "preset": config.preset,
        "scene": config.scene,
        "noise": config.noise,
        "seed": config.seed,
        "steps": config.steps,
        "omp_num_threads": os.environ.get("OMP_NUM_THREADS", ""),
        "machine": describe_machine(),
    }


def _time_solves(
    config: BenchConfig,
    loop: PolicyLoop,
    retargeter: MpcRetargeter,
    sync: StateSync,
    bare: BareRollout,
) -> list[dict[str, float]]:
    """Repeat solve, bare rollout and robot step; returns times [s]."""
    mode, used = config.mode, retargeter.configs[config.mode]
    period = max(1, round(1 / used.control_hz / POLICY_DT)) * POLICY_DT
    site = retargeter.morphology.frames["head"]
    kinematics = SiteKinematics(retargeter.rollout.model, (site,))
    home = kinematics.compute_poses(loop.state.true_qpos)[site]
    curve, velocity, begin = make_curve(home), GoalVelocity(), loop.state.time
    retargeter.reset(loop.state)
    rows = []
    for index in range(config.warmup + config.steps):
        state = loop.state
        elapsed = state.time - begin
        head = curve(elapsed) if mode is Mode.MOBILE else _sway(home, elapsed)
        goals = {"head": head}
        goal = Goal(goals, velocity.update(state.time, goals), mode)
        bare.forget()
        start = perf_counter()
        synced = sync.synchronise(state.time, state.qpos, state.qvel, mode)
        state = dataclasses.replace(state, qpos=synced.qpos, qvel=synced.qvel)
        middle = perf_counter()
        plan = retargeter.plan(state, goal)
        end = perf_counter()
        times = {"step": end - start, "sync": middle - start, **plan.timings}
        times["bare"] = bare.run(state, used.num_samples, used.horizon)
        if index >= config.warmup:
            rows.append(times)
        loop.execute(RobotAction(plan.command, mode, state.arms), period)
    return rows


def move_from(home: np.ndarray, offset: tuple[float, float, float], yaw: float = 0) -> np.ndarray:
    """Return the pose at `offset` [m] and `yaw` [rad] in home's heading frame. Shape (7,)."""
    heading = quat_from_yaw(compute_heading(home[3:]))
    position = home[:3] + quat_rotate(heading, np.array(offset))
    return make_pose(position, quat_multiply(quat_from_yaw(yaw), home[3:]))


def bend_from(home: np.ndarray, pitch: float = 0, yaw: float = 0) -> np.ndarray:
    """Return the head pose after bending by `pitch` and `yaw` [rad] at the waist. Shape (7,)."""
    heading = quat_from_yaw(compute_heading(home[3:]))
    back = quat_from_yaw(-compute_heading(home[3:]))
    turn = quat_multiply(quat_multiply(heading, quat_from_rpy(0, pitch, yaw)), back)
    waist = quat_rotate(heading, WAIST)
    position = home[:3] + waist - quat_rotate(turn, waist)
    return make_pose(position, quat_multiply(turn, home[3:]))


def make_curve(home: np.ndarray) -> Callable[[float], np.ndarray]:
    r"""Make a goal at 0.3 m/s whose heading is :math:`A(1 - \cos(2\pi t/T))` after the lead-in.

    A gives the largest turn rate `CURVE_TURN`; the head faces along the path.

    Args:
        home: Pose at the start. Shape (7,).

    Returns:
        Function from time [s] to pose. Shape (7,).
    """
    omega = 2 * math.pi / CURVE_PERIOD
    amplitude = CURVE_TURN / omega
    dt = 0.001
    times = np.arange(0, CURVE_S + 1, dt)
    headings = amplitude * (1 - np.cos(omega * times))
    steps = CURVE_SPEED * dt * np.stack([np.cos(headings), np.sin(headings)], axis=1)
    places = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])[:-1]

    def path(time: float) -> np.ndarray:
        since = min(max(0.0, time - LEAD_IN_S), CURVE_S)
        place = [np.interp(since, times, places[:, i]) for i in range(2)]
        heading = amplitude * (1 - math.cos(omega * since))
        return move_from(home, (float(place[0]), float(place[1]), 0.0), heading)

    return path


def _sway(home: np.ndarray, time: float) -> np.ndarray:
    """Head pose of a standing person who bends, turns and squats continuously. Shape (7,)."""
    pose = bend_from(home, pitch=0.15 * np.sin(1.1 * time), yaw=0.4 * np.sin(0.7 * time))
    down = 0.06 * (1 - np.cos(0.9 * time))
    return make_pose(pose[:3] - np.array([0, 0, down]), pose[3:])


def print_profile(figures: Mapping[str, Any]) -> None:
    """Print the time of each part of a step."""
    whole = figures["step_ms_median"]
    parts = {**figures["profile"], "step": whole}
    rows = [(name, f"{value:.2f}", f"{value / whole:.1%}") for name, value in parts.items()]
    rows.append(("bare rollout", f"{figures['rollout_ms_median']:.2f}", ""))
    print(f"\n{format_table(('part', 'ms', 'share'), rows)}")


def make_parser() -> CommandParser:
    """Make the parser of the command line."""
    parser = CommandParser("xop-bench", __doc__)
    add = parser.add_argument
    defaults = {each.name: each.default for each in dataclasses.fields(BenchConfig)}
    add("--robot", required=True, type=read_robot, help=say_robots())
    add("--mode", required=True, help="stationary or mobile")
    add("--samples", type=int, default=0, help="rollouts per solve; 0: the preset's (default: 0)")
    add("--horizon", type=int, default=0,
        help="length of a rollout [steps of 20 ms]; 0: the preset's (default: 0)")  # fmt: skip
    add("--threads", type=int, default=0, help="threads of the physics; 0: cores (default: 0)")
    for name, text in (
        ("steps", "timed solves"),
        ("warmup", "untimed solves before them"),
        ("seed", "seed of sensors and samples"),
    ):
        add(
            f"--{name}",
            type=int,
            default=defaults[name],
            help=f"{text} (default: {defaults[name]})",
        )
    for name, text in (
        ("preset", f"{', '.join(PRESETS)}"),
        ("scene", "scene, whose static boxes are obstacles"),
        ("noise", f"sensor noise: {', '.join(NOISE_PRESETS)}"),
    ):
        add(f"--{name}", default=defaults[name], help=f"{text} (default: {defaults[name]})")
    add("--low-level", default="", help="low-level policy (default: the robot's own)")
    add("--low-level-path", default="", help="file of the low-level policy (default: its own)")
    add("--json", type=Path, help="write the results as JSON; times in ms (default: none)")
    add("--profile", action="store_true", help="print the time of each part of a step")
    return parser


def parse_arguments(arguments: Sequence[str]) -> tuple[BenchConfig, argparse.Namespace]:
    """Read the command line.

    Raises:
        BadValue: If a flag is unknown, missing or malformed; an unknown one lists the known.
        UnknownName: If a mode or preset is unknown, listing the known ones.
    """
    args = make_parser().parse(arguments)
    modes = {mode.name.lower(): mode for mode in Mode}
    if args.mode not in modes:
        raise UnknownName("mode", args.mode, modes)
    names = [each.name for each in dataclasses.fields(BenchConfig)]
    values = {name: getattr(args, name) for name in names}
    return BenchConfig(**{**values, "mode": modes[args.mode]}), args


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `xop-bench`; returns the exit code."""
    make_output_readable()
    try:
        config, args = parse_arguments(sys.argv[1:] if arguments is None else arguments)
        figures = run_bench(config)
    except XopError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(
        f"{figures['robot']} {figures['mode']}, {figures['samples']} samples x "
        f"{figures['horizon']} steps, {figures['threads']} threads, "
        f"{figures['steps']} solves, seed {figures['seed']}"
    )
    for key in KEYS:
        print(f"{key:<18} {figures[key]:9.3f}")
    if args.profile:
        print_profile(figures)
    if args.json is not None:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        args.json.write_text(json.dumps(figures, indent=1, allow_nan=False) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
