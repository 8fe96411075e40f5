"""Map where G1's policies stand and walk while their arms are held anywhere.

    python scripts/map_arm_postures.py --policies default falcon --docs docs/low_level.md

In stationary mode a robot is told to stand, in mobile mode to walk at 0.4 m/s, while its arms go
from rest to a posture within 1.5 s and are held there for 8 s. The postures: one joint of both
arms at one end of its range, those that people take, and random ones over a part of each joint's
range. A robot that falls or, standing, moves by more than 0.1 m is counted.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from xop_lerobot.command import Mode
from xop_lerobot.low_level.comparison import make_simulation, replace_table
from xop_lerobot.low_level.joints import read_joints
from xop_lerobot.low_level.policy import POLICY_DT, LowLevelPolicy, make_policy
from xop_lerobot.morphology.morphology import make_morphology

RAMP_S, HOLD_S, SETTLE_S = 1.5, 8.0, 0.8
FAR = 0.1
"""Distance from which a robot that was told to stand counts as having moved [m]."""
SPEED = 0.4
"""Forward velocity of the walks [m/s]."""
SPANS = (0.5, 0.7, 0.9)
"""Parts of each arm joint's range, about its middle, that random postures use."""

NAMED: dict[str, dict[str, float]] = {
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


@dataclass(frozen=True)
class Outcome:
    """What has become of a batch of robots.

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
        """Which fell or moved by more than `FAR`. Shape (n,), bool."""
        return self.fell | ~(self.travel <= FAR)


def make_named() -> np.ndarray:
    """The named postures. Shape (len(NAMED), 14)."""
    morphology = make_morphology("g1")
    postures = np.tile(morphology.rest_action().arms, (len(NAMED), 1))
    for posture, angles in zip(postures, NAMED.values(), strict=True):
        for joint, angle in angles.items():
            mirrored = joint.endswith(("roll", "yaw"))
            posture[morphology.arm_names.index(f"left_{joint}_joint")] = angle
            right = morphology.arm_names.index(f"right_{joint}_joint")
            posture[right] = -angle if mirrored else angle
    return postures


def make_random(rng: np.random.Generator, n: int, span: float) -> np.ndarray:
    """Random postures over `span` of each joint's range. Shape (n, 14)."""
    joints = read_joints("g1")
    low, high = joints.low[joints.arms], joints.high[joints.arms]
    return (low + high) / 2 + span * (high - low) / 2 * rng.uniform(-1, 1, (n, len(low)))


def hold(policy: LowLevelPolicy, arms: np.ndarray, mode: Mode, height: float = 0.75) -> Outcome:
    """Stand or walk with the arms in a posture each.

    Args:
        policy: The policy.
        arms: Postures. Shape (n, 14).
        mode: Stationary to stand, mobile to walk.
        height: Commanded height of the pelvis [m].
    """
    n, rest = len(arms), make_morphology("g1").rest_action().arms
    command = np.tile([height, 0, 0, 0, SPEED * (mode is Mode.MOBILE), 0, 0], (n, 1))
    simulation = make_simulation(n)
    memory, up = policy.initial_memory(n), np.ones(n, bool)
    settle, ramp = round(SETTLE_S / POLICY_DT), round(RAMP_S / POLICY_DT)
    start, velocities = np.zeros((n, 2)), []
    for step in range(settle + round(HOLD_S / POLICY_DT)):
        if step == settle:
            start = simulation.qpos[:, :2].copy()
        share = np.clip((step - settle) / ramp, 0, 1)
        targets, memory = policy.act(
            simulation.qpos, simulation.qvel, command, (1 - share) * rest + share * arms, memory,
            mode,
        )  # fmt: skip
        simulation.step(targets)
        up &= ~simulation.fallen()
        simulation.reset(~up)
        if step >= settle + ramp:
            velocities.append(simulation.velocity())
    travel = np.linalg.norm(simulation.qpos[:, :2] - start, axis=1)
    simulation.close()
    return Outcome(~up, np.where(up, travel, np.nan), np.mean(velocities, axis=0))


def map_policy(policy: LowLevelPolicy, trials: int, seed: int) -> list[str]:
    """Describe what a policy can do with, a cell a row of `ROWS`."""
    named = hold(policy, make_named(), Mode.STATIONARY)
    cells = [
        "falls" if fell else f"{travel:.2f}"
        for fell, travel in zip(named.fell, named.travel, strict=True)
    ]
    for span in SPANS:
        arms = make_random(np.random.default_rng(seed), trials, span)
        stood, walked = (hold(policy, arms, mode) for mode in Mode)
        cells.append(f"{stood.fell.sum()}, {(stood.strayed & ~stood.fell).sum()}")
        cells.append(f"{np.nanmedian(stood.travel):.2f}, {np.nanmax(stood.travel):.2f}")
        bias = (walked.velocity[:, 0] - SPEED)[~walked.fell].mean()
        turn = np.abs(walked.velocity[:, 2])[~walked.fell].mean()
        cells.append(f"{walked.fell.sum()}, {bias:+.2f}, {turn:.2f}")
    return cells


ROWS = (
    *(f"stands, {name}: moved [m]" for name in NAMED),
    *(
        text
        for span in SPANS
        for text in (
            f"stands, random over {span:.0%}: fell, moved > {FAR} m",
            "the same: median, largest move [m]",
            f"walks at {SPEED} m/s: fell, error of the speed [m/s], unasked yaw rate [rad/s]",
        )
    ),
)


def main() -> None:
    """Map the policies and write the table."""
    parser = argparse.ArgumentParser(
        description="Map where G1's policies stand and walk while their arms are held anywhere.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--policies", nargs="+", default=["default"], help="NAME or NAME=FILE")
    parser.add_argument("--trials", type=int, default=100, help="random postures of each kind")
    parser.add_argument("--seed", type=int, default=0, help="seed of the random postures")
    parser.add_argument("--docs", type=Path, help="Markdown page whose table is to be replaced")
    arguments = parser.parse_args()
    columns = {}
    for words in arguments.policies:
        name, _, path = words.partition("=")
        policy = make_policy(name, path or None)
        columns[name] = map_policy(policy, arguments.trials, arguments.seed)
    lines = [
        f"{arguments.trials} random postures of each kind, seed {arguments.seed}, "
        f"{HOLD_S:g} s each, planning model:",
        "",
        f"| | {' | '.join(columns)} |",
        "|---|" + "---|" * len(columns),
    ]
    for row, text in enumerate(ROWS):
        lines.append(f"| {text} | {' | '.join(cells[row] for cells in columns.values())} |")
    table = "\n".join(lines) + "\n"
    print(table)
    if arguments.docs:
        replace_table(arguments.docs, table, "arm postures")


if __name__ == "__main__":
    main()
