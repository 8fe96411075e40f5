"""Measure the time and peak memory of `xop-curate` on synthetic datasets of growing size.

    python -m benchmarks.run_curate --episodes 10,100,1000 --frames 9000

An episode of 9,000 frames is six minutes at 25 Hz, so 1,000 of them are 100 hours. They are made by
`benchmarks.curate_synthetic`, without images, and deleted afterwards: 1,000 and their filtered copy
take about 6 GB in --work. Each command runs in its own process on one thread; memory is its maximum
resident set.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

WHERE = "success and tracking_p95 < 0.1 and not fall"
COMMANDS = {
    "inspect": ["inspect", "--json", "{work}/figures.json"],
    "filter --dry-run": ["filter", "--where", WHERE, "--dry-run"],
    "filter": ["filter", "--where", WHERE, "--out", "{work}/filtered"],
    "report": ["report", "--out", "{work}/report.html"],
}


def make(root: Path, episodes: int, frames: int, seed: int) -> None:
    """Write a synthetic dataset."""
    from benchmarks.curate_synthetic import make_dataset

    make_dataset(root, episodes, frames, seed=seed)


def measure(command: list[str]) -> dict[str, Any]:
    """Run an `xop-curate` command; returns its times [s], peak memory [MB] and summary line."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    start = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "xop_lerobot.curate.cli", *command],
        stdout=subprocess.PIPE,
        env=environment,
        text=True,
    )
    text = process.stdout.read() if process.stdout else ""
    _, status, usage = os.wait4(process.pid, 0)
    wall = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} failed with exit code {process.returncode}")
    return {
        "wall_s": round(wall, 2),
        "cpu_s": round(usage.ru_utime + usage.ru_stime, 2),
        "peak_mb": round(usage.ru_maxrss / 1024, 1),
        "last_line": text.strip().splitlines()[-1 if "inspect" in command else 0],
    }


def main() -> None:
    """Measure each command at each size and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--episodes", default="10,100,1000", help="numbers of episodes, separated by commas"
    )
    parser.add_argument("--frames", type=int, default=9000, help="frames per episode")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--verbs", default="", help="commands to run, separated by commas (default: all)"
    )
    parser.add_argument(
        "--work", type=Path, help="directory for the datasets (default: the system's temporary one)"
    )
    parser.add_argument("--json", type=Path, help="file for the results (default: none)")
    settings = parser.parse_args()
    rows = []
    head = ("wall s", "cpu s", "MB")
    print(f"episodes   hours     GB  {'command':18}{''.join(name.rjust(8) for name in head)}")
    for count in map(int, settings.episodes.split(",")):
        work = Path(tempfile.mkdtemp(prefix="curate-", dir=settings.work))
        try:
            # A child's maximum resident set includes its parent's at the fork, so the parent stays
            # small: the dataset is made in a process of its own.
            maker = multiprocessing.get_context("spawn").Process(
                target=make, args=(work / "data", count, settings.frames, settings.seed)
            )
            maker.start()
            maker.join()
            if maker.exitcode:
                raise SystemExit("could not make the dataset")
            size = sum(path.stat().st_size for path in work.rglob("*") if path.is_file())
            for name, words in COMMANDS.items():
                if settings.verbs and name not in settings.verbs.split(","):
                    continue
                command = [word.format(work=work) for word in words]
                figures = measure([command[0], "--root", str(work / "data"), *command[1:]])
                hours = count * settings.frames / 25 / 3600
                rows.append({"episodes": count, "hours": hours, "command": name, **figures})
                print(
                    f"{count:8}  {hours:6.1f}  {size / 1e9:5.2f}  {name:18}{figures['wall_s']:8.1f}"
                    f"{figures['cpu_s']:8.1f}{figures['peak_mb']:8.0f}  {figures['last_line']}",
                    flush=True,
                )
        finally:
            shutil.rmtree(work, ignore_errors=True)
    if settings.json is not None:
        settings.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
