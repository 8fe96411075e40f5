"""Whether there is room for recordings."""

from __future__ import annotations

import os
import shutil

from xop_lerobot.doctor.finding import Finding, Level, Setup

ENOUGH_GB, LEAST_GB = 10.0, 1.0


def check_disk(setup: Setup) -> Finding:
    """Look at the disk of the folder, or of its nearest parent that exists."""
    wanted = setup.root.expanduser().absolute()
    folder = wanted
    while not folder.exists():
        folder = folder.parent
    free = shutil.disk_usage(folder).free / 1e9
    figures = {"free_gb": round(free, 2), "folder": str(folder)}
    if not os.access(folder, os.W_OK):
        return Finding(
            Level.FAIL,
            f"{wanted} cannot be written: {folder} is somebody else's",
            "choose another --dataset.root",
            figures,
        )
    text = f"{free:.1f} GB are free for {wanted}"
    if free < ENOUGH_GB:
        return Finding(
            Level.FAIL if free < LEAST_GB else Level.WARN,
            text,
            "free some, or choose another --dataset.root; videos take most of it",
            figures,
        )
    return Finding(Level.OK, text, "", figures)
