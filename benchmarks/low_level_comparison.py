"""What G1 policies do alone: held commands, postures of the arms, random sequences, speed."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from benchmarks.low_level_excitation import Excitation, ExcitationConfig, make_excitation
from benchmarks.low_level_trial import BatchSimulation, TrialResult, run_trials
from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.transforms import compute_projected_gravity, quat_yaw
from xop_lerobot.low_level.joints import read_joints
from xop_lerobot.low_level.policy import POLICY_DT, LowLevelPolicy
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_model

SEQUENCES_SEED = 1_000_000
"""Added to the seed, so that no sequence of a comparison was trained on."""

STAND, WALK = Mode.STATIONARY, Mode.MOBILE
RESPONSES: dict[str, tuple[tuple[float, ...], Mode]] = {
    "stand": ((0.75, 0, 0, 0, 0, 0, 0), STAND),
    "stand at 0.70 m": ((0.70, 0, 0, 0, 0, 0, 0), STAND),
    "stand at 0.60 m": ((0.60, 0, 0, 0, 0, 0, 0), STAND),
    "stand at 0.50 m": ((0.50, 0, 0, 0, 0, 0, 0), STAND),
    "stand at 0.42 m": ((0.42, 0, 0, 0, 0, 0, 0), STAND),
    "waist yaw 0.8": ((0.75, 0.8, 0, 0, 0, 0, 0), STAND),
    "waist roll 0.3": ((0.75, 0, 0.3, 0, 0, 0, 0), STAND),
    "waist pitch 0.5": ((0.75, 0, 0, 0.5, 0, 0, 0), STAND),
    "waist pitch -0.3": ((0.75, 0, 0, -0.3, 0, 0, 0), STAND),
    "0.45 m and pitch 0.5": ((0.45, 0, 0, 0.5, 0, 0, 0), STAND),
    "zero velocity": ((0.75, 0, 0, 0, 0, 0, 0), WALK),
    "walk 0.5 m/s": ((0.75, 0, 0, 0, 0.5, 0, 0), WALK),
    "walk -0.5 m/s": ((0.75, 0, 0, 0, -0.5, 0, 0), WALK),
    "sidestep 0.4 m/s": ((0.75, 0, 0, 0, 0, 0.4, 0), WALK),
    "turn 0.6 rad/s": ((0.75, 0, 0, 0, 0, 0, 0.6), WALK),
    "walk 0.4 m/s at 0.60 m": ((0.60, 0, 0, 0, 0.4, 0, 0), WALK),
}
"""Plain commands, held for 10 s: name -> command, mode."""

SEQUENCES = {
    "calm arms, no push": ExcitationConfig(arm_range=0.3, push=0.0),
    "the published ranges": ExcitationConfig(),
    "pushes of 1.0 m/s": ExcitationConfig(arm_range=0.3, push=1.0),
    "lean 0.3 rad, low, 20 N at the hands": ExcitationConfig(
        height=(0.45, 0.75), waist_roll=0.3, waist_pitch=(-0.3, 0.3), push=0.0, hand_force=20.0
    ),
}
"""Random sequences by name."""

ARMS: dict[str, dict[str, float]] = {
    "palms up": {"wrist_roll": 1.9},
    "palms out": {"wrist_roll": -1.6},
    "overhead": {"shoulder_pitch": -2.8, "elbow": 0.8},
    "behind the back": {
        "shoulder_pitch": 0.9, "shoulder_yaw": -0.5, "elbow": 1.2, "wrist_roll": 1.0,
    },
    "crossed": {"shoulder_pitch": -0.8, "shoulder_yaw": 1.0, "elbow": 0.3},
    "to the sides": {"shoulder_roll": 1.5, "elbow": 1.4},
}  # fmt: skip
"""What people do with their arms: angles of the left arm [rad], from rest; the right mirrors it."""

RAMP_S, HOLD_S, SETTLE_S = 1.5, 8.0, 0.8
FAR = 0.1
"""Distance from which a robot that was told to stand counts as having moved [m]."""
SPEED = 0.4
"""Forward velocity of the walks with held arms [m/s]."""


def make_simulation(
    n: int, threads: int = 2, policy: LowLevelPolicy | None = None
) -> BatchSimulation:
    """Make `n` G1 in the planning model, at their standing posture, with a policy's motors."""
    morphology = make_morphology("g1")
    model = build_model(morphology, "planning")
    if policy is not None:
        policy.adapt(model)
    return BatchSimulation([model] * n, morphology.standing_qpos(), threads)


def measure_sequences(
    policy: LowLevelPolicy,
    config: ExcitationConfig,
    *,
    seed: int = 0,
    trials: int = 200,
    seconds: float = 20.0,
    threads: int = 2,
) -> TrialResult:
    """Run random sequences.

    Args:
        policy: The policy.
        config: Ranges of the sequences.
        seed: Seed of the sequences.
        trials: Number of sequences.
        seconds: Length of each [s].
        threads: Threads of the simulation.
    """
    rng = np.random.default_rng(SEQUENCES_SEED + seed)
    excitation = make_excitation(rng, trials, round(seconds / POLICY_DT), config)
    simulation = make_simulation(trials, threads, policy)
    try:
        return run_trials(policy, simulation, excitation)
    finally:
        simulation.close()


def measure_responses(policy: LowLevelPolicy, threads: int = 2) -> dict[str, dict[str, float]]:
    """Hold each command of `RESPONSES` for 10 s after a ramp of 1 s, arms at rest, no pushes.

    Returns:
        By name: travel of the base [m] and turn [rad] since the ramp, mean height [m] and
        velocities [m/s, rad/s] in the heading frame over the last 5 s, and falls.
    """
    n, steps, ramp, mean_steps = len(RESPONSES), 550, 50, 250
    final = np.array([command for command, _ in RESPONSES.values()])
    start = np.array([0.75, 0, 0, 0, 0, 0, 0])
    share = np.minimum(np.arange(steps) / ramp, 1.0)[:, None, None]
    mode = np.array([mode for _, mode in RESPONSES.values()])
    arms = make_morphology("g1").rest_action().arms
    excitation = Excitation(
        start + share * (final - start),
        np.tile(mode, (steps, 1)),
        np.tile(arms, (steps, n, 1)),
        np.zeros((steps, n, 2)),
        np.zeros((steps, n, 2, 3)),
    )
    simulation = make_simulation(n, threads, policy)
    memory, down = policy.initial_memory(n), np.zeros(n, bool)
    heights, velocities, poses = [], [], []
    for step in range(steps):
        targets, memory = policy.act(
            simulation.qpos, simulation.qvel, excitation.command[step], excitation.arms[step],
            memory, mode,
        )  # fmt: skip
        simulation.step(targets)
        down |= simulation.fallen()
        heights.append(simulation.qpos[:, 2].copy())
        velocities.append(simulation.velocity())
        poses.append(np.column_stack([simulation.qpos[:, :2], quat_yaw(simulation.qpos[:, 3:7])]))
    simulation.close()
    travel = np.linalg.norm(poses[-1][:, :2] - poses[ramp][:, :2], axis=1)
    turn = np.sum(velocities[ramp:], axis=0)[:, 2] * POLICY_DT
    height, velocity = (np.mean(values[-mean_steps:], axis=0) for values in (heights, velocities))
    columns = {"travel": travel, "turn": turn, "height": height, "vx": velocity[:, 0]}
    columns |= {"vy": velocity[:, 1], "yaw_rate": velocity[:, 2], "falls": down}
    return {
        name: {key: float(column[row]) for key, column in columns.items()}
        for row, name in enumerate(RESPONSES)
    }


REST_AXES: dict[str, tuple[float, ...]] = {
    "height": (0.42, 0.45, 0.50, 0.55, 0.60, 0.65, 0.70, 0.78),
    "waist_pitch": (-0.5, -0.3, -0.15, 0.0, 0.15, 0.3, 0.5),
}
"""Commands at which it is measured how a standing robot rests."""


class MeasuredRest(NamedTuple):
    """How standing robots rest, arms at rest; NaN where they fell.

    Attributes:
        axes: Entries of the command and their values, those that the policy can do.
        pitch: Pitch of the base [rad]. A row for each value of the first entry.
        forward: Place of the base ahead of the middle of the feet [m], the same.
    """

    axes: dict[str, tuple[float, ...]]
    pitch: np.ndarray
    forward: np.ndarray


def measure_rest(policy: LowLevelPolicy, threads: int = 2) -> MeasuredRest:
    """Measure how a policy's standing robot leans and moves its base unasked.

    Each command of a grid is approached in 3 s and held for 5 s; the mean of the last 2 s counts.

    Raises:
        BadValue: If the policy has but one height, or does not pitch the waist.
    """
    morphology = make_morphology("g1").fit(policy)
    space = morphology.command_space
    low, high = space.bounds(Mode.STATIONARY)
    axes = {
        name: tuple(sorted({float(np.clip(value, low[i], high[i])) for value in values}))
        for name, values in REST_AXES.items()
        for i in [space.index(name)]
    }
    for name, values in axes.items():
        if len(values) == 1:
            raise BadValue(f"the policy has one {name}, {values[0]:g}: nothing to measure")
    grid = np.array(np.meshgrid(*axes.values(), indexing="ij")).reshape(len(axes), -1)
    n = grid.shape[1]
    final = np.tile(space.neutral, (n, 1))
    final[:, [space.index(name) for name in axes]] = grid.T
    arms = np.tile(morphology.rest_action().arms, (n, 1))
    simulation = make_simulation(n, threads, policy)
    soles = _SoleFinder()
    memory, up = policy.initial_memory(n), np.ones(n, bool)
    pitches, places = [], []
    ramp, settled, end = (round(time_s / POLICY_DT) for time_s in (3.0, 6.0, 8.0))
    for step in range(end):
        command = space.neutral + min(step / ramp, 1.0) * (final - space.neutral)
        targets, memory = policy.act(
            simulation.qpos, simulation.qvel, command, arms, memory, Mode.STATIONARY
        )
        simulation.step(targets)
        up &= ~simulation.fallen()
        simulation.reset(~up)
        if step >= settled and step % 5 == 0:
            gravity = compute_projected_gravity(simulation.qpos[:, 3:7])
            pitches.append(np.arcsin(np.clip(gravity[:, 0], -1, 1)))
            places.append([soles.compute_forward(qpos) for qpos in simulation.qpos])
    simulation.close()
    shape = tuple(len(values) for values in axes.values())
    pitch, forward = (
        np.where(up, np.mean(values, axis=0), np.nan).reshape(shape) for values in (pitches, places)
    )
    return MeasuredRest(axes, pitch, forward)


class _SoleFinder:
    """Finds a robot's feet."""

    def __init__(self) -> None:
        morphology = make_morphology("g1")
        model = self._model = build_model(morphology, "planning")
        self._data = mujoco.MjData(model)
        self._sites = [model.site(name).id for name in morphology.contact_points]

    def compute_forward(self, qpos: np.ndarray) -> float:
        """Distance of the base ahead of the middle of the feet, along its heading [m]."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        middle = self._data.site_xpos[self._sites].mean(axis=0)
        yaw = float(quat_yaw(qpos[3:7]))
        return float((qpos[:2] - middle[:2]) @ [np.cos(yaw), np.sin(yaw)])


@dataclass(frozen=True)
class HeldArms:
    """What has become of robots that hold their arms in a posture each.

    Attributes:
        fell: Which fell. Shape (n,), bool.
        travel: How far each is from where it stood [m], NaN if it fell. Shape (n,).
        velocity: Mean velocity forward, left [m/s] and yaw rate [rad/s]. Shape (n, 3).
    """

    fell: np.ndarray
    travel: np.ndarray
    velocity: np.ndarray

    @property
    def strayed(self) -> np.ndarray:
        """Which moved by more than `FAR`. Shape (n,), bool."""
        return ~self.fell & (self.travel > FAR)


def make_named_arms() -> np.ndarray:
    """The postures `ARMS`. Shape (len(ARMS), 14)."""
    morphology = make_morphology("g1")
    postures = np.tile(morphology.rest_action().arms, (len(ARMS), 1))
    for posture, angles in zip(postures, ARMS.values(), strict=True):
        for joint, angle in angles.items():
            mirrored = joint.endswith(("roll", "yaw"))
            posture[morphology.arm_names.index(f"left_{joint}_joint")] = angle
            right = morphology.arm_names.index(f"right_{joint}_joint")
            posture[right] = -angle if mirrored else angle
    return postures


def make_random_arms(
    policy: LowLevelPolicy, rng: np.random.Generator, n: int, span: float
) -> np.ndarray:
    """Random postures over `span` of each joint's range, within the policy's limits. (n, 14)."""
    joints, names = read_joints("g1"), make_morphology("g1").arm_names
    low, high = joints.low[joints.arms], joints.high[joints.arms]
    arms = (low + high) / 2 + span * (high - low) / 2 * rng.uniform(-1, 1, (n, len(low)))
    for joint, (least, most) in policy.arm_limits.items():
        column = names.index(joint)
        arms[:, column] = np.clip(arms[:, column], least, most)
    return arms


def hold_arms(
    policy: LowLevelPolicy, arms: np.ndarray, mode: Mode, height: float = 0.75, threads: int = 2
) -> HeldArms:
    """Stand or walk with the arms in a posture each: 1.5 s on the way there, 8 s in all.

    Args:
        policy: The policy.
        arms: Postures. Shape (n, 14).
        mode: Stationary to stand, mobile to walk at `SPEED`.
        height: Commanded height of the pelvis [m].
        threads: Threads of the simulation.
    """
    n, rest = len(arms), make_morphology("g1").rest_action().arms
    final = np.array([height, 0, 0, 0, SPEED * (mode is Mode.MOBILE), 0, 0])
    settle, ramp = round(SETTLE_S / POLICY_DT), round(RAMP_S / POLICY_DT)
    lead = settle + round(abs(height - 0.75) / 0.25 / POLICY_DT)
    simulation = make_simulation(n, threads, policy)
    memory, up = policy.initial_memory(n), np.ones(n, bool)
    start, velocities = np.zeros((n, 2)), []
    for step in range(lead + round(HOLD_S / POLICY_DT)):
        if step == lead:
            start = simulation.qpos[:, :2].copy()
        command = final.copy()
        command[0] = 0.75 + min(step / max(lead, 1), 1.0) * (height - 0.75)
        share = np.clip((step - lead) / ramp, 0, 1)
        targets, memory = policy.act(
            simulation.qpos, simulation.qvel, np.tile(command, (n, 1)),
            (1 - share) * rest + share * arms, memory, mode,
        )  # fmt: skip
        simulation.step(targets)
        up &= ~simulation.fallen()
        simulation.reset(~up)
        if step >= lead + ramp:
            velocities.append(simulation.velocity())
    travel = np.linalg.norm(simulation.qpos[:, :2] - start, axis=1)
    simulation.close()
    return HeldArms(~up, np.where(up, travel, np.nan), np.mean(velocities, axis=0))


def measure_speeds(
    policies: Mapping[str, LowLevelPolicy], repeats: int = 200
) -> dict[str, dict[str, float]]:
    """Measure the median time of one `act` [ms], by policy and batch size.

    The policies take turns, so that whatever else the machine does slows all of them.
    """
    qpos = make_morphology("g1").standing_qpos()
    result: dict[str, dict[str, float]] = {name: {} for name in policies}
    for n in (1, 30, 128):
        inputs = (
            np.tile(qpos, (n, 1)),
            np.zeros((n, qpos.size - 1)),
            np.tile([0.75, 0, 0, 0, 0, 0, 0], (n, 1)),
            np.zeros((n, 14)),
        )
        memory = {name: policy.initial_memory(n) for name, policy in policies.items()}
        times: dict[str, list[float]] = {name: [] for name in policies}
        for _ in range(repeats):
            for name, policy in policies.items():
                start = time.perf_counter()
                memory[name] = policy.act(*inputs, memory[name], Mode.STATIONARY).memory
                times[name].append(time.perf_counter() - start)
        for name in policies:
            result[name][str(n)] = 1e3 * float(np.median(times[name]))
    return result


def replace_table(page: Path, table: str, mark: str) -> None:
    """Replace what stands between the two marks of a Markdown page by `table`.

    The marks are the comments ``mark`` and ``end of mark``.

    Raises:
        BadValue: If the page does not have the marks.
    """
    begin, end = f"<!-- {mark} -->\n", f"<!-- end of {mark} -->"
    text = page.read_text(encoding="utf-8")
    if text.count(begin) != 1 or text.count(end) != 1:
        raise BadValue(f"'{page}' must have one line {begin.strip()!r} and one {end!r}")
    before, rest = text.split(begin)
    page.write_text(before + begin + table + end + rest.split(end)[1], encoding="utf-8")
