"""Rows and episodes of a dataset, as LeRobot's reader gives them."""

from __future__ import annotations

from typing import Any

from datasets import Dataset
from lerobot.datasets import LeRobotDataset


def get_row(dataset: LeRobotDataset, index: int) -> dict[str, Any]:
    """One frame; LeRobot gives a list of them for a slice alone."""
    row = dataset[index]
    assert isinstance(row, dict)
    return row


def get_episodes(dataset: LeRobotDataset) -> Dataset:
    """The metadata of its episodes."""
    episodes = dataset.meta.episodes
    assert episodes is not None
    return episodes
