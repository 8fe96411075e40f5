"""Measurements of G1's low-level policies without a retargeter.

Held commands, held arm postures, random command sequences, the robot at rest, and the time of one
call. Everything runs on the planning model, many robots at once.
"""

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
"""Offset added to the seed, so that no policy was trained on a sequence of a comparison."""

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
"""Held commands by name: (height [m], waist yaw, roll, pitch [rad], vx, vy [m/s], yaw rate [rad/s])
and mode."""

SEQUENCES = {
    "calm arms, no push": ExcitationConfig(arm_range=0.3, push=0.0),
    "the published ranges": ExcitationConfig(),
    "pushes of 1.0 m/s": ExcitationConfig(arm_range=0.3, push=1.0),
    "lean 0.3 rad, low, 20 N at the hands": ExcitationConfig(
        height=(0.45, 0.75), waist_roll=0.3, waist_pitch=(-0.3, 0.3), push=0.0, hand_force=20.0
    ),
}
"""Ranges of the random sequences by name."""

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
"""Arm postures that people take: joint angles of the left arm that differ from rest [rad]; the
right arm mirrors them."""

RAMP_S, HOLD_S, SETTLE_S = 1.5, 8.0, 0.8
"""Times of `hold_arms`: ramp to the posture, the whole posture with its ramp, and settling before
it [s]."""
FAR = 0.1
"""Displacement above which a robot commanded to stand counts as having moved [m]."""
SPEED = 0.4
"""Commanded forward velocity when walking with held arms [m/s]."""


def make_simulation(
    n: int, threads: int = 2, policy: LowLevelPolicy | None = None
) -> BatchSimulation:
    """Make `n` copies of G1's planning model in the standing posture.

    Args:
        n: Number of robots.
        threads: Threads of the simulation.
        policy: Policy whose motor gains the model gets, None for the model's own.
    """
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
    """Run a policy on random sequences.

    Args:
        policy: The policy.
        config: Ranges of the sequences.
        seed: Seed of the sequences.
        trials: Number of sequences.
        seconds: Duration of each [s].
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
        By name: displacement [m] and rotation [rad] of the base since the ramp, mean height [m] and
        velocities [m/s, rad/s] in the heading frame over the last 5 s, and falls (0 or 1).
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
"""Grid of commands at which `measure_rest` measures a standing robot."""


class MeasuredRest(NamedTuple):
    """Posture of standing robots over a grid of commands, arms at rest; NaN where they fell.

    Attributes:
        axes: Command entries and their grid values, clipped to what the policy can do.
        pitch: Pitch of the base [rad]. One row per value of the first entry.
        forward: Position of the base ahead of the centre of the feet [m]. Same shape.
    """

    axes: dict[str, tuple[float, ...]]
    pitch: np.ndarray
    forward: np.ndarray


def measure_rest(policy: LowLevelPolicy, threads: int = 2) -> MeasuredRest:
    """Measure the uncommanded pitch and forward shift of a policy's standing robot.

    Each command of `REST_AXES` is approached in 3 s and held for 5 s; the result is the mean of
    the last 2 s.

    Raises:
        BadValue: If the policy has a single height, or does not pitch the waist.
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
    """Locates G1's feet by forward kinematics."""

    def __init__(self) -> None:
        morphology = make_morphology("g1")
        model = self._model = build_model(morphology, "planning")
        self._data = mujoco.MjData(model)
        self._sites = [model.site(name).id for name in morphology.contact_points]

    def compute_forward(self, qpos: np.ndarray) -> float:
        """Return how far the base is ahead of the centre of the feet, along its heading [m]."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        middle = self._data.site_xpos[self._sites].mean(axis=0)
        yaw = float(quat_yaw(qpos[3:7]))
        return float((qpos[:2] - middle[:2]) @ [np.cos(yaw), np.sin(yaw)])


@dataclass(frozen=True)
class HeldArms:
    """Outcome of `hold_arms`, one robot per arm posture.

    Attributes:
        fell: Whether each robot fell. Shape (n,), bool.
        travel: Displacement of the base since the start of the ramp [m], NaN if it fell.
            Shape (n,).
        velocity: Mean velocity forward, left [m/s] and yaw rate [rad/s] after the ramp.
            Shape (n, 3).
    """

    fell: np.ndarray
    travel: np.ndarray
    velocity: np.ndarray

    @property
    def strayed(self) -> np.ndarray:
        """Whether each robot moved by more than `FAR` without a fall. Shape (n,), bool."""
        return ~self.fell & (self.travel > FAR)


def make_named_arms() -> np.ndarray:
    """Return the postures of `ARMS` as joint angles [rad]. Shape (len(ARMS), 14)."""
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
    """Draw arm postures uniformly [rad]. Shape (n, 14).

    Args:
        policy: The policy, to whose arm limits they are clipped.
        rng: Random generator.
        n: Number of postures.
        span: Fraction of each joint's range, about its centre.
    """
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
    """Stand or walk with held arm postures, one robot each: a ramp of 1.5 s, 8 s in all.

    Args:
        policy: The policy.
        arms: Joint angles of the arms [rad]. Shape (n, 14).
        mode: Stationary to stand, mobile to walk at `SPEED`.
        height: Commanded height of the pelvis [m].
        threads: Threads of the simulation.
    """
    n, rest = len(arms), make_morphology("g1").rest_action().arms
    final = np.array([height, 0, 0, 0, SPEED * (mode is Mode.MOBILE), 0, 0])
    settle, ramp = round(SETTLE_S / POLICY_DT), round(RAMP_S / POLICY_DT)
    # The height is reached first, at 0.25 m/s; displacement counts from there.
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

    The policies are called alternately, so that other load on the machine slows all of them alike.
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
    """Replace the text between two markers of a Markdown page by `table`.

    The markers are the HTML comments ``<!-- mark -->`` and ``<!-- end of mark -->``.

    Raises:
        BadValue: If the page does not have each marker once.
    """
    begin, end = f"<!-- {mark} -->\n", f"<!-- end of {mark} -->"
    text = page.read_text(encoding="utf-8")
    if text.count(begin) != 1 or text.count(end) != 1:
        raise BadValue(f"'{page}' must have one line {begin.strip()!r} and one {end!r}")
    before, rest = text.split(begin)
    page.write_text(before + begin + table + end + rest.split(end)[1], encoding="utf-8")
