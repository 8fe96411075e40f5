r"""`xop-collect`: tasks as LeRobot datasets, with success labels and without anybody there.

    xop-collect --robot g1 --task box_pick_and_place --episodes 50 --seed 0 \
        --root outputs/boxes --repo-id me/boxes

A simulated operator does the task over and over, headless and in as many processes as there are
cores. Episode i is the same whatever their number. Ctrl-C, SIGTERM and `kill -9` lose only the
episodes under way: the same command again goes on, and with more `--episodes` adds to a dataset.
The last line of standard output is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from xop_lerobot.command_line import CommandParser
from xop_lerobot.dataset.collect_config import CollectConfig
from xop_lerobot.dataset.collect_folder import Attempt, CollectFolder
from xop_lerobot.dataset.collect_pool import ENVIRONMENT, WorkerFailed, make_episodes
from xop_lerobot.dataset.shutdown import stop_on_sigterm
from xop_lerobot.errors import BadValue, XopError

INTERRUPTED = 130
"""Exit status after Ctrl-C or SIGTERM."""


@dataclass(frozen=True)
class CollectResult:
    """What there is in the end.

    Attributes:
        episodes: Episodes that were run, of this and of all runs before.
        successes: Those in which the task was accomplished.
        frames: Frames of the dataset.
        sim_s: Simulated time of all episodes, without the settling before them [s].
        wall_s: Time that all runs took, each killed one until its last finished episode [s].
        root: Directory of the dataset.
    """

    episodes: int
    successes: int
    frames: int
    sim_s: float
    wall_s: float
    root: str


def collect(
    config: CollectConfig, root: Path, episodes: int, repo_id: str = "", workers: int = 0
) -> CollectResult:
    """Collect a dataset, or what is missing of it.

    Args:
        config: What is collected.
        root: Directory of the dataset.
        episodes: How many episodes there shall be.
        repo_id: Name of the dataset; empty for `local/` and the directory's name.
        workers: Processes; 0 for one per core.

    Raises:
        XopError: If a setting is not valid, the directory is taken, or an episode fails.
    """
    begin, start = time.time(), time.perf_counter()
    for name, value, low in (("episodes", episodes, 1), ("workers", workers, 0)):
        if value < low:
            raise BadValue(f"{name} must be at least {low}, got {value}")
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    config.check()
    settings = config.to_settings()
    folder = CollectFolder(root)
    with folder.hold(settings):
        done = folder.list_attempts()
        missing = [index for index in range(episodes) if index not in done]
        progress = _Progress(episodes, len(missing), config.fps)
        if done:
            progress.note_found(done)
        crew = workers or len(os.sched_getaffinity(0))
        # Closed at once, whatever happens: no worker may outlive the hold on the folder.
        with closing(make_episodes(config, folder, missing, crew, begin)) as attempts:
            for attempt in attempts:
                done[attempt.index] = attempt
                progress.note(attempt)
        walls = _compute_walls(folder, done)

        def note_walls() -> dict[str, float]:
            return walls | {str(begin): time.perf_counter() - start}

        merged = folder.read_dataset()
        if any(index < episodes for index in folder.read_attempts()):
            from xop_lerobot.dataset.collect_merge import merge_attempts  # noqa: PLC0415 torch

            print("putting the episodes together", file=sys.stderr)
            repo_id = repo_id or f"local/{root.name}"
            merge_attempts(folder, episodes, repo_id, settings, note_walls)
            merged, walls = folder.read_dataset(), note_walls()
        if not merged:
            print(f"no episode succeeded: '{root}' is not made", file=sys.stderr)
        counted = [Attempt(**row) for row in merged.get("attempts", ())]
        counted = counted or [done[index] for index in range(episodes)]
    return CollectResult(
        episodes=len(counted),
        successes=sum(attempt.success for attempt in counted),
        frames=sum(attempt.frames for attempt in counted if attempt.kept),
        sim_s=round(sum(attempt.frames for attempt in counted) / config.fps, 3),
        wall_s=round(sum(walls.values()), 3),
        root=str(root),
    )


def _compute_walls(folder: CollectFolder, attempts: dict[int, Attempt]) -> dict[str, float]:
    """Compute how long each run took [s], by its start; a killed one until its last episode."""
    walls: dict[str, float] = dict(folder.read_dataset().get("walls", {}))
    for attempt in attempts.values():
        run = str(attempt.run)
        walls[run] = max(walls.get(run, 0.0), attempt.elapsed)
    return walls


class _Progress:
    """Says on standard error how far it is.

    Args:
        episodes: How many episodes there shall be.
        missing: How many of them are still to be made.
        fps: Frames per second of simulated time [Hz].
    """

    def __init__(self, episodes: int, missing: int, fps: int) -> None:
        self._episodes, self._missing, self._fps = episodes, missing, fps
        self._start = time.perf_counter()
        self._made = self._frames = self._successes = 0

    def note_found(self, attempts: dict[int, Attempt]) -> None:
        """Say what was there already."""
        print(f"{len(attempts)} episodes are there already", file=sys.stderr)

    def note(self, attempt: Attempt) -> None:
        """Say what came of one episode."""
        self._made += 1
        self._frames += attempt.frames
        self._successes += attempt.success
        elapsed = time.perf_counter() - self._start
        left = elapsed / self._made * (self._missing - self._made)
        outcome = "success" if attempt.success else attempt.failure or "no success"
        print(
            f"episode {attempt.index}: {outcome}, {attempt.frames / self._fps:.1f} s. "
            f"{self._made} of {self._missing} made, {self._successes} succeeded, "
            f"{self._frames / self._fps / elapsed:.2f} x real time, {left / 60:.1f} min left",
            file=sys.stderr,
        )


def make_parser() -> CommandParser:
    """Make the parser of the command line."""
    parser = CommandParser("xop-collect", __doc__)
    defaults = {each.name: each.default for each in fields(CollectConfig)}

    def add(name: str, text: str, **options: Any) -> None:
        key = name.replace("-", "_")
        if key in defaults and not options.get("required") and "action" not in options:
            options["default"] = defaults[key]
        if not options.get("required") and "default" in options:
            shown = options["default"]
            shown = ",".join(shown) if isinstance(shown, tuple) else shown
            text = f"{text} (default: {shown or 'none'})" if shown != 0 else f"{text} (default: 0)"
        parser.add_argument(f"--{name}", help=text, **options)

    add("robot", "robot: g1 or rby1", required=True)
    add("task", "dual_point_touch, box_pick_and_place or non_prehensile_transport", required=True)
    add("episodes", "how many episodes there shall be", required=True, type=int)
    add("root", "directory of the dataset", required=True, type=Path)
    add("repo-id", "name of the dataset; empty: local/<directory>", default="")
    add("seed", "seed of all that is random", type=int)
    add("workers", "processes; 0: one per core", type=int, default=0)
    add("cameras", "cameras, with commas between", type=_split)
    add("low-level", "low-level policy; default: the robot's own")
    add("low-level-path", "file of the low-level policy; empty: its default")
    add("fps", "rate of control and dataset [Hz]; divides 50", type=int)
    add("width", "width of a picture [pixel]", type=int)
    add("height", "height of a picture [pixel]", type=int)
    add("noise", "noise of the sensors: off, mild or harsh")
    add("method", "mpc, mpc_no_sync, mpc_table1, direct or direct_amo")
    add("variant", "binding, constraints and preset with _ between, such as v2_upright")
    add("scene", "scene; empty: the task's own")
    add("device", "operator device: simulated, or one of a plugin")
    add("plugins", "modules to import first, with commas between", type=_split)
    add("only-successful", "leave episodes without success out", action="store_true")
    add("images", "store pictures as PNG and not as h264 video", action="store_true")
    return parser


def _split(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.strip("[] ").split(",") if name.strip())


def parse_arguments(arguments: Sequence[str]) -> tuple[CollectConfig, argparse.Namespace]:
    """Read the command line.

    Raises:
        BadValue: If a flag is absent or malformed.
        UnknownName: If one is unknown, listing the known ones.
    """
    args = make_parser().parse(arguments)
    names = {each.name for each in fields(CollectConfig)} - {"video"}
    values = {name: getattr(args, name) for name in names}
    return CollectConfig(**values, video=not args.images), args


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `xop-collect`; returns the exit code."""
    args = None
    try:
        config, args = parse_arguments(sys.argv[1:] if arguments is None else arguments)
        with stop_on_sigterm():
            result = collect(config, args.root, args.episodes, args.repo_id, args.workers)
    except KeyboardInterrupt:
        print("stopped; the same command goes on with the finished episodes", file=sys.stderr)
        return INTERRUPTED
    except XopError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1 if isinstance(error, WorkerFailed) else 2
    print(json.dumps(vars(result)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
