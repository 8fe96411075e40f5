"""Merge single-episode datasets into one, in the order of their indices."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.aggregate import aggregate_datasets
from lerobot.datasets.utils import EPISODES_DIR

from xop_lerobot.collect.folder import CollectFolder
from xop_lerobot.core.folders import write_whole
from xop_lerobot.recording.facts import CONFIG_FILE, EPISODES_FILE, FACTS_DIR, read_facts
from xop_lerobot.recording.lerobot_patches import MERGE_BARS, MERGE_EPISODES, replaced


def merge_attempts(
    folder: CollectFolder,
    indices: Container[int],
    repo_id: str,
    settings: Mapping[str, Any],
    note_walls: Callable[[], Mapping[str, float]],
) -> None:
    """Merge the existing dataset, if any, and finished episodes into a new one.

    As when recorded one after another, each episode has its own files, and its metadata is in
    `meta/xop/episodes.jsonl`. The old dataset is replaced only when the new one is complete.
    Without an episode to keep, nothing happens.

    Args:
        folder: Files of the collection.
        indices: Episodes to merge; others are kept for later.
        repo_id: Name of the dataset.
        settings: Settings of the collection.
        note_walls: Returns the duration of each run so far [s], by its start time.
    """
    attempts = [each for index, each in folder.read_attempts().items() if index in indices]
    before = folder.read_dataset()
    sources = [folder.root] if before else []
    sources += [folder.get_dataset(attempt.index) for attempt in attempts if attempt.kept]
    if not sources:
        return
    merged = folder.merged
    shutil.rmtree(merged, ignore_errors=True)
    with (
        replaced(MERGE_EPISODES, _load_episodes),
        replaced(MERGE_BARS, SimpleNamespace(tqdm=_show_nothing)),
    ):
        aggregate_datasets(
            [repo_id] * len(sources),
            repo_id,
            roots=sources,
            aggr_root=merged,
            concatenate_videos=False,
            concatenate_data=False,
        )
    _merge_facts(sources, merged)
    rows = [*before.get("attempts", ()), *map(dataclasses.asdict, attempts)]
    document = {"settings": settings, "walls": note_walls(), "attempts": rows}
    write_whole(merged / folder.record, document)
    folder.exchange(attempt.index for attempt in attempts)


def _merge_facts(sources: Sequence[Path], merged: Path) -> None:
    """Copy the episode metadata of `meta/xop`, which LeRobot's merge ignores."""
    (merged / FACTS_DIR).mkdir(parents=True, exist_ok=True)
    shutil.copy(sources[-1] / CONFIG_FILE, merged / CONFIG_FILE)
    rows = [row for source in sources for row in read_facts(source)]
    with (merged / EPISODES_FILE).open("w", encoding="utf-8") as file:
        for index, row in enumerate(rows):
            file.write(json.dumps({**row, "episode_index": index}) + "\n")


def _show_nothing(things: Iterable[Any], **options: Any) -> Iterable[Any]:
    """Replacement for LeRobot's progress bars, which would mix with the command's output."""
    del options
    return things


def _load_episodes(root: Path) -> dict[str, list]:
    """Read the columns of a dataset's episode metadata, without statistics.

    LeRobot's own function uses `datasets`, which takes a second for the 900 columns of a single
    episode.
    """
    tables = []
    for path in sorted((root / EPISODES_DIR).glob("*/*.parquet")):
        names = [name for name in pq.read_schema(path).names if not name.startswith("stats/")]
        tables.append(pq.read_table(path, columns=names))
    return pa.concat_tables(tables).to_pydict()
