"""Results of `xop-bench`: metrics of timed solves, the machine, and Markdown tables."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

KEYS = (
    "step_ms_median",
    "step_ms_p99",
    "rollout_ms_median",
    "physics_ms_median",
    "policy_ms_median",
    "overhead_ratio",
    "control_hz",
)
"""Metrics of the JSON file that are stable across versions."""


def summarise(rows: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    """Compute metrics of timed solves.

    Args:
        rows: Times of every solve by part [s]; ``step`` is the total, ``bare`` the bare rollout,
            ``physics`` and ``policy`` their share of the solve.

    Returns:
        The metrics of `KEYS`; ``control_hz_p99``, ``sync_ms_median``; ``overhead_ratio_p25`` and
        ``_p75``, quartiles of the ratio within single solves; ``profile`` by part [ms].
    """
    parts = {name: np.array([row[name] for row in rows]) * 1000 for name in rows[0]}
    medians = {name: float(np.median(values)) for name, values in parts.items()}
    p99 = float(np.percentile(parts["step"], 99))
    ratios = parts["step"] / parts["bare"]
    return {
        "step_ms_median": medians["step"],
        "step_ms_p99": p99,
        "rollout_ms_median": medians["bare"],
        "physics_ms_median": medians["physics"],
        "policy_ms_median": medians["policy"],
        "overhead_ratio": medians["step"] / medians["bare"],
        "control_hz": 1000 / medians["step"],
        "control_hz_p99": 1000 / p99,
        "sync_ms_median": medians["sync"],
        "overhead_ratio_p25": float(np.percentile(ratios, 25)),
        "overhead_ratio_p75": float(np.percentile(ratios, 75)),
        "profile": make_profile(medians),
    }


def make_profile(medians: Mapping[str, float]) -> dict[str, float]:
    """Split the step into parts; medians of parts add up only approximately.

    Args:
        medians: Median time of each part [ms].

    Returns:
        Time by part [ms]; ``other`` is the unaccounted rest.
    """
    profile = {"state sync": medians["sync"], "physics": medians["physics"]}
    profile["low-level policy"] = medians["policy"]
    glue = medians.get("rollout", 0.0) - medians["physics"] - medians["policy"]
    profile["rollout, rest"] = glue
    known = ("step", "sync", "solve", "bare", "rollout", "physics", "policy")
    profile |= {name: value for name, value in medians.items() if name not in known}
    profile["other"] = medians["step"] - sum(profile.values())
    return profile


def describe_machine() -> dict[str, str]:
    """Return processor, cores and versions, which are stored with the results."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                model = line.partition(":")[2].strip()
                break
    packages = ("mujoco", "numpy", "mink", "onnxruntime")
    return {
        "processor": model,
        "cores": str(len(os.sched_getaffinity(0))),
        "python": platform.python_version(),
        **{name: version(name) for name in packages},
    }


def describe_versions(machine: Mapping[str, Any]) -> str:
    """Describe the machine in one sentence."""
    rest = [f"{name} {value}" for name, value in machine.items() if name != "processor"]
    return f"{machine['processor']}, {', '.join(rest)}."


def make_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Make a Markdown table."""
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def make_bench_blocks(benches: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Make the blocks of docs/results/benchmarks.md: machine, results and profile.

    Args:
        benches: Contents of JSON files of xop-bench, one row each.
    """
    first = benches[0]
    machine = (
        f"{describe_versions(first['machine'])} {first['steps']} solves per row, seed "
        f"{first['seed']}, sensor noise `{first['noise']}`."
    )
    headings = (
        "robot, mode", "samples × steps", "threads", "step, median [ms]", "p99 [ms]",
        "bare [ms]", "overhead", "rate [Hz]", "p99 [Hz]", "wanted [Hz]",
    )  # fmt: skip
    rows = [
        [
            f"{bench['robot']}, {bench['mode']}",
            f"{bench['samples']} × {bench['horizon']}",
            str(bench["threads"]),
            f"{bench['step_ms_median']:.1f}",
            f"{bench['step_ms_p99']:.1f}",
            f"{bench['rollout_ms_median']:.1f}",
            f"{bench['overhead_ratio']:.2f}",
            f"{bench['control_hz']:.0f}",
            f"{bench['control_hz_p99']:.0f}",
            f"{bench['wanted_hz']:g}",
        ]
        for bench in benches
    ]
    parts = list(dict.fromkeys(part for bench in benches for part in bench["profile"]))
    profile = [
        [
            f"{bench['robot']}, {bench['mode']}, {bench['samples']} × {bench['horizon']}",
            *(f"{bench['profile'].get(part, 0.0):.2f}" for part in parts),
            f"{bench['step_ms_median']:.2f}",
        ]
        for bench in benches
    ]
    return {
        "bench machine": machine,
        "bench": make_table(headings, rows),
        "profile": make_table(["", *parts, "step"], profile),
    }
