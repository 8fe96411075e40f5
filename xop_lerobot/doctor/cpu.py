"""Whether this machine is fast enough for the planner."""

from __future__ import annotations

import os

from xop_lerobot.doctor.finding import Finding, Level, Setup

STEPS, WARMUP = 40, 10
SHARE = 0.8
"""A planner that needs more of its period leaves too little to the rest."""


def check_cpu(setup: Setup) -> Finding:
    """Time the planner of the robot, and compare with how often it is to plan."""
    from xop_lerobot.core.command import Mode  # noqa: PLC0415
    from xop_lerobot.evaluation.bench import BenchConfig, run_bench  # noqa: PLC0415  MuJoCo

    mode = Mode[setup.mode.upper()]
    figures = run_bench(BenchConfig(setup.robot, mode, steps=STEPS, warmup=WARMUP))
    period = 1e3 / figures["wanted_hz"]
    median, slow = figures["step_ms_median"], figures["step_ms_p99"]
    cores, load = os.cpu_count() or 1, os.getloadavg()[0]
    kept = {
        "period_ms": round(period, 2),
        "step_ms_median": round(median, 2),
        "step_ms_p99": round(slow, 2),
        "cores": cores,
        "load": round(load, 2),
    }
    text = (
        f"a plan for {setup.robot}, {setup.mode}, takes {median:.1f} ms of the {period:.0f} ms "
        f"that it has (1 in 100: {slow:.1f} ms; {cores} cores, load {load:.1f})"
    )
    busy = " Other programs are busy on this machine: end them first." if load > cores else ""
    if median > period:
        return Finding(
            Level.FAIL,
            text,
            "in real time plans come late: take fewer samples (--teleop.retargeter.num_samples), "
            "a lower rate (--teleop.retargeter.control_hz), --teleop.retargeter.type=direct, or "
            f"record in lock-step.{busy}",
            kept,
        )
    if slow > SHARE * period:
        return Finding(
            Level.WARN,
            text,
            "cameras and video encoding need time too: smaller pictures, or a lower "
            f"--teleop.retargeter.control_hz.{busy}",
            kept,
        )
    return Finding(Level.OK, text, "", kept)
