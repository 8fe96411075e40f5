"""One collected episode of RB-Y1 that reaches for two points, with tiny pictures, for tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from xop_lerobot.collect.config import CollectConfig
from xop_lerobot.collect.folder import DATASET
from xop_lerobot.collect.worker import Collector


def collect_reach(folder: Path, **settings: Any) -> Path:
    """Collect it below `folder`, without a planner; returns the dataset's directory."""
    config = CollectConfig("rby1", "dual_point_reach", method="direct", video=False, **settings)
    collector = Collector(config, run=0.0)
    try:
        collector.make(0, folder)
    finally:
        collector.close()
    return folder / DATASET
