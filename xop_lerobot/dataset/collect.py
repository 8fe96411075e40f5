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
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from xop_lerobot.command_line import CommandParser
from xop_lerobot.dataset.collect_config import CollectConfig
from xop_lerobot.dataset.collect_folder import CollectFolder
from xop_lerobot.dataset.collect_jobs import WorkerFailed
from xop_lerobot.dataset.collect_run import run_collection
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
    config: CollectConfig,
    root: Path,
    episodes: int,
    repo_id: str = "",
    workers: int = 0,
    ray: str = "",
) -> CollectResult:
    """Collect a dataset, or what is missing of it.

    Args:
        config: What is collected.
        root: Directory of the dataset.
        episodes: How many episodes there shall be.
        repo_id: Name of the dataset; empty for `local/` and the directory's name.
        workers: Number of workers; 0 for one for each core.
        ray: Address of a Ray cluster that makes them; empty for processes of this machine.

    Raises:
        XopError: If a setting is not valid, the directory is taken, or an episode fails.
    """
    for name, value, low in (("episodes", episodes, 1), ("workers", workers, 0)):
        if value < low:
            raise BadValue(f"{name} must be at least {low}, got {value}")
    config.check()
    folder = CollectFolder(root)
    collection = run_collection(
        config, folder, range(episodes), repo_id=repo_id, workers=workers, ray=ray
    )
    attempts = collection.attempts
    if not folder.root.exists():
        print(f"no episode succeeded: '{root}' is not made", file=sys.stderr)
    return CollectResult(
        episodes=len(attempts),
        successes=sum(attempt.success for attempt in attempts),
        frames=sum(attempt.frames for attempt in attempts if attempt.kept),
        sim_s=round(sum(attempt.frames for attempt in attempts) / config.fps, 3),
        wall_s=round(collection.wall_s, 3),
        root=str(root),
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
    add_crew(parser)
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


def add_crew(parser: CommandParser) -> None:
    """Add `--workers` and `--ray`, which say who makes the episodes."""
    parser.add_argument(
        "--workers", type=int, default=0, help="processes; 0: one per core (default: 0)"
    )
    parser.add_argument(
        "--ray",
        default="",
        metavar="ADDRESS",
        help="make the episodes on a Ray cluster: local, auto, HOST:PORT or ray://HOST:PORT "
        "(default: none)",
    )


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
            result = collect(config, args.root, args.episodes, args.repo_id, args.workers, args.ray)
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
