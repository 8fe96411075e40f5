"""Student against teacher: the same random sequences, some plain commands, and speed."""

from __future__ import annotations

import platform
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from xop_lerobot.command import Mode
from xop_lerobot.errors import BadValue
from xop_lerobot.low_level.excitation import Excitation, ExcitationConfig, make_excitation
from xop_lerobot.low_level.policy import POLICY_DT, LowLevelPolicy
from xop_lerobot.low_level.trial import BatchSimulation, run_trials
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.transforms import quat_yaw

COMPARISON_SEED = 1_000_000
"""Added to the seed, so that no sequence of the comparison was trained on."""

MEASURES = {
    "falls": "falls",
    "height_rmse": "height RMSE, stance [m]",
    "vx_rmse": "vx RMSE, walking [m/s]",
    "vy_rmse": "vy RMSE, walking [m/s]",
    "planar_rmse": "planar velocity RMSE, walking [m/s]",
    "yaw_rate_rmse": "yaw rate RMSE, walking [rad/s]",
    "waist_yaw_rmse": "waist yaw RMSE, stance [rad]",
}
"""Measures of a comparison and what they are called in its table."""

STAND, WALK = Mode.STATIONARY, Mode.MOBILE
RESPONSES: dict[str, tuple[tuple[float, ...], Mode]] = {
    "stand": ((0.75, 0, 0, 0, 0, 0, 0), STAND),
    "stand at 0.70 m": ((0.70, 0, 0, 0, 0, 0, 0), STAND),
    "stand at 0.60 m": ((0.60, 0, 0, 0, 0, 0, 0), STAND),
    "stand at 0.55 m": ((0.55, 0, 0, 0, 0, 0, 0), STAND),
    "stand at 0.50 m": ((0.50, 0, 0, 0, 0, 0, 0), STAND),
    "waist yaw 0.8": ((0.75, 0.8, 0, 0, 0, 0, 0), STAND),
    "waist roll 0.3": ((0.75, 0, 0.3, 0, 0, 0, 0), STAND),
    "waist pitch 0.3": ((0.75, 0, 0, 0.3, 0, 0, 0), STAND),
    "waist pitch 0.5": ((0.75, 0, 0, 0.5, 0, 0, 0), STAND),
    "waist pitch -0.3": ((0.75, 0, 0, -0.3, 0, 0, 0), STAND),
    "step in place": ((0.75, 0, 0, 0, 0, 0, 0), WALK),
    "walk 0.5 m/s": ((0.75, 0, 0, 0, 0.5, 0, 0), WALK),
    "walk -0.5 m/s": ((0.75, 0, 0, 0, -0.5, 0, 0), WALK),
    "sidestep 0.4 m/s": ((0.75, 0, 0, 0, 0, 0.4, 0), WALK),
    "turn 0.6 rad/s": ((0.75, 0, 0, 0, 0, 0, 0.6), WALK),
}
"""Plain commands, held for 10 s: name -> command, mode."""


def compare_policies(  # noqa: PLR0913
    teacher: LowLevelPolicy,
    student: LowLevelPolicy,
    *,
    seed: int = 0,
    trials: int = 200,
    seconds: float = 20.0,
    threads: int = 2,
    config: ExcitationConfig | None = None,
) -> dict[str, Any]:
    """Compare two G1 policies on our planning model.

    Args:
        teacher: The one to compare with.
        student: The one that is compared.
        seed: Seed of the random sequences.
        trials: Number of sequences.
        seconds: Length of each [s].
        threads: Threads of the simulation.
        config: Ranges of the sequences, None for the published ones.

    Returns:
        A report of plain numbers, texts and dictionaries.
    """
    config = config or ExcitationConfig()
    policies = {"teacher": teacher, "student": student}
    rng = np.random.default_rng(COMPARISON_SEED + seed)
    excitation = make_excitation(rng, trials, round(seconds / POLICY_DT), config)
    results = {
        name: run_trials(policy, make_simulation(trials, threads), excitation)
        for name, policy in policies.items()
    }
    return {
        "seed": seed,
        "trials": trials,
        "seconds": seconds,
        "ranges": asdict(config),
        "mujoco": mujoco.__version__,
        "machine": f"{platform.machine()}, {platform.system()}",
        **{name: asdict(result) for name, result in results.items()},
        "ratio": _ratios(asdict(results["student"]), asdict(results["teacher"])),
        "responses": {
            name: measure_responses(policy, threads) for name, policy in policies.items()
        },
        "act_ms": measure_speeds(policies),
    }


def _ratios(student: Mapping[str, float], teacher: Mapping[str, float]) -> dict[str, float]:
    return {key: student[key] / teacher[key] for key in MEASURES if key.endswith("rmse")}


def make_simulation(n: int, threads: int = 2) -> BatchSimulation:
    """Make `n` G1 in the planning model, at their standing posture."""
    morphology = make_morphology("g1")
    model = build_model(morphology, "planning")
    return BatchSimulation([model] * n, morphology.standing_qpos(), threads)


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
    simulation = make_simulation(n, threads)
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
    travel = np.linalg.norm(poses[-1][:, :2] - poses[ramp][:, :2], axis=1)
    turn = np.sum(velocities[ramp:], axis=0)[:, 2] * POLICY_DT
    height, velocity = (np.mean(values[-mean_steps:], axis=0) for values in (heights, velocities))
    columns = {"travel": travel, "turn": turn, "height": height, "vx": velocity[:, 0]}
    columns |= {"vy": velocity[:, 1], "yaw_rate": velocity[:, 2], "falls": down}
    return {
        name: {key: float(column[row]) for key, column in columns.items()}
        for row, name in enumerate(RESPONSES)
    }


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


def write_table(report: Mapping[str, Any]) -> str:
    """Write a report as Markdown tables."""
    teacher, student = report["teacher"], report["student"]
    lines = [
        f"{report['trials']} random sequences of {report['seconds']:g} s, seed {report['seed']}, "
        f"MuJoCo {report['mujoco']}, planning model:",
        "",
        "| | FALCON | student | ratio |",
        "|---|---|---|---|",
    ]
    for key, label in MEASURES.items():
        ratio = f"{report['ratio'][key]:.2f}" if key in report["ratio"] else ""
        numbers = (f"{values[key]:.3f}".removesuffix(".000") for values in (teacher, student))
        lines.append(f"| {label} | {' | '.join(numbers)} | {ratio} |")
    for n, slow in report["act_ms"]["teacher"].items():
        fast = report["act_ms"]["student"][n]
        lines.append(
            f"| one call, batch of {n} [ms] | {slow:.2f} | {fast:.2f} | {fast / slow:.2f} |"
        )
    lines += [
        "",
        "Plain commands, held for 10 s (FALCON / student); means over the last 5 s:",
        "",
        "| command | travel [m] | turn [rad] | height [m] | vx [m/s] | vy [m/s] | "
        "yaw rate [rad/s] | falls |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, one in report["responses"]["teacher"].items():
        two = report["responses"]["student"][name]
        cells = [f"{one[key]:z.2f} / {two[key]:z.2f}" for key in one if key != "falls"]
        lines.append(f"| {name} | {' | '.join(cells)} | {one['falls']:g} / {two['falls']:g} |")
    return "\n".join(lines) + "\n"


def replace_table(page: Path, table: str, mark: str = "comparison") -> None:
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
