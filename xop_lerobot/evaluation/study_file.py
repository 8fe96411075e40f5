"""Reads the file of a whole study: groups of robot, tasks, methods and variants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import yaml

from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.yaml_words import find_word, load_yaml
from xop_lerobot.evaluation.methods import get_method
from xop_lerobot.evaluation.study import Cell, make_cell
from xop_lerobot.evaluation.trial import TrialSetup
from xop_lerobot.plant.config import NOISE_PRESETS

_STUDY_KEYS = ("trials", "seed", "noise", "fps", "time_limit", "low_level_paths", "groups")
_LISTS = ("tasks", "methods", "variants", "low_levels")
_GROUP_KEYS = ("robot", *_LISTS, "trials", "noise", "scene", "heights")


def load_study(path: Path, overrides: Mapping[str, Any] | None = None) -> list[Cell]:
    """Read the cells of a study.

    Args:
        path: YAML file: `trials`, `seed`, `noise`, `fps`, `time_limit`, `low_level_paths` (file
            or folder of a low-level policy by its name), and a list of `groups`; each has a
            `robot` and lists of `tasks` and `methods`, and may have lists of `variants` and
            `low_levels`, and `trials`, `noise`, `scene` and `heights` of its own. Every combination
            within a group is a cell.
        overrides: Values over those of the file and of all its groups (`trials`, `seed`,
            `noise`, …); None leaves a value.

    Raises:
        BadValue: If the file is missing or malformed.
        UnknownName: If a key or a name is unknown, listing the known ones.
    """
    try:
        data = load_yaml(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise BadValue(f"study '{path}' cannot be read: {error.strerror}") from error
    except yaml.YAMLError as error:
        raise BadValue(f"study '{path}' is no YAML: {error}") from error
    where = f"study '{path}'"
    _check_keys(where, data, _STUDY_KEYS, ("groups",))
    if not isinstance(data["groups"], list) or not data["groups"]:
        raise BadValue(f"{where}: groups must be a list of at least one group")
    given = {name: value for name, value in (overrides or {}).items() if value is not None}
    common = {name: value for name, value in data.items() if name != "groups"}
    cells: list[Cell] = []
    for number, group in enumerate(data["groups"], 1):
        inside = f"{where}, group {number}"
        _check_keys(inside, group, _GROUP_KEYS, ("robot", "tasks", "methods"))
        for name in _LISTS:
            if name in group and not isinstance(group[name], list):
                raise BadValue(f"{inside}: {name} must be a list, got {group[name]!r}")
        cells += make_cells({**common, **group, **given})
    return cells


def make_cells(group: Mapping[str, Any]) -> list[Cell]:
    """Make a cell of every combination of tasks, low-level policies, methods and variants.

    A method that always has the same low-level policy comes once, whatever policies are asked
    for.

    Raises:
        UnknownName: If a name is unknown, listing the known ones.
        BadValue: If a number is out of its range.
    """
    kept = ("noise", "scene", "fps", "time_limit", "heights")
    common = {name: group[name] for name in kept if group.get(name)}
    if "heights" in common:
        common["heights"] = str(common["heights"])
    if group.get("noise") is not None:
        common["noise"] = find_word(group["noise"], NOISE_PRESETS)
        if common["noise"] not in NOISE_PRESETS:
            raise UnknownName("noise preset", common["noise"], NOISE_PRESETS)
    paths = group.get("low_level_paths") or {}
    combinations = product(
        group["tasks"],
        _get_list(group, "low_levels"),
        group["methods"],
        _get_list(group, "variants"),
    )
    cells: dict[TrialSetup, Cell] = {}
    for task, low_level, method, variant in combinations:
        own = get_method(method).low_level
        policy = own or low_level or ""
        setup = TrialSetup(
            group["robot"],
            task,
            method,
            variant or "",
            low_level=policy,
            low_level_path=str(paths.get(policy, "")),
            **common,
        )
        cell = make_cell(setup, group.get("trials", 20), group.get("seed", 0))
        cells.setdefault(cell.setup, cell)
    return list(cells.values())


def _get_list(group: Mapping[str, Any], name: str) -> Sequence[str]:
    return group.get(name) or [""]


def _check_keys(where: str, data: Any, known: Sequence[str], needed: Sequence[str]) -> None:
    if not isinstance(data, Mapping):
        raise BadValue(f"{where} must be a mapping, got {type(data).__name__}")
    for name in data:
        if name not in known:
            raise UnknownName(f"key of {where}", name, known)
    for name in needed:
        if name not in data:
            raise BadValue(f"{where} lacks '{name}'")
