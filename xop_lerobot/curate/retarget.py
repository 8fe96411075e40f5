"""Replay recorded operators in simulation, with another robot, retargeter or low-level policy.

The operator's motion is read from `operator.*`; everything else is simulated and recorded again, as
by `xop-record`. So a session with one robot becomes a session with another, with other weights, or
with another low-level policy. Recordings of hardware work, too: where tracking was lost or the
operator disengaged, the new robot holds, and clocks may jitter.

    xop-curate retarget --root outputs/g1 --out outputs/rby1 --robot rby1

The same flags and source give the same rows with any number of workers, except for `time.wall` and
the solve times in `retargeter.health`. The command may be killed at any moment: until it is
complete, the dataset is in `<out>.collecting`, and the same command resumes with the missing
episodes. More `--episodes` extend a dataset. Every episode's `provenance` names its source episode.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from xop_lerobot.collect.config import add_config, add_worker_flags, read_config
from xop_lerobot.collect.folder import CollectFolder
from xop_lerobot.collect.run import Collection, run_collection
from xop_lerobot.core.command_line import INTERRUPTED, CommandParser, format_table, say_count
from xop_lerobot.core.errors import BadDataset, BadValue, XopError
from xop_lerobot.core.folders import FolderTaken, write_whole
from xop_lerobot.curate.arguments import add_source, parse_episodes
from xop_lerobot.curate.clip import PROVENANCE, Step, name_source
from xop_lerobot.curate.retarget_job import (
    DEFAULT_FPS,
    Operators,
    RetargetConfig,
    RetargetJob,
    choose_fps,
    read_settings,
    read_weights,
)
from xop_lerobot.curate.source import EpisodeEntry, Source
from xop_lerobot.morphology.morphology import read_robot, say_robots
from xop_lerobot.recording.facts import FACTS_DIR

SUMMARY = "replay recorded operators with another robot, retargeter or policy"

_FIGURES = {
    "duration": "time [s]",
    "tracking_head_mean": "head [m]",
    "tracking_head_p95": "95 % [m]",
    "tracking_left_wrist_mean": "left [m]",
    "tracking_right_wrist_mean": "right [m]",
    "fall": "fall",
    "collision": "collision",
}
"""Metrics shown for the new episodes, and their column heads."""


class RetargetFolder(CollectFolder):
    """Files of a retargeting in progress."""

    command = "xop-curate retarget"
    flag = "--out"
    record = FACTS_DIR / "retarget.json"


def add_arguments(parser: CommandParser) -> None:
    """Add the verb's flags."""
    add_source(parser)
    add = parser.add_argument
    add(
        "--out",
        type=Path,
        metavar="DIR",
        help="directory of the new dataset; the source is not changed",
    )
    add("--dry-run", action="store_true", help="report what would be replayed, without replaying")
    add("--robot", required=True, type=read_robot, help=f"robot: {say_robots()}")
    add(
        "--episodes",
        type=parse_episodes,
        metavar="LIST",
        help="episodes of the source, such as 0,3,8-11 (default: all)",
    )
    add(
        "--hold",
        type=float,
        default=RetargetConfig.hold_s,
        dest="hold_s",
        metavar="S",
        help="time the last posture is held for the robot to arrive [s] "
        f"(default: {RetargetConfig.hold_s:g})",
    )
    add(
        "--task",
        default="",
        metavar="NAME",
        help="task whose scene is set up and whose success is judged (default: none)",
    )
    settings = {"nargs": "+", "action": "extend", "default": [], "metavar": "KEY=VALUE"}
    add(
        "--weights",
        type=_read_weight,
        help="cost weights that override the preset's, such as position=2 (default: none)",
        **settings,
    )
    add(
        "--retargeter",
        type=_read_retargeter,
        help="settings of --teleop.retargeter, such as horizon=40 (default: none)",
        **settings,
    )
    add(
        "--alignment",
        type=_read_alignment,
        help="settings of --teleop.alignment, such as walk_scale=0.8 (default: none)",
        **settings,
    )
    add_worker_flags(parser)
    add_config(
        parser,
        RetargetConfig,
        fps="rate of control and dataset [Hz]; divides 50 "
        f"(default: the source's, {DEFAULT_FPS} if that does not)",
    )
    parser.set_defaults(fps=0)
    add("--json", type=Path, metavar="FILE", help="write the metrics of each episode as JSON")


def _read_weight(pair: str) -> dict[str, Any]:
    return dict(read_weights([pair]))


def _read_retargeter(pair: str) -> dict[str, Any]:
    from xop_lerobot.retarget.config import RetargeterConfig  # noqa: PLC0415

    return read_settings(RetargeterConfig, "setting of the retargeter", [pair])


def _read_alignment(pair: str) -> dict[str, Any]:
    from xop_lerobot.operator.alignment import AlignmentConfig  # noqa: PLC0415

    return read_settings(AlignmentConfig, "setting of the alignment", [pair])


def run(arguments: argparse.Namespace) -> int:
    """Retarget a dataset; returns the exit code."""
    if arguments.out is None and not arguments.dry_run:
        raise BadValue("missing output: pass --out=DIR, or --dry-run")
    if arguments.json is not None and not arguments.json.resolve().parent.is_dir():
        raise BadValue(f"--json: there is no directory '{arguments.json.parent}'")
    if arguments.workers < 0:
        raise BadValue(f"--workers must be at least 0, got {arguments.workers}")
    with Source(arguments.root) as source:
        config = make_config(arguments, source)
        config.check()
        chosen = choose_episodes(source, arguments.episodes)
        operators = Operators(source, make_step(config))
        if arguments.out is None or arguments.dry_run:
            show_plan(operators.read(chosen))
            return 0
        folder = RetargetFolder(arguments.out)
        check_apart(source, folder)
        try:
            collection = run_collection(
                config,
                folder,
                chosen,
                workers=arguments.workers,
                ray=arguments.ray,
                quiet=arguments.quiet,
                make_jobs=operators.read,
            )
        except KeyboardInterrupt:
            print("interrupted; run the same command again to resume", file=sys.stderr)
            return INTERRUPTED
    report(folder.root, collection, arguments.json)
    return 0


def make_config(arguments: argparse.Namespace, source: Source) -> RetargetConfig:
    """Make the configuration from the flags."""
    settings = {
        name: {key: value for pair in getattr(arguments, name) for key, value in pair.items()}
        for name in ("weights", "retargeter", "alignment")
    }
    return read_config(
        RetargetConfig,
        arguments,
        fps=choose_fps(arguments.fps, source.fps),
        source=str(source.root.resolve()),
        name=name_source(source.root),
        **settings,
    )


def make_step(config: RetargetConfig) -> Step:
    """Make the step for the provenance, with all settings that differ from their defaults."""
    given = {
        each.name: getattr(config, each.name)
        for each in dataclasses.fields(config)
        if each.name not in ("source", "name", "device", "plugins")
    }
    usual = {each.name: each.default for each in dataclasses.fields(config)}
    changed = {name: value for name, value in given.items() if value and value != usual[name]}
    return Step.now("retarget", **{**changed, "robot": config.robot, "fps": config.fps})


def choose_episodes(source: Source, wanted: Sequence[int] | None) -> list[int]:
    """Choose the wanted episodes of a source, or all.

    Raises:
        BadDataset: If it has none, or lacks a wanted one.
    """
    there = [entry.index for entry in source.episodes]
    if not there:
        raise BadDataset(source.root, "it has no episodes")
    missing = [index for index in wanted or () if index not in set(there)]
    if missing:
        raise BadDataset(
            source.root,
            f"it has no episode {', '.join(map(str, missing))} (it has {len(there)}, "
            f"{there[0]} to {there[-1]})",
        )
    return there if wanted is None else list(wanted)


def check_apart(source: Source, folder: CollectFolder) -> None:
    """Check that the new dataset and the source do not lie inside each other.

    Raises:
        FolderTaken: If they do.
    """
    held = source.root.resolve()
    if folder.root.is_relative_to(held) or held.is_relative_to(folder.root):
        raise FolderTaken(
            f"'{folder.root}' and the dataset '{source.root}' must not contain each other. Choose "
            f"another {folder.flag}"
        )


def show_plan(jobs: Iterable[RetargetJob]) -> None:
    """Print what would be replayed."""
    episodes, seconds = 0, 0.0
    for job in jobs:
        if job.recording is None:
            print(f"episode {job.index}: left out ({job.fault})")
            continue
        episodes, seconds = episodes + 1, seconds + job.recording.duration
        print(f"episode {job.index}: {job.recording.duration:.1f} s of '{job.tasks[0][1]}'")
    print(f"{say_count(episodes, 'episode')}, {seconds:.1f} s would be replayed")


def report(root: Path, collection: Collection, path: Path | None) -> None:
    """Print the metrics of the new episodes, and write them as JSON to `path`, if given.

    Raises:
        XopError: If there are no new episodes.
    """
    from xop_lerobot.curate.survey import survey  # noqa: PLC0415 scipy

    left_out = {each.index: each.failure for each in collection.attempts if not each.kept}
    for index, fault in left_out.items():
        print(f"episode {index} of the source is left out: {fault}", file=sys.stderr)
    if not root.exists():
        raise XopError("no operator could be replayed, so no dataset is made")
    names = ("episode", *_FIGURES)
    with Source(root) as made:
        rows = [
            {
                "source_episode": find_origin(finding.entry),
                **{name: finding.figures[name] for name in names},
            }
            for finding in survey(made, names)
        ]
    heads = ("source", "episode", *_FIGURES.values())
    print(format_table(heads, [[_show(value) for value in row.values()] for row in rows]))
    print(f"{say_count(len(rows), 'episode')} in '{root}', made in {collection.wall_s:.0f} s")
    if path is not None:
        document = {"root": str(root), "episodes": rows, "left_out": left_out}
        write_whole(path, {**document, "wall_s": round(collection.wall_s, 3)})


def find_origin(entry: EpisodeEntry) -> int | None:
    """Return the source episode of an episode by its provenance; None if unknown."""
    provenance = entry.facts.get(PROVENANCE)
    last = provenance[-1] if isinstance(provenance, list) and provenance else {}
    return last.get("source_episode") if isinstance(last, Mapping) else None


def _show(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.3f}"
    return "-" if value is None else {"True": "yes", "False": "no"}.get(str(value), str(value))
