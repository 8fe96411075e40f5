"""Episode metadata of this project ("facts"), and the session's configuration.

Facts are written twice: as `xop/*` columns of LeRobot's episode metadata, and as one JSON object
per line in `meta/xop/episodes.jsonl`, because some LeRobot tools drop unknown columns.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from xop_lerobot.core.folders import append_line, read_lines
from xop_lerobot.core.versions import read_versions

if TYPE_CHECKING:
    from xop_lerobot.recording.requests import EpisodeCounts
    from xop_lerobot.session import RobotInfo

FACTS_DIR = Path("meta") / "xop"
EPISODES_FILE = FACTS_DIR / "episodes.jsonl"
CONFIG_FILE = FACTS_DIR / "config.json"
CONFIGS_DIR = FACTS_DIR / "configs"
"""All configurations by hash, if episodes have different ones."""
FACTS_PREFIX = "xop/"
_JSON_FACTS = ("versions", "settings", "changes")


@dataclass(frozen=True)
class EpisodeFacts:
    """Metadata of one episode.

    Attributes:
        success: Whether the task was accomplished; False without a task.
        fallen: Whether the robot fell.
        collision: Whether the robot touched itself, or anything but the ground.
        finished: Whether the operator's recording or script had played to its end.
        seed: Seed of the session.
        task: Task description.
        robot: LeRobot's robot type.
        scene: Scene of the simulation.
        low_level: Low-level policy.
        clock: `lockstep` or `realtime`.
        config_hash: SHA-256 of the resolved configuration, `meta/xop/config.json`.
        versions: Versions of the packages that determine the data, as JSON.
        start_time: Host clock at the first frame [s since the epoch].
        real_fps: Frame rate by the host clock [Hz]; in real time it should equal the dataset's.
        dropped_frames: Number of video frames dropped by the encoder; later images are shifted.
        late: Whether a real-time episode ran at less than 95 % of its rate.
        settings: Settings at the first frame (preset, weights, targets, body, constraints, mode),
            as JSON; an empty object without a teleoperator.
        changes: Changes during the episode, as a JSON list of objects: `frame`, `time` of the
            robot's clock [s], `source` and `change`. Troubles of the robot (it moves though it
            should stand, or gives way under a load) are included with the source `robot` and the
            change `trouble`.
    """

    success: bool
    fallen: bool
    collision: bool
    finished: bool
    seed: int
    task: str
    robot: str
    scene: str
    low_level: str
    clock: str
    config_hash: str
    versions: str
    start_time: float
    real_fps: float
    dropped_frames: int
    late: bool
    settings: str = "{}"
    changes: str = "[]"

    def to_metadata(self) -> dict[str, Any]:
        """Return the facts as columns of LeRobot's episode metadata."""
        return {f"{FACTS_PREFIX}{key}": value for key, value in dataclasses.asdict(self).items()}


_LATE = 0.95
"""Share of the nominal rate below which a real-time episode is marked as late."""


def gather_facts(
    counts: EpisodeCounts, info: RobotInfo, config_hash: str, dropped: int
) -> EpisodeFacts:
    """Collect the metadata of the episode being recorded.

    Args:
        counts: Its counts.
        info: Its robot.
        config_hash: Hash of its configuration.
        dropped: Number of video frames dropped by the encoder.
    """
    return EpisodeFacts(
        success=counts.success,
        fallen=counts.fallen,
        collision=counts.collision,
        finished=counts.finished,
        seed=info.seed,
        task=counts.task,
        robot=info.name,
        scene=info.scene,
        low_level=info.low_level,
        clock="realtime" if info.realtime else "lockstep",
        config_hash=config_hash,
        versions=read_versions(),
        start_time=counts.start_time,
        real_fps=counts.fps,
        dropped_frames=dropped,
        settings=json.dumps(counts.settings),
        changes=json.dumps(counts.changes),
        late=info.realtime and counts.frames > 1 and counts.fps < _LATE * info.fps,
    )


FACT_COLUMNS = tuple(f"{FACTS_PREFIX}{each.name}" for each in dataclasses.fields(EpisodeFacts))
"""Column names in LeRobot's episode metadata."""


def append_facts(
    root: Path,
    episode: int,
    length: int,
    facts: EpisodeFacts,
    more: Mapping[str, Any] = MappingProxyType({}),
) -> None:
    """Append the line of `episode`, and flush it to disk.

    Args:
        root: Directory of the dataset.
        episode: Index of the episode.
        length: Number of frames.
        facts: Metadata of the episode.
        more: Further metadata that not every episode has, as plain values for JSON.
    """
    row = {"episode_index": episode, "length": length, **dataclasses.asdict(facts)}
    for name in _JSON_FACTS:
        row[name] = json.loads(row[name])
    row |= more
    append_line(root / EPISODES_FILE, json.dumps(row))


def read_facts(root: Path) -> list[dict[str, Any]]:
    """Read `meta/xop/episodes.jsonl`; a line truncated by a crash is left out."""
    return [row for row in read_lines(root / EPISODES_FILE) if row is not None]


def write_config(root: Path, config: Mapping[str, Any]) -> None:
    """Write the resolved configuration of a session to `meta/xop/config.json`."""
    path = root / CONFIG_FILE
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(to_plain(config), indent=2) + "\n", encoding="utf-8")


def keep_config(root: Path, config: Mapping[str, Any]) -> None:
    """Store the configuration of a session in the dataset.

    `meta/xop/config.json` is that of the first session. If a later one differs, both are also
    stored in `meta/xop/configs/`, by the hash in the episode metadata.
    """
    path = root / CONFIG_FILE
    if not path.exists():
        write_config(root, config)
        return
    try:
        first = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        first = {}
    if compute_config_hash(first) == compute_config_hash(config):
        return
    for each in (first, config):
        named = root / CONFIGS_DIR / f"{compute_config_hash(each)}.json"
        named.parent.mkdir(exist_ok=True)
        if not named.exists():
            named.write_text(json.dumps(to_plain(each), indent=2) + "\n", encoding="utf-8")


def compute_config_hash(config: Mapping[str, Any]) -> str:
    """Compute the SHA-256 of a configuration, independent of key order."""
    text = json.dumps(to_plain(config), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def to_plain(value: Any) -> Any:  # any configuration value
    """Convert dataclasses, paths, enums and tuples to JSON values."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            field.name: to_plain(getattr(value, field.name)) for field in dataclasses.fields(value)
        }
    if isinstance(value, Mapping):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_plain(item) for item in value]
    if isinstance(value, Enum):
        return value.name
    return value if isinstance(value, (str, int, float, bool, type(None))) else str(value)
