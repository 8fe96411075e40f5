"""Compare the planner's predictions from synchronised states with those from raw measurements.

    python -m benchmarks.run_sync --seeds 5 --duration 12 --noise mild
    python -m benchmarks.run_sync --motions stand,walk_brisk --robots g1,rby1 --noise mild,off

A robot stands, walks or drives in the simulated plant under noisy sensors. At every tick each
variant of the synchronisation gets the same measurement. At every tenth tick the planner's
prediction (planning model, low-level policy with the plant's memory) starts from each variant's
state and from the true one. Printed are the RMS differences of the predicted base displacements
after 60 and 200 ms, and the RMS errors of the states themselves.

With `--motions`, a person does them in whole teleoperation in lock-step, whose own synchronisation
is judged, from the beginning of the motion to its end.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from dataclasses import dataclass, field
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.motions import MOTIONS, START_S
from benchmarks.run_motions import MotionDevice
from xop_lerobot.core.command import Mode, RobotAction
from xop_lerobot.core.command_line import make_output_readable
from xop_lerobot.core.state import RobotState
from xop_lerobot.core.transforms import quat_yaw, wrap_angle
from xop_lerobot.evaluation.trial import closed_loop
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.morphology.morphology import Morphology, make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.plant.simulation import Simulation, SimulationConfig
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.rollout import PolicyRollout
from xop_lerobot.retarget.sync.config import SyncConfig
from xop_lerobot.retarget.sync.prior import VelocityPrior
from xop_lerobot.retarget.sync.state_sync import StateSync, Synced
from xop_lerobot.session import Tick
from xop_lerobot.teleoperation import TeleoperationConfig

TELEOPERATION = "synchronised"
"""The state that teleoperation itself starts from, with `--motions`."""
TICK = 0.04  # period of the teleoperation [s]
HORIZONS = (3, 10)  # 60 and 200 ms [control steps]
EVERY = 10  # ticks between predictions
EVERY_IN_MOTIONS = 2  # the same in motions, which are short
SETTLE_S = 2.0  # excluded start: transients of robot and filters [s]

VARIANTS = {
    "NLS": SyncConfig(recursive=False, project_velocity=False),
    "NLS, contact at z = 0": SyncConfig(recursive=False, project_velocity=False, equilibrium=False),
    "NLS + velocity": SyncConfig(recursive=False),
    "NLS + velocity + memory": SyncConfig(),
    "all, and the prediction": SyncConfig(),
}
"""Variants of the synchronisation, in addition to `raw`, the unchanged measurement."""
PREDICTED = "all, and the prediction"
"""The variant that also gets the base velocity predicted from its own last state and the executed
action, as in teleoperation."""


@dataclass(frozen=True)
class Case:
    """A robot and its motion.

    Attributes:
        robot: Name of the robot.
        mode: Mode of the command.
        command: Offsets of command entries from neutral, in their units.
    """

    robot: str
    mode: Mode
    command: dict[str, float]


CASES = {
    "g1 stands": Case("g1", Mode.STATIONARY, {}),
    "g1 squats": Case("g1", Mode.STATIONARY, {"height": -0.1, "waist_yaw": 0.3}),
    "g1 walks": Case("g1", Mode.MOBILE, {"vx": 0.4, "yaw_rate": 0.2}),
    "rby1 stands": Case("rby1", Mode.STATIONARY, {}),
    "rby1 drives": Case("rby1", Mode.MOBILE, {"v": 0.4, "yaw_rate": 0.3}),
}


@dataclass
class Errors:
    """Errors of one variant, one entry per tick or per prediction."""

    position: list[float] = field(default_factory=list)  # of the base [m]
    height: list[float] = field(default_factory=list)  # of the base [m]
    heading: list[float] = field(default_factory=list)  # [rad]
    tilt: list[float] = field(default_factory=list)  # [rad]
    velocity: list[float] = field(default_factory=list)  # of the base [m/s]
    joints: list[float] = field(default_factory=list)  # root mean square over joints [rad]
    predicted: dict[int, list[float]] = field(default_factory=lambda: {h: [] for h in HORIZONS})
    seconds: list[float] = field(default_factory=list)  # per solve [s]

    def add_state(self, state: RobotState, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Add the errors of a state (qpos, qvel) against the true one."""
        truth = state.true_qpos
        self.position.append(float(np.linalg.norm(qpos[:3] - truth[:3])))
        self.height.append(float(qpos[2] - truth[2]))
        self.heading.append(float(wrap_angle(quat_yaw(qpos[3:7]) - quat_yaw(truth[3:7]))))
        up, true_up = _compute_up(qpos[3:7]), _compute_up(truth[3:7])
        self.tilt.append(float(np.linalg.norm(up - true_up)))
        self.velocity.append(float(np.linalg.norm(qvel[:3] - state.true_qvel[:3])))
        self.joints.append(float(np.sqrt(np.mean(np.square(qpos[7:] - truth[7:])))))


def run(case: Case, noise: str, seed: int, duration: float, errors: dict[str, Errors]) -> None:
    """Run one episode of `duration` [s] and add its errors by variant."""
    morphology = make_morphology(case.robot)
    policy = make_policy(morphology.policies[0])
    model = build_model(morphology, "planning")
    loop = PolicyLoop(morphology, Simulation(morphology, SimulationConfig(noise=noise)), policy)
    loop.reset(seed)
    rollout = PolicyRollout(model, policy, 1)
    prior = VelocityPrior(morphology, policy, model, TICK)
    syncs = {name: StateSync(morphology, model, config) for name, config in VARIANTS.items()}
    states: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for tick in range(round(duration / TICK)):
        action = _make_action(morphology, case, tick * TICK)
        before = loop.state
        loop.execute(action, TICK)
        state = loop.state
        expected = None
        if tick:
            qpos, qvel = states[PREDICTED]
            prior.note(dataclasses.replace(before, qpos=qpos, qvel=qvel), loop.action)
            expected = prior.predict(state.time, before.time)
        states = {"raw": (state.qpos, state.qvel)}
        for name, sync in syncs.items():
            given = expected if name == PREDICTED else None
            start = time.perf_counter()
            synced = sync.synchronise(state.time, state.qpos, state.qvel, case.mode, given)
            errors[name].seconds.append(time.perf_counter() - start)
            states[name] = (synced.qpos, synced.qvel)
        if tick * TICK < SETTLE_S:
            continue
        for name, (qpos, qvel) in states.items():
            errors[name].add_state(state, qpos, qvel)
        if tick % EVERY == 0:
            _add_predictions(rollout, state, loop.action, states, errors)
    prior.close()
    rollout.close()
    loop.close()


def run_motion(robot: str, name: str, noise: str, seed: int, errors: dict[str, Errors]) -> None:
    """Do the motion `name` in teleoperation, and add the errors of raw and synchronised states."""
    motion, morphology = MOTIONS[name], make_morphology(robot)
    plant = Simulation(morphology, SimulationConfig(noise=noise, seed=seed))
    config = TeleoperationConfig(retargeter=RetargeterConfig(threads=1, seed=seed))
    model = build_model(morphology, "planning")
    rollout = PolicyRollout(model, make_policy(morphology.policies[0]), 1)
    synchronise, synced = StateSync.synchronise, list[Synced]()

    def watch(self: StateSync, *measurement: Any) -> Synced:
        start = time.perf_counter()
        synced.append(synchronise(self, *measurement))
        errors[TELEOPERATION].seconds.append(time.perf_counter() - start)
        return synced[-1]

    with (
        patch.object(StateSync, "synchronise", watch),
        closed_loop(plant, config, seed=seed) as (loop, teleoperation),
    ):
        teleoperation.connect()
        loop.reset(seed)
        device = teleoperation.device = MotionDevice(motion, seed)
        teleoperation.reset()
        count = 0
        while (clock := device.elapsed(loop.state.time)) < motion.end:
            state = loop.state
            action, tick = teleoperation.step(Tick(state))
            executed = loop.execute(action, teleoperation.dt)
            if not tick.engaged or clock < START_S:
                continue
            last = synced[-1]
            states = {"raw": (state.qpos, state.qvel), TELEOPERATION: (last.qpos, last.qvel)}
            for each, (qpos, qvel) in states.items():
                errors[each].add_state(state, qpos, qvel)
            if count % EVERY_IN_MOTIONS == 0:
                _add_predictions(rollout, state, executed, states, errors)
            count += 1
    rollout.close()


def _add_predictions(
    rollout: PolicyRollout,
    state: RobotState,
    action: RobotAction,
    states: dict[str, tuple[np.ndarray, np.ndarray]],
    errors: dict[str, Errors],
) -> None:
    """Add the errors of predictions from states by variant, against one from the true state."""
    true = _predict(rollout, state, action, state.true_qpos, state.true_qvel)
    for name, (qpos, qvel) in states.items():
        moved = _predict(rollout, state, action, qpos, qvel)
        for horizon in HORIZONS:
            error = float(np.linalg.norm(moved[horizon] - true[horizon]))
            errors[name].predicted[horizon].append(error)


def _make_action(morphology: Morphology, case: Case, time_s: float) -> RobotAction:
    """Return the case's command; posture entries alternate with neutral every 2 s."""
    action = morphology.rest_action()
    space = morphology.command_space
    for name, value in case.command.items():
        index = space.names.index(name)
        moves = bool(space.mobile_only[index])
        action.command[index] += value if moves or time_s % 4 < 2 else 0.0
    return RobotAction(action.command, case.mode, action.arms)


def _predict(
    rollout: PolicyRollout,
    state: RobotState,
    action: RobotAction,
    qpos: np.ndarray,
    qvel: np.ndarray,
) -> np.ndarray:
    """Predict the displacement of the base from its start [m]. Shape (H + 1, 3)."""
    commands = np.broadcast_to(action.command, (1, max(HORIZONS), len(action.command)))
    predicted = rollout.predict(qpos, qvel, state.memory, commands, action.arms, action.mode)
    return predicted.qpos[0, :, :3] - qpos[:3]


def _compute_up(quat: np.ndarray) -> np.ndarray:
    """Return the world's vertical in the body frame, a unit vector. Shape (3,)."""
    w, x, y, z = quat
    return np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else float("nan")


def print_table(title: str, errors: dict[str, Errors]) -> None:
    """Print the errors of one case, a row per variant."""
    count = len(errors["raw"].predicted[HORIZONS[0]])
    print(f"\n{title}: {count} predictions, {len(errors['raw'].position)} states; RMS")
    print(
        f"{'state given to the planner':28s} {'60 ms':>7s} {'200 ms':>7s} | {'p':>6s} {'z':>6s} "
        f"{'v':>7s} {'heading':>8s} {'tilt':>6s} {'joints':>7s} | solve"
    )
    units = ("mm", "mm", "mm", "mm", "mm/s", "mrad", "mrad", "mrad", "ms")
    print(f"{'':28s} {units[0]:>7s} {units[1]:>7s} | {units[2]:>6s} {units[3]:>6s} "
          f"{units[4]:>7s} {units[5]:>8s} {units[6]:>6s} {units[7]:>7s} | {units[8]}")  # fmt: skip
    for name, error in errors.items():
        short, long = (1e3 * _rms(error.predicted[horizon]) for horizon in HORIZONS)
        solve = f"{1e3 * np.median(error.seconds):.2f}" if error.seconds else "-"
        print(
            f"{name:28s} {short:7.2f} {long:7.2f} | {1e3 * _rms(error.position):6.2f} "
            f"{1e3 * _rms(error.height):6.2f} {1e3 * _rms(error.velocity):7.1f} "
            f"{1e3 * _rms(error.heading):8.2f} {1e3 * _rms(error.tilt):6.2f} "
            f"{1e3 * _rms(error.joints):7.2f} | {solve}"
        )


def main() -> None:
    """Run the cases and print their tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--noise", default="mild", help="noise presets, with commas")
    parser.add_argument("--seeds", type=int, default=3, help="episodes per case, seeds 0, 1, …")
    parser.add_argument("--duration", type=float, default=12.0, help="duration of an episode [s]")
    parser.add_argument("--cases", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument("--motions", default="", help="instead, motions in teleoperation")
    parser.add_argument("--robots", default="g1,rby1", help="robots that do the motions")
    args = parser.parse_args()
    for noise in args.noise.split(","):
        print(f"noise {noise}, seeds 0 to {args.seeds - 1}")
        if args.motions:
            for robot in args.robots.split(","):
                for motion in args.motions.split(","):
                    errors = {variant: Errors() for variant in ("raw", TELEOPERATION)}
                    for seed in range(args.seeds):
                        run_motion(robot, motion, noise, seed, errors)
                    print_table(f"{robot} {motion}", errors)
            continue
        for name in args.cases:
            errors = {variant: Errors() for variant in ("raw", *VARIANTS)}
            for seed in range(args.seeds):
                run(CASES[name], noise, seed, args.duration, errors)
            print_table(name, errors)


if __name__ == "__main__":
    make_output_readable()
    main()
