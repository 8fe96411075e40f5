r"""`xop-collect`: unattended collection of LeRobot datasets with success labels.

    xop-collect --robot g1 --task box_pick_and_place --episodes 50 --seed 0 \
        --root outputs/boxes --repo-id me/boxes

A simulated operator repeats the task, headless, in one process per core. Episode i is the same for
any number of processes. Ctrl-C, SIGTERM and `kill -9` lose only unfinished episodes: the same
command resumes, and with more `--episodes` it extends a dataset. The last line of standard output
is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from xop_lerobot.collect.config import CollectConfig, add_config, add_worker_flags, read_config
from xop_lerobot.collect.folder import CollectFolder
from xop_lerobot.collect.run import WorkerFailed, run_collection
from xop_lerobot.core.command_line import INTERRUPTED, CommandParser, make_output_readable
from xop_lerobot.core.errors import BadValue, XopError
from xop_lerobot.core.shutdown import stop_on_sigterm
from xop_lerobot.morphology.morphology import read_robot, say_robots


@dataclass(frozen=True)
class CollectResult:
    """Outcome of a collection.

    Attributes:
        episodes: Number of episodes of this and all earlier runs.
        successes: Number of successful ones.
        frames: Frames of the dataset.
        sim_s: Simulated time of all episodes, without settling [s].
        wall_s: Duration of all runs, each killed one until its last finished episode [s].
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
    """Collect a dataset, or its missing episodes.

    Args:
        config: Configuration.
        root: Directory of the dataset.
        episodes: Total number of episodes.
        repo_id: Name of the dataset; empty for `local/` and the directory's name.
        workers: Number of workers; 0 for one per core.
        ray: Address of a Ray cluster; empty for processes of this machine.

    Raises:
        XopError: If a setting is invalid, the directory is taken, or an episode fails.
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
        print(f"no episode succeeded: '{root}' was not written", file=sys.stderr)
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
    add = parser.add_argument
    add("--robot", required=True, type=read_robot, help=f"robot: {say_robots()}")
    add(
        "--task",
        required=True,
        help="dual_point_touch, dual_point_reach, box_pick_and_place or non_prehensile_transport",
    )
    add("--episodes", required=True, type=int, help="total number of episodes")
    add("--root", required=True, type=Path, help="directory of the dataset")
    add(
        "--repo-id",
        default="",
        help="name of the dataset; empty: local/<directory> (default: none)",
    )
    add_worker_flags(parser)
    add_config(parser)
    device = CollectConfig.device
    add(
        "--device",
        default=device,
        help=f"operator device: simulated, or one of a plugin (default: {device})",
    )
    add("--only-successful", action="store_true", help="do not save failed episodes")
    return parser


def parse_arguments(arguments: Sequence[str]) -> tuple[CollectConfig, argparse.Namespace]:
    """Read the command line.

    Raises:
        BadValue: If a flag is missing or malformed.
        UnknownName: If one is unknown, listing the known ones.
    """
    args = make_parser().parse(arguments)
    return read_config(CollectConfig, args), args


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `xop-collect`; returns the exit code."""
    make_output_readable()
    args = None
    try:
        config, args = parse_arguments(sys.argv[1:] if arguments is None else arguments)
        with stop_on_sigterm():
            result = collect(config, args.root, args.episodes, args.repo_id, args.workers, args.ray)
    except KeyboardInterrupt:
        print("interrupted; run the same command again to resume", file=sys.stderr)
        return INTERRUPTED
    except XopError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1 if isinstance(error, WorkerFailed) else 2
    except OSError as error:  # a full disk, for example
        print(f"error: {error}. Run the same command again to resume", file=sys.stderr)
        return 1
    print(json.dumps(vars(result)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
