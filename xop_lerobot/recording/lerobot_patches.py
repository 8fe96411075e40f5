"""What this project replaces in LeRobot's modules, and how it finds out that this fits."""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Callable
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset

RECORD_MODULE = "lerobot.scripts.lerobot_record"
ROLLOUT_MODULE = "lerobot.rollout.context"

_DATASET_SIGNATURES = {
    "create": ("repo_id", "fps", "features", "root"),
    "resume": ("repo_id", "root"),
    "add_frame": ("self", "frame"),
    "save_episode": ("self", "episode_data", "parallel_encoding"),
    "clear_episode_buffer": ("self", "delete_images"),
    "finalize": ("self",),
}
"""First parameters of the dataset's methods that `XopDataset` overrides."""
_META_SIGNATURES = {
    "save_episode": (
        "self",
        "episode_index",
        "episode_length",
        "episode_tasks",
        "episode_stats",
        "episode_metadata",
    ),
}
_LOOP_PARAMETERS = ("robot", "events", "dataset", "teleop", "control_time_s")
"""Parameters of `record_loop` that the replacement reads or changes."""
STRATEGY_MODULE = "lerobot.rollout.strategies.episodic"
STRATEGY = "EpisodicStrategy"
LOOP = "_policy_loop"
_POLICY_LOOP_PARAMETERS = ("self", "events", "dataset", "control_time_s")
"""Parameters of the loop that the replacement reads or changes, in 0.6.1 and after it."""


def find(name: str) -> ModuleType | None:
    """Return LeRobot's module `name` if it is loaded, also when it is the program itself."""
    main = sys.modules.get("__main__")
    if main is not None and getattr(getattr(main, "__spec__", None), "name", None) == name:
        return main
    return sys.modules.get(name)


def get_loop_signature(loop: Callable[..., None]) -> inspect.Signature:
    """Return the signature of LeRobot's loop, which a decorator hides in a closure."""
    inner = getattr(loop, "xop_stock", loop)
    inner = inspect.getclosurevars(inner).nonlocals.get("func", inner)
    return inspect.signature(inner)


def find_fault(modules: list[ModuleType]) -> str:
    """Say what in LeRobot is not as this module expects it; empty if all is."""
    for module in modules:
        dataset: type[LeRobotDataset] | None = getattr(module, "LeRobotDataset", None)
        if dataset is None:
            return f"{module.__name__} has no LeRobotDataset"
        fault = _compare(dataset, _DATASET_SIGNATURES)
        if not fault and find(RECORD_MODULE) is module:
            fault = _find_loop_fault(module)
        if fault:
            return fault
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata  # noqa: PLC0415

    return _compare(LeRobotDatasetMetadata, _META_SIGNATURES)


def _compare(owner: type, expected: dict[str, tuple[str, ...]]) -> str:
    for name, parameters in expected.items():
        method = getattr(owner, name, None)
        if method is None:
            return f"{owner.__name__} has no {name}()"
        actual = tuple(inspect.signature(method).parameters)
        if actual[: len(parameters)] != parameters:
            return f"{owner.__name__}.{name}() takes {', '.join(actual)}"
    return ""


def _find_loop_fault(module: ModuleType) -> str:
    loop = getattr(module, "record_loop", None)
    if loop is None:
        return f"{module.__name__} has no record_loop()"
    actual = get_loop_signature(loop).parameters
    missing = [name for name in _LOOP_PARAMETERS if name not in actual]
    return f"record_loop() has no parameter {', '.join(missing)}" if missing else ""


def find_strategy() -> tuple[type | None, str]:
    """Return LeRobot's strategy that records policies in episodes, and what is wrong with it.

    Where something is, episodes end by the wall clock, as LeRobot has it: nothing is lost but the
    same number of frames whatever the machine does meanwhile.

    Returns:
        The strategy and an empty text, or None and what is not as this module expects it.
    """
    try:
        module = importlib.import_module(STRATEGY_MODULE)
    except ImportError:
        return None, f"it has no {STRATEGY_MODULE}"
    strategy = getattr(module, STRATEGY, None)
    if strategy is None:
        return None, f"{STRATEGY_MODULE} has no {STRATEGY}"
    loop = getattr(strategy, LOOP, None)
    if loop is None:
        return None, f"{STRATEGY} has no {LOOP}()"
    known = inspect.signature(getattr(loop, "xop_stock", loop)).parameters
    missing = [name for name in _POLICY_LOOP_PARAMETERS if name not in known]
    if missing:
        return None, f"{STRATEGY}.{LOOP}() has no parameter {', '.join(missing)}"
    return strategy, ""
