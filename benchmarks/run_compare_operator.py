"""Print the speed and smoothness of recorded people's motion beside the simulated person's.

    python -m benchmarks.run_compare_operator recording.npz ... --seeds 4 --plot comparison.png

The recordings are of real people, in the format of docs/how_it_works/operator.md. The simulated
person walks, turns and reaches at random for 30 s per seed, without a robot.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from benchmarks.person_comparison import (
    Motion,
    compute_figures,
    compute_spectrum,
    load_motion,
    simulate_motion,
)
from xop_lerobot.core.command_line import make_output_readable
from xop_lerobot.core.errors import XopError


def main() -> None:
    """Compute and print the table, and write the plot if requested."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("recordings", nargs="+", type=Path, help=".npz recordings of people")
    parser.add_argument("--seeds", type=int, default=4, help="number of simulated people")
    parser.add_argument("--plot", type=Path, help="file of the plot, .png or .svg")
    settings = parser.parse_args()
    try:
        motions = [load_motion(path) for path in settings.recordings]
    except XopError as error:
        raise SystemExit(f"error: {error}") from None
    motions += [simulate_motion(seed) for seed in range(settings.seeds)]
    print_table(motions)
    if settings.plot:
        plot(motions, settings.plot)


def print_table(motions: list[Motion]) -> None:
    """Print a Markdown table, one row per person."""
    rows = [compute_figures(motion) for motion in motions]
    print("| " + " | ".join(["person", *rows[0]]) + " |")
    print("|" + "---|" * (len(rows[0]) + 1))
    for motion, row in zip(motions, rows, strict=True):
        print("| " + " | ".join([motion.name, *(f"{value:.2f}" for value in row.values())]) + " |")


def plot(motions: list[Motion], path: Path) -> None:
    """Plot speeds over time, their distributions, and the spectrum of the head's velocity."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(12, 8))
    for motion in motions:
        style = {"label": motion.name, "linewidth": 1}
        style["linestyle"] = "--" if motion.simulated else "-"
        for axis, name in ((axes[0, 0], "head"), (axes[0, 1], "left hand")):
            speed = np.sort(motion.speeds[name])
            axis.plot(speed, np.linspace(0, 1, len(speed)), **style)
            axis.set(xlabel=f"speed of the {name} [m/s]", ylabel="fraction of time below")
        axes[1, 0].plot(motion.time, motion.speeds["head"], **style)
        frequency, power = compute_spectrum(motion)
        axes[1, 1].loglog(frequency, power, **style)
    axes[1, 0].set(xlabel="time [s]", ylabel="speed of the head [m/s]")
    axes[1, 1].set(xlabel="frequency [Hz]", ylabel="power of the head's velocity [m²/s²/Hz]")
    axes[0, 0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    make_output_readable()
    main()
