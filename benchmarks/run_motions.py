"""Run what operators do in their first hour, and judge what the robot does meanwhile.

    python -m benchmarks.run_motions --robot rby1 --motions turn_180,sidestep
    python -m benchmarks.run_motions --robot all --seeds 3 --noise off,mild --jobs 2 \
        --json outputs/motions.json
    python -m benchmarks.run_motions --robot g1 --ablations default,no_stance

Whole teleoperation in lock-step: a person with sway and tremor engages, moves and stands still
again. Errors are those of the robot's true head and hands from their goals, which with noisy
sensors lie in the estimate's world. A failing run is printed with its reasons, and the exit code
is 1 then. Runs that the JSON file holds already are not run again.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from benchmarks.motions import MOTIONS, Motion
from benchmarks.run_tasks import leave_out
from benchmarks.tracking import locate_frames
from benchmarks.tracking_report import Results
from benchmarks.tracking_setup import get_ablation
from xop_lerobot.core.command import Mode
from xop_lerobot.core.command_line import format_table, make_output_readable
from xop_lerobot.core.errors import UnknownName, XopError
from xop_lerobot.core.pool import run_jobs
from xop_lerobot.core.state import FRAMES
from xop_lerobot.core.transforms import quat_rotate
from xop_lerobot.evaluation.trial import closed_loop
from xop_lerobot.evaluation.trial_metrics import compute_feet
from xop_lerobot.morphology.morphology import Morphology, list_robots, make_morphology, say_robots
from xop_lerobot.operator.devices.config import DeviceConfig
from xop_lerobot.operator.devices.replay import Player
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.noise import HumanNoise
from xop_lerobot.plant.config import SimulationConfig
from xop_lerobot.plant.simulation import Simulation
from xop_lerobot.plant.watch import find_load_bearing
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.session import Tick
from xop_lerobot.teleoperation import TeleoperationConfig

AFTER_S = 1.0
"""Time after a motion's end at which errors of its end are taken [s]."""
WINDOW_S = 0.5
"""Time over which they are averaged [s]."""
MOST_TILT, MOST_CONTORTION = 15.0, 20.0
"""Largest error of the head's tilt where all of a motion is reachable, and largest tilt that nobody
asked for where not [deg]."""
MOST_HEAD = 5.0
"""Largest error of the head at the end [cm]."""
MOST_HAND = {"": 2.0, "g1": 4.0}
"""The same of each hand, by robot; ``""`` for every other one [cm]."""
MOST_FOOT = 2.0
"""How far feet or wheels may move in stationary mode [cm]."""
MOST_GAP = 0.2
"""How far a servo of the body may be behind its target [rad]."""

UP = np.array([0.0, 0.0, 1.0])


class MotionDevice(Player):
    """A person who does one motion, with sway and tremor.

    Args:
        motion: The motion.
        seed: Seed of the sway.
    """

    def __init__(self, motion: Motion, seed: int) -> None:
        super().__init__(DeviceConfig(type="scripted"))
        self.start_mode = motion.mode
        self.motion = motion
        self._noise = HumanNoise(seed)

    @property
    def duration(self) -> float:
        """Length of the motion [s]."""
        return self.motion.end

    def frame_at(self, stamp: float) -> OperatorFrame:
        """Frame at `stamp` [s] of the motion's clock."""
        return self._noise.disturb(self.motion.frame_at(stamp))


@dataclass
class Course:
    """What happened, one row for each tick after engaging.

    Attributes:
        time: Clock of the motion [s].
        qpos: True position of the robot. Shape (n, nq).
        goals: Goals of the tracked frames, nan while the robot has let go. Shapes (n, 7).
        command: Executed command. Shape (n, k).
        mode: Executed mode. Shape (n,).
        fallen: Whether the robot has fallen. Shape (n,).
        trouble: What the robot reports, in words. Length n.
        contacts: Collisions, as pairs of names.
    """

    time: np.ndarray
    qpos: np.ndarray
    goals: dict[str, np.ndarray]
    command: np.ndarray
    mode: np.ndarray
    fallen: np.ndarray
    trouble: list[str]
    contacts: tuple[tuple[str, str], ...]


def run_motion(robot: str, name: str, noise: str, seed: int) -> Course:
    """Do the motion `name` in front of a robot."""
    motion, morphology = MOTIONS[name], make_morphology(robot)
    plant = Simulation(morphology, SimulationConfig(noise=noise, seed=seed))
    config = TeleoperationConfig(retargeter=RetargeterConfig(threads=1, seed=seed))
    rows: list[tuple[Any, ...]] = []
    contacts = set[tuple[str, str]]()
    with closed_loop(plant, config, seed=seed) as (loop, teleoperation):
        teleoperation.connect()
        loop.reset(seed)
        device = teleoperation.device = MotionDevice(motion, seed)
        teleoperation.reset()
        engaged = False
        while (clock := device.elapsed(loop.state.time)) < motion.end + AFTER_S + WINDOW_S / 2:
            state = loop.state
            action, tick = teleoperation.step(Tick(state))
            executed = loop.execute(action, teleoperation.dt)
            engaged = engaged or tick.engaged
            if engaged:
                wanted = {} if tick.goal is None else tick.goal.poses
                rows.append(
                    (
                        clock,
                        state.true_qpos,
                        *(wanted.get(frame, np.full(7, np.nan)) for frame in FRAMES),
                        executed.command,
                        int(executed.mode),
                        state.fallen,
                        state.trouble,
                    )
                )
                contacts.update(loop.plant.measure().contacts)
            if state.fallen:
                break
    time, qpos, head, left, right, command, mode, fallen, trouble = zip(*rows, strict=True)
    goals: dict[str, np.ndarray] = {
        name: np.array(track) for name, track in zip(FRAMES, (head, left, right), strict=True)
    }
    return Course(
        np.array(time),
        np.array(qpos),
        goals,
        np.array(command),
        np.array(mode),
        np.array(fallen),
        list(trouble),
        tuple(sorted(contacts)),
    )


def measure(morphology: Morphology, motion: Motion, course: Course) -> dict[str, Any]:
    """Figures of a run, fit for JSON; what never came is None."""
    frames = locate_frames(morphology, course.qpos)
    distance = {
        name: 100 * np.linalg.norm(frames[name][:, :3] - course.goals[name][:, :3], axis=1)
        for name in FRAMES
    }
    up, wanted = (quat_rotate(poses[:, 3:], UP) for poses in (frames["head"], course.goals["head"]))
    tilt, contortion = compute_tilts(up, wanted)
    after = np.abs(course.time - motion.end - AFTER_S) <= WINDOW_S / 2
    feet = compute_feet(morphology, course.qpos)[:, :, :2]
    standing = course.mode == Mode.STATIONARY
    troubles = [i for i, text in enumerate(course.trouble) if text]
    figures = {
        "fallen": bool(course.fallen.any()),
        "gap_rad": _compute_gap(morphology, course),
        "tilt_deg": _reduce(np.max, tilt),
        "tilt_mean_deg": _reduce(np.mean, tilt),
        "contortion_deg": _reduce(np.max, contortion),
        "head_cm": _reduce(np.mean, distance["head"]),
        "head_max_cm": _reduce(np.max, distance["head"]),
        "head_end_cm": _reduce(np.mean, distance["head"][after]),
        "hand_max_cm": _reduce(np.max, [distance[name] for name in FRAMES[1:]]),
        "hand_end_cm": _reduce(np.max, [_mean(distance[name][after]) for name in FRAMES[1:]]),
        "lowest_cm": float(100 * frames["head"][:, 2].min()),
        "foot_cm": _compute_foot_motion(feet, standing),
        "contacts": [" - ".join(pair) for pair in course.contacts],
        "trouble": course.trouble[troubles[0]] if troubles else "",
    }
    return figures


def compute_tilts(up: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Error of the head's tilt, and how far it is tilted as nobody asked for [deg].

    The second is the angle to the nearest tilt between upright and the one that is wanted: a robot
    that cannot bow as far as its operator has an error, but is not contorted.

    Args:
        up: Direction out of the top of the robot's head. Shape (n, 3).
        wanted: The same of its goal. Shape (n, 3).
    """
    error = np.arccos(np.clip((up * wanted).sum(axis=1), -1, 1))
    angle = np.arccos(np.clip(wanted[:, 2], -1, 1))
    aside = wanted - UP * wanted[:, 2:]
    aside /= np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-9)
    shares = np.linspace(0, 1, 21)[:, None, None] * angle[:, None]
    between = np.cos(shares) * UP + np.sin(shares) * aside
    nearest = np.arccos(np.clip((up * between).sum(axis=-1), -1, 1)).min(axis=0)
    return np.degrees(error), np.degrees(nearest)


def _mean(values: np.ndarray) -> float:
    values = values[np.isfinite(values)]
    return float(values.mean()) if values.size else float("nan")


def _reduce(reduce: Any, values: Any) -> float | None:
    finite = np.asarray(values)[np.isfinite(values)]
    return float(reduce(finite)) if finite.size else None


def _compute_gap(morphology: Morphology, course: Course) -> float:
    """Largest distance of a stiff servo of the posture behind its target [rad]."""
    if morphology.servos is None:
        return 0.0
    model = morphology.build_spec("planning").compile()
    columns, addresses = find_load_bearing(morphology, model)
    return float(np.abs(course.command[:, columns] - course.qpos[:, addresses]).max())


def _compute_foot_motion(feet: np.ndarray, standing: np.ndarray) -> float | None:
    """How far feet stray from where they were a second after the last change to standing [cm].

    Args:
        feet: Place of each foot. Shape (n, f, 2).
        standing: Whether the mode is stationary. Shape (n,).
    """
    if not standing.any() or not feet.size:
        return None
    walked = np.flatnonzero(~standing)
    first = 0 if not walked.size else int(walked[-1]) + 26  # the last step is still taken
    if first >= len(feet):
        return None
    return float(100 * np.linalg.norm(feet[first:] - feet[first], axis=2).max())


def find_faults(robot: str, motion: Motion, figures: dict[str, Any]) -> list[str]:
    """What of a run is a fault, in words; none in a good one."""
    reachable = motion.is_reachable(robot)
    kind, most = ("tilt_deg", MOST_TILT) if reachable else ("contortion_deg", MOST_CONTORTION)
    faults = []
    if figures["fallen"]:
        faults.append("fell")
    if figures["gap_rad"] > MOST_GAP:
        faults.append(f"servo {figures['gap_rad']:.2f} rad behind")
    if (figures[kind] or 0) > most:
        faults.append(f"tilt {figures[kind]:.0f}°")
    if motion.ends_within or reachable:
        if (figures["head_end_cm"] or 0) > MOST_HEAD:
            faults.append(f"head {figures['head_end_cm']:.1f} cm at the end")
        if (figures["hand_end_cm"] or 0) > MOST_HAND.get(robot, MOST_HAND[""]):
            faults.append(f"hand {figures['hand_end_cm']:.1f} cm at the end")
    if (figures["foot_cm"] or 0) > MOST_FOOT:
        faults.append(f"feet {figures['foot_cm']:.1f} cm")
    if figures["contacts"]:
        faults.append("touches: " + ", ".join(figures["contacts"][:3]))
    if figures["trouble"]:
        faults.append(figures["trouble"])
    return faults


type Job = tuple[str, str, str, str, int]


def make_key(job: Job) -> str:
    """Name of a run: robot, motion, ablation, noise and seed."""
    return "/".join(map(str, job))


def run_job(job: Job) -> dict[str, Any]:
    """Do one run; returns its record, fit for JSON."""
    robot, name, ablation, noise, seed = job
    start = perf_counter()
    with leave_out(get_ablation(ablation), robot):
        course = run_motion(robot, name, noise, seed)
    figures = measure(make_morphology(robot), MOTIONS[name], course)
    faults = find_faults(robot, MOTIONS[name], figures)
    return {"figures": figures, "faults": faults, "wall_s": round(perf_counter() - start, 1)}


def make_summary(jobs: Sequence[Job], runs: dict[str, dict[str, Any]]) -> str:
    """A row for each robot, ablation and noise: runs without fault, and what is at fault."""
    groups: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for job in jobs:
        groups.setdefault((job[0], job[2], job[3]), []).append(runs[make_key(job)])
    rows = []
    for (robot, ablation, noise), records in groups.items():
        figures = [record["figures"] for record in records]

        def count(kind: str, records: list[dict[str, Any]] = records) -> str:
            return str(sum(any(f.startswith(kind) for f in r["faults"]) for r in records))

        rows.append(
            [
                robot, ablation, noise, str(len(records)),
                str(sum(not record["faults"] for record in records)),
                *(count(kind) for kind in
                  ("fell", "servo", "tilt", "head", "hand", "feet", "touches")),
                f"{np.mean([each['head_cm'] or 0 for each in figures]):.2f}",
                f"{np.mean([each['tilt_mean_deg'] or 0 for each in figures]):.2f}",
            ]
        )  # fmt: skip
    heads = ["robot", "left out", "noise", "runs", "faultless", "fell", "servo", "tilt", "head",
             "hand", "feet", "touches", "head mean [cm]", "tilt mean [deg]"]  # fmt: skip
    return format_table(heads, rows)


def parse_args(arguments: list[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--robot", default="g1", help=f"{say_robots()}, or all (default: g1)")
    add("--motions", default="all", help=f"names with commas: {', '.join(MOTIONS)}")
    add("--ablations", default="default", help="names with commas, as of run_tracking")
    add("--noise", default="off", help="sensor noise, with commas (default: off)")
    add("--seeds", type=int, default=1, help="number of seeds (default: 1)")
    add("--first-seed", type=int, default=0, help="the first of them (default: 0)")
    add("--jobs", type=int, default=1, help="processes, one thread each (default: 1)")
    add("--json", type=Path, help="results, added to what it holds; also resumes")
    return parser.parse_args(arguments)


def make_jobs(args: argparse.Namespace) -> list[Job]:
    """Every run that is asked for.

    Raises:
        UnknownName: If a robot, a motion or an ablation is unknown.
    """
    robots = list(list_robots()) if args.robot == "all" else args.robot.split(",")
    names = list(MOTIONS) if args.motions == "all" else args.motions.split(",")
    for name in names:
        if name not in MOTIONS:
            raise UnknownName("motion", name, MOTIONS)
    for robot in robots:
        make_morphology(robot)
    for name in args.ablations.split(","):
        get_ablation(name)
    return [
        (robot, name, ablation, noise, seed)
        for seed in range(args.first_seed, args.first_seed + args.seeds)
        for ablation in args.ablations.split(",")
        for noise in args.noise.split(",")
        for robot in robots
        for name in names
    ]


def main(arguments: list[str] | None = None) -> int:
    """Run the motions; returns 1 if a run has a fault."""
    args = parse_args(arguments)
    results = Results(args.json)
    try:
        jobs = make_jobs(args)
        missing = [job for job in jobs if make_key(job) not in results.runs]
        for result in run_jobs(run_job, missing, args.jobs):
            if result.error:
                raise XopError(f"{make_key(result.job)}: {result.error}")
            results.add(make_key(result.job), result.value)
            faults = "; ".join(result.value["faults"]) or "good"
            print(f"{make_key(result.job)}: {faults}", flush=True)
    except XopError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"\n{make_summary(jobs, results.runs)}")
    return int(any(results.runs[make_key(job)]["faults"] for job in jobs))


if __name__ == "__main__":
    make_output_readable()
    sys.exit(main())
