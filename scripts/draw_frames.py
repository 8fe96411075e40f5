"""Draw the frames of operator and headsets: makes docs/images/frames.png.

    python scripts/draw_frames.py --out frames.png

The person stands with palms down and fingers forward. All axes come from the matrices with which
the devices convert poses, so that the image cannot contradict the code.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from xop_lerobot.core.command_line import make_output_readable
from xop_lerobot.operator.axes import WORLD
from xop_lerobot.operator.devices.avp import AXES
from xop_lerobot.operator.webxr.protocol import GRIPS, PARALLEL

PLACES = {  # positions of the frames in the operator's world [m]
    "head": np.array([0.0, 0.0, 0.6]),
    "left_wrist": np.array([0.4, 0.5, 0.0]),
    "right_wrist": np.array([0.4, -0.5, 0.0]),
}
COLOURS = ("#d62728", "#2ca02c", "#1f77b4")
LENGTH = 0.26  # of a drawn axis [m]
FINGERS = 0.2  # length of a hand [m]


def make_panels() -> dict[str, tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Return world and frames of each panel by title.

    Columns of the matrices are axes in the operator's world. Shapes (3, 3).
    """
    ours = dict.fromkeys(PLACES, np.eye(3))
    # Columns of the devices' matrices are our axes in their frames; the transposes are drawn.
    avp = {name: axes.T for name, axes in AXES.items()}
    webxr = dict.fromkeys(PLACES, PARALLEL.T)
    grips = {"head": PARALLEL.T} | {f"{side}_wrist": axes.T for side, axes in GRIPS.items()}
    return {
        "xop-lerobot": (np.eye(3), ours),
        "Vision Pro (ARKit anchors)": (WORLD, avp),
        "WebXR hands (viewer, wrist)": (WORLD, webxr),
        "WebXR controllers (viewer, grip)": (WORLD, grips),
    }


def draw_axes(ax: Any, origin: np.ndarray, axes: np.ndarray, names: str) -> None:
    """Draw the columns of `axes` (3, 3) as labelled arrows from `origin` (3,)."""
    for column, colour, name in zip(axes.T, COLOURS, names, strict=True):
        ax.quiver(*origin, *(LENGTH * column), color=colour, arrow_length_ratio=0.22, lw=2)
        ax.text(*(origin + 1.2 * LENGTH * column), name, color=colour, ha="center", va="center")


def draw_person(ax: Any) -> None:
    """Draw a head facing along X, and hands with palms down."""
    u, v = np.mgrid[0 : 2 * np.pi : 16j, 0 : np.pi : 9j]
    head = 0.09 * np.array([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), 1.25 * np.cos(v)])
    ax.plot_surface(*(head + PLACES["head"][:, None, None]), color="#bbbbbb", alpha=0.5)
    for name, side in (("left_wrist", 1.0), ("right_wrist", -1.0)):
        wrist = PLACES[name]
        for offset in (-0.045, -0.015, 0.015, 0.045):
            tip = wrist + [FINGERS, offset, 0]
            ax.plot(*np.array([wrist, wrist + [0.09, offset, 0], tip]).T, color="#999999", lw=3)
        thumb = wrist + [0.09, -side * 0.09, 0]
        ax.plot(*np.array([wrist, thumb]).T, color="#999999", lw=3)


def main() -> None:
    """Draw all panels and write the image."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="PNG file to write")
    out = parser.parse_args().out
    figure = plt.figure(figsize=(13, 3.6))
    for i, (title, (world, frames)) in enumerate(make_panels().items(), start=1):
        ax: Any = figure.add_subplot(1, 4, i, projection="3d")
        ax.set_title(title, fontsize=10)
        draw_person(ax)
        names = "XYZ" if i == 1 else "xyz"
        for name, axes in frames.items():
            draw_axes(ax, PLACES[name], axes, names)
        corner = np.array([0.0, 0.0, -0.5])
        draw_axes(ax, corner, world, names)
        ax.text(*(corner - [0, 0, 0.2]), "world", color="#555555", ha="center")
        ax.set(xlim=(-0.5, 0.9), ylim=(-0.7, 0.7), zlim=(-0.6, 0.8))
        ax.set_box_aspect((1, 1, 1), zoom=1.3)
        ax.view_init(elev=24, azim=-160)
        ax.set_axis_off()
    figure.subplots_adjust(0, 0, 1, 0.93, 0, 0)
    figure.savefig(out, dpi=90)


if __name__ == "__main__":
    make_output_readable()
    main()
