"""Closed-loop tracking runs: a scenario's goals drive a robot in lock-step, with errors of truth.

The loop contains all of teleoperation (state synchronisation, retargeter, arm kinematics, limits)
except a person and the alignment. Goals are given in the world frame, so that errors exclude the
robot's error of its own pose when it was engaged.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from time import perf_counter
from typing import Any

import mujoco
import numpy as np

from benchmarks.tracking_metrics import (
    Trajectory,
    compute_errors,
    compute_metrics,
)
from benchmarks.tracking_scenarios import SCENARIOS, GoalTrack, Scenario
from benchmarks.tracking_setup import (
    TrackingSetup,
    compute_physics_steps,
    get_ablation,
    make_retargeter_config,
    make_tuned_morphology,
    resolve_configs,
)
from xop_lerobot.core.errors import UnknownName
from xop_lerobot.core.state import FRAMES
from xop_lerobot.core.transforms import (
    level_pose,
    make_pose,
    pose_inverse,
    pose_multiply,
)
from xop_lerobot.evaluation.trial import TraceRows, closed_loop
from xop_lerobot.evaluation.trial_metrics import compute_feet
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.operator.alignment import Alignment, AlignmentConfig
from xop_lerobot.operator.device import Device
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.plant.config import SimulationConfig
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.plant.simulation import Simulation
from xop_lerobot.retarget.model.kinematics import SiteKinematics
from xop_lerobot.session import Tick
from xop_lerobot.teleoperation import Teleoperation, TeleoperationConfig

TRACE_DT = 0.2
"""Sample time of a run's trace [s]."""
OPEN_PINCH = 0.1
"""Distance between thumb and index tip of an open hand [m]."""
SETTLE_S, LOADED_SETTLE_S = 1.0, 3.0
"""Time in which a robot settles before a scenario begins, without and with a payload [s]."""


class GoalDevice(Device):
    """An operator whose head and hands are the goals themselves, in the world frame.

    Args:
        scenario: The scenario.
        track: Its goals.
        wrists: Initial poses of the wrists by name, in the world. Shapes (7,).
    """

    self_engaging = True

    def __init__(
        self, scenario: Scenario, track: GoalTrack, wrists: Mapping[str, np.ndarray]
    ) -> None:
        self.start_mode = scenario.mode
        self.track = track
        home = pose_inverse(level_pose(track.home))
        self._from_head = {name: pose_multiply(home, pose) for name, pose in wrists.items()}
        self._start: float | None = None

    def start(self, time: float) -> None:
        """Start the track's clock."""
        self._start = time

    def clock(self, time: float) -> float:
        """Convert the robot's `time` to the track's clock; 0 before the start [s]."""
        return 0.0 if self._start is None else time - self._start

    def read(self, time: float) -> OperatorFrame:
        """Return the goals at `time` [s] as an operator frame."""
        clock = self.clock(time)
        head = self.track.head_at(clock)
        return OperatorFrame(
            time=clock,
            head=head,
            left_wrist=self._compute_wrist("left_wrist", head, clock),
            right_wrist=self._compute_wrist("right_wrist", head, clock),
            pinch=np.full(2, OPEN_PINCH),
            mode=self.start_mode,
        )

    def _compute_wrist(self, name: str, head: np.ndarray, clock: float) -> np.ndarray:
        """Compute a wrist's pose, which follows the head's position and heading. Shape (7,)."""
        wrist = self._from_head[name]
        reach = self.track.reach
        if reach is not None and clock >= self.track.reach_start:
            side = 1.0 if name == "left_wrist" else -1.0
            wrist = make_pose(reach * np.array([1, side, 1]), wrist[3:])
        return pose_multiply(level_pose(head), wrist)


class WorldAlignment(Alignment):
    """The identity alignment: the operator's poses are goals in the world frame."""

    def __init__(self) -> None:
        super().__init__(AlignmentConfig(height_scale=1.0, reach_scale=1.0))
        self._engaged = False

    @property
    def is_engaged(self) -> bool:
        """Whether goals are given."""
        return self._engaged

    def engage(
        self,
        frame: OperatorFrame,
        robot_frames: Mapping[str, np.ndarray],
        robot_head_height: float,
        robot_reach: float | None = None,
    ) -> None:
        """Engage; the arguments are not used."""
        del frame, robot_frames, robot_head_height, robot_reach
        self._engaged = True

    def disengage(self) -> None:
        """Disengage."""
        self._engaged = False

    def goal_poses(self, frame: OperatorFrame) -> dict[str, np.ndarray]:
        """Return the operator's poses as goals, by frame. Shapes (7,)."""
        return {name: frame.pose(name).copy() for name in FRAMES}


def locate_frames(morphology: Morphology, qpos: np.ndarray) -> dict[str, np.ndarray]:
    """Compute the world poses of the tracked frames by name. Shape (..., nq) -> (..., 7) each."""
    model = build_model(morphology, "planning")
    poses = SiteKinematics(model, tuple(morphology.frames.values())).compute_poses(qpos)
    return {name: poses[site] for name, site in morphology.frames.items()}


def get_scenario(name: str) -> Scenario:
    """Return the scenario `name`.

    Raises:
        UnknownName: Listing the known ones.
    """
    if name not in SCENARIOS:
        raise UnknownName("scenario", name, SCENARIOS)
    return SCENARIOS[name]


def make_loaded_model(morphology: Morphology, setup: TrackingSetup, scene: str) -> mujoco.MjModel:
    """Make the plant's model, with the setup's payload in each hand."""
    model = build_model(morphology, "full", scene=scene)
    if setup.payload:
        for name in FRAMES[1:]:
            # The payload has the shape of the hand: its inertia grows in proportion to its mass.
            hand = int(model.site(morphology.frames[name]).bodyid[0])
            mass = model.body_mass[hand]
            model.body_inertia[hand] *= (mass + setup.payload) / mass
            model.body_mass[hand] = mass + setup.payload
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def run_scenario(setup: TrackingSetup, seed: int) -> tuple[GoalTrack, Trajectory]:
    """Run one scenario in lock-step.

    Args:
        setup: What to run.
        seed: Seed of sensors, samples and random goals.

    Returns:
        The goals and the true trajectory.

    Raises:
        UnknownName: If the setup names an unknown scenario, robot or ablation.
    """
    with get_ablation(setup.ablation).replace():
        return _run_scenario(setup, seed)


def _run_scenario(setup: TrackingSetup, seed: int) -> tuple[GoalTrack, Trajectory]:
    scenario = get_scenario(setup.scenario)
    morphology = make_tuned_morphology(setup)
    config = SimulationConfig(scene=scenario.scene, noise=setup.resolved_noise, seed=seed)
    plant = Simulation(morphology, config, model=make_loaded_model(morphology, setup, config.scene))
    teleoperated = TeleoperationConfig(retargeter=make_retargeter_config(setup, seed))
    policy = (setup.low_level, setup.low_level_path)
    with closed_loop(plant, teleoperated, *policy, fps=setup.fps, seed=seed) as pair:
        loop, teleoperation = pair
        # An unexpected payload makes a robot sink and lean until it has found its balance.
        loop.reset(seed, settle_s=LOADED_SETTLE_S if setup.payload else SETTLE_S)
        frames = locate_frames(morphology, loop.state.true_qpos)
        home = level_pose(frames["head"])
        rng = np.random.default_rng((seed, 7))
        track = scenario.build(home, rng, setup.hold, setup.goals)
        wrists = {name: frames[name] for name in FRAMES[1:]}
        teleoperation.device = GoalDevice(scenario, track, wrists)
        teleoperation.alignment = WorldAlignment()
        teleoperation.reset()
        return track, _drive(loop, teleoperation, track)


def _drive(loop: PolicyLoop, teleoperation: Teleoperation, track: GoalTrack) -> Trajectory:
    """Run the loop for the duration of the track, and record the true trajectory."""
    rows, contacts = TraceRows(), set[tuple[str, str]]()
    device, dt = teleoperation.device, teleoperation.dt
    assert isinstance(device, GoalDevice)
    clocks = []
    while (clock := device.clock(loop.state.time)) < track.duration - dt / 2:
        state = loop.state
        action, tick = teleoperation.step(Tick(state))
        if tick.goal is not None or clock > 0:
            rows.add(tick, action.command)
            clocks.append(clock)
        if state.fallen:
            break
        loop.execute(action, dt)
        contacts.update(loop.plant.measure().contacts)
    trace = rows.make_trace()
    frames = locate_frames(loop.morphology, trace.qpos)
    goal = trace.goals["head"]
    for tick in np.flatnonzero(np.isnan(goal[:, 0])):  # disengaged, but errors still count
        goal[tick] = track.head_at(clocks[tick])
    offsets = [trace.goals[name][:, :3] - frames[name][:, :3] for name in FRAMES[1:]]
    return Trajectory(
        time=np.array(clocks),
        head=frames["head"],
        goal=goal,
        base=trace.qpos[:, :7],
        command=trace.command,
        feet=compute_feet(loop.morphology, trace.qpos),
        hands=np.linalg.norm(offsets, axis=-1).T,
        contacts=tuple(sorted(contacts)),
        **{
            name: getattr(trace, name)
            for name in ("fallen", "collision", "solve_s", "failed", "intervened")
        },
    )


def run_trial(setup: TrackingSetup, seed: int) -> dict[str, Any]:
    """Run one scenario and compute its metrics.

    Returns:
        The record of the run, see `make_record`.
    """
    start = perf_counter()
    track, trajectory = run_scenario(setup, seed)
    return make_record(setup, seed, track, trajectory, perf_counter() - start)


def make_record(
    setup: TrackingSetup, seed: int, track: GoalTrack, trajectory: Trajectory, wall_s: float
) -> dict[str, Any]:
    """Make the JSON record of a run.

    Returns:
        ``setup``, ``seed``, ``metrics``, ``samples``, ``horizon``, ``control_hz``,
        ``physics_steps_per_s``, ``contacts``, ``wall_s`` and more. Metrics that are not finite,
        as the time of an arrival that never happened, are None.
    """
    scenario = get_scenario(setup.scenario)
    metrics = compute_metrics(track, trajectory, scenario.get_tolerance(setup.robot))
    config = resolve_configs(setup)[scenario.mode]
    retargeter = make_retargeter_config(setup, seed)
    return {
        "robot": setup.robot,
        "scenario": setup.scenario,
        "ablation": setup.ablation,
        "noise": setup.resolved_noise,
        "retargeter": retargeter.type,
        "sync": retargeter.sync,
        "preset": get_ablation(setup.ablation).preset or setup.preset,
        "seed": seed,
        "setup": dataclasses.asdict(setup),
        "hold": setup.hold,
        "samples": config.num_samples,
        "horizon": config.horizon,
        "control_hz": config.control_hz,
        "physics_steps_per_s": compute_physics_steps(config, SimulationConfig().time_step),
        "sim_s": float(trajectory.time[-1]),
        "wall_s": round(wall_s, 1),
        "contacts": [" - ".join(pair) for pair in trajectory.contacts],
        "trace": make_trace(track, trajectory),
        "metrics": {
            name: value if math.isfinite(value) else None for name, value in metrics.items()
        },
    }


def make_trace(track: GoalTrack, trajectory: Trajectory) -> dict[str, Any]:
    """Sample the instantaneous position error every `TRACE_DT`, for plots.

    Returns:
        ``dt`` [s], ``position_cm``, and ``limits``: when each goal should be reached [s].
    """
    errors = compute_errors(trajectory, [step.start for step in track.steps])
    times = np.arange(0, trajectory.time[-1] + 1e-9, TRACE_DT)
    position = np.interp(times, trajectory.time, errors.position) * 100
    limits = [step.start + step.limit_s for step in track.steps]
    return {
        "dt": TRACE_DT,
        "position_cm": [round(float(value), 2) for value in position],
        "limits": [round(limit, 2) for limit in limits],
    }
