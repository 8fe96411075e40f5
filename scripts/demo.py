"""Record and show one scripted episode of each robot with stock LeRobot; run by `make demo`.

    make demo
    .venv/bin/python scripts/demo.py --robots g1 --out outputs/demo

For each robot, `lerobot-record` writes a dataset, `LeRobotDataset` loads it back, and the episode
is shown as a table, a strip of images, a video and a GIF.
"""

from __future__ import annotations

import argparse
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from xop_lerobot.core.command_line import make_output_readable
from xop_lerobot.core.errors import UnknownName, XopError

ROOT = Path(__file__).resolve().parent.parent
FPS = 25
CAMERAS = ("head", "scene")
TAIL_LINES = 30
"""Lines of a failed recording's output in the error message."""


@dataclass(frozen=True)
class Demo:
    """One demo episode.

    Attributes:
        robot: Name of the robot, also that of its dataset's folder.
        script: Built-in script of the operator.
        task: Task description in the dataset.
        episode_s: Duration: settling, the script, and a rest at its end [s].
    """

    robot: str
    script: str
    task: str
    episode_s: float


DEMOS = {
    "g1": Demo("g1", "g1_squat_walk_reach", "squat, walk, turn and reach", 20.0),
    "rby1": Demo("rby1", "rby1_drive_reach", "drive, turn, reach and lean", 21.0),
}


class DemoError(XopError):
    """A recording failed; the message contains its exit status and the end of its output."""


def build_command(demo: Demo, root: Path) -> list[str]:
    """Build the `lerobot-record` command of `demo`, writing the dataset to `root`."""
    return [
        "lerobot-record",
        f"--robot.type=xop_{demo.robot}",
        f"--robot.cameras=[{','.join(CAMERAS)}]",
        "--teleop.type=xop",
        "--teleop.device.type=scripted",
        f"--teleop.device.path={demo.script}",
        f"--dataset.repo_id=local/xop_{demo.robot}_demo",
        f"--dataset.root={root}",
        f"--dataset.single_task={demo.task}",
        "--dataset.num_episodes=1",
        f"--dataset.episode_time_s={demo.episode_s:g}",
        "--dataset.reset_time_s=0",
        f"--dataset.fps={FPS}",
        # The only encoder settings that keep real time on two cores.
        "--dataset.streaming_encoding=true",
        "--dataset.rgb_encoder.vcodec=h264",
        "--dataset.rgb_encoder.preset=ultrafast",
        "--dataset.encoder_queue_maxsize=120",
        "--dataset.push_to_hub=false",
        "--dataset.no_stamp=true",
        "--play_sounds=false",
    ]


def build_environment(out: Path, environment: Mapping[str, str]) -> dict[str, str]:
    """Build a recording's environment: no display, no network, no files in the home folder.

    Variables of `environment` take precedence.
    """
    return {
        "MUJOCO_GL": "egl",
        "HF_HUB_OFFLINE": "1",
        "HF_LEROBOT_HOME": str(out / ".lerobot"),
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        **environment,
    }


def move_aside(root: Path) -> Path | None:
    """Rename an existing dataset at `root` to the first free `root.N`; returns the new path."""
    if not root.exists():
        return None
    number = 1
    while (aside := root.with_name(f"{root.name}.{number}")).exists():
        number += 1
    root.rename(aside)
    return aside


def record(demo: Demo, out: Path) -> tuple[Path, float]:
    """Record `demo` below `out`.

    Returns:
        The dataset's folder, and the time it took [s].

    Raises:
        DemoError: If `lerobot-record` fails.
    """
    root = out / demo.robot
    if aside := move_aside(root):
        print(f"  the previous recording is now {_shorten(aside)}")
    command = build_command(demo, root)
    print(f"  {shlex.join(command)}", flush=True)
    executable = Path(sys.executable).with_name(command[0])
    log = out / f"{demo.robot}.log"
    out.mkdir(parents=True, exist_ok=True)
    begun = time.monotonic()
    with log.open("w") as file:
        done = subprocess.run(
            [executable, *command[1:]],
            env=build_environment(out, os.environ),
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            check=False,
        )
    if done.returncode != 0:
        tail = "\n".join(log.read_text(errors="replace").splitlines()[-TAIL_LINES:])
        raise DemoError(
            f"lerobot-record for '{demo.robot}' ended with status {done.returncode}:\n{tail}\n"
            f"The whole output is {_shorten(log)}."
        )
    return root, time.monotonic() - begun


def show(demos: list[Demo], roots: list[Path], out: Path) -> None:
    """Load the datasets back, write images and videos, and print the table."""
    # Importing LeRobot takes seconds and reads the environment, so it waits for the recordings.
    os.environ.update(build_environment(out, os.environ))
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from xop_lerobot.evaluation import film as films
    from xop_lerobot.evaluation import summary
    from xop_lerobot.morphology.morphology import make_morphology

    summaries = []
    for demo, root in zip(demos, roots, strict=True):
        dataset = LeRobotDataset(f"local/xop_{demo.robot}_demo", root=root)
        summaries.append(
            summary.compute_episode_summary(
                summary.read_columns(dataset),
                dataset.meta.features[summary.HEALTH]["names"],
                dataset.meta.fps,
                demo.robot,
                make_morphology(demo.robot),
            )
        )
        cameras = {name: films.read_camera(dataset, name) for name in CAMERAS}
        base = out / f"{demo.robot}"
        films.write_strip(base.with_suffix(".png"), cameras, FPS)
        films.write_video(base.with_suffix(".mp4"), films.build_film(cameras, FPS), FPS)
        films.write_gif(base.with_suffix(".gif"), films.build_film(cameras, FPS), FPS)
        print(f"{demo.robot}: dataset {_shorten(root)}", end="")
        print(f", images and video {_shorten(base)}.png, .gif and .mp4")
    print(f"\n{summary.format_summaries(summaries)}")


def _shorten(path: Path) -> str:
    """Return `path` relative to the working directory if it is below it."""
    return os.path.relpath(path) if path.is_relative_to(Path.cwd()) else str(path)


def main(arguments: list[str] | None = None) -> int:
    """Record and show the requested episodes; returns the exit status."""
    parser = argparse.ArgumentParser(description="Record and show one episode of each robot.")
    parser.add_argument(
        "--robots", default=",".join(DEMOS), help="robots, separated by commas (default: all)"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=ROOT / "outputs" / "demo",
        help="directory for datasets and videos",
    )
    options = parser.parse_args(arguments)
    try:
        demos = []
        for name in options.robots.split(","):
            if name not in DEMOS:
                raise UnknownName("robot", name, DEMOS)
            demos.append(DEMOS[name])
        out = options.out.resolve()
        print(f"Recording {len(demos)} episodes; each takes about a minute on two cores.")
        roots = []
        for demo in demos:
            print(f"\n{demo.robot}: {demo.task}")
            root, wall_s = record(demo, out)
            print(f"  recorded in {wall_s:.0f} s")
            roots.append(root)
        print()
        show(demos, roots, out)
    except XopError as error:
        print(f"demo failed: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    make_output_readable()
    sys.exit(main())
