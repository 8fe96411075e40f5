"""Settings of the planner that can be changed while the robot is driven.

`Settings` are those in force, a `Change` is a validated difference, and `apply_change` computes the
settings after it. `parse_change` reads a change from JSON.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.morphology.tuning import CostWeights
from xop_lerobot.retarget.config import CONSTRAINTS, PRESETS, RetargeterConfig, split_names

MAX_WEIGHT = 1e6
WEIGHT_NAMES = tuple(each.name for each in dataclasses.fields(CostWeights))
_UNBOUNDED = ("collision_range",)  # may be infinite, as in the paper's formula
# Other weights are relative to that of position, and barriers need a positive decay and range.
_POSITIVE = ("collision_decay", "collision_velocity_decay", "collision_range", "position")


@dataclass(frozen=True)
class Change:
    """Settings to change from the next tick on; None or empty keeps a setting.

    Attributes:
        preset: New preset; it discards weights that were set before.
        weights: Cost weights by name, for both modes; they override those of the preset.
        variant: New binding of targets to the body, one that the robot names.
        targets: Tracked frames that the retargeter follows.
        body: Commands and arm joints that it may move for them; the whole command if empty.
        constraints: Constraints by name, on or off.
        mode: New mode.

    Raises:
        BadValue: If a value has the wrong type or is out of range; names what is allowed.
        UnknownName: If a name is unknown; lists the known ones.
    """

    preset: str | None = None
    weights: Mapping[str, float] = field(default_factory=dict)
    variant: str | None = None
    targets: tuple[str, ...] | None = None
    body: tuple[str, ...] | None = None
    constraints: Mapping[str, bool] = field(default_factory=dict)
    mode: Mode | None = None

    def __post_init__(self) -> None:
        if not self.to_dict():
            raise BadValue(f"a change must change something: {', '.join(CHANGE_NAMES)}")
        if self.preset is not None and self.preset not in PRESETS:
            raise UnknownName("preset", self.preset, PRESETS)
        for name, value in self.weights.items():
            check_weight(name, value)
        for name, value in self.constraints.items():
            if name not in CONSTRAINTS:
                raise UnknownName("constraint", name, CONSTRAINTS)
            if not isinstance(value, bool):
                raise BadValue(f"constraint {name!r} must be true or false, got {value!r}")
        for name in ("weights", "constraints"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    def to_dict(self) -> dict[str, Any]:
        """Return the change in the form that `parse_change` reads, without unchanged settings."""
        plain = {
            "preset": self.preset,
            "weights": _to_json(self.weights) or None,
            "variant": self.variant,
            "targets": None if self.targets is None else list(self.targets),
            "body": None if self.body is None else list(self.body),
            "constraints": dict(self.constraints) or None,
            "mode": None if self.mode is None else self.mode.name.lower(),
        }
        return {name: value for name, value in plain.items() if value is not None}


CHANGE_NAMES = tuple(each.name for each in dataclasses.fields(Change))


def split_change(change: Change) -> dict[tuple[str, ...], Any]:
    """Split a change into single settings, in the order in which they apply.

    Returns:
        Values by setting: `("preset",)`, `("weights", name)`, `("constraints", name)`, ….
    """
    parts: dict[tuple[str, ...], Any] = {}
    for name in CHANGE_NAMES:
        value = getattr(change, name)
        if isinstance(value, Mapping):
            parts |= {(name, key): each for key, each in value.items()}
        elif value is not None:
            parts[name,] = value
    return parts


def join_change(parts: Mapping[tuple[str, ...], Any]) -> Change:
    """Make the change that sets `parts`; the inverse of `split_change`."""
    values: dict[str, Any] = {}
    for (name, *key), value in parts.items():
        if key:
            values.setdefault(name, {})[key[0]] = value
        else:
            values[name] = value
    return Change(**values)


def check_weight(name: object, value: object) -> None:
    """Check a cost weight.

    Raises:
        UnknownName: If there is no weight of this name.
        BadValue: If the value is not a number in its range.
    """
    if name not in WEIGHT_NAMES:
        raise UnknownName("weight", name, WEIGHT_NAMES)
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if number and name in _UNBOUNDED and value == math.inf:
        return
    positive = name in _POSITIVE
    if not number or not 0 <= value <= MAX_WEIGHT or (positive and value == 0):  # pyright: ignore[reportOperatorIssue]
        low = "above 0 and at most" if positive else "from 0 to"
        also = " (or inf)" if name in _UNBOUNDED else ""
        raise BadValue(
            f"weight {name!r} must be a number {low} {MAX_WEIGHT:g}{also}, got {value!r}"
        )


def parse_change(data: object) -> Change:
    """Parse a change from decoded JSON.

    Args:
        data: An object with any of the attributes of `Change`; `mode` is `stationary` or
            `mobile`, `targets` and `body` are lists of names, an infinite weight is `"inf"`.

    Raises:
        UnknownName: If a name is unknown; lists the known ones.
        BadValue: If a value is of the wrong kind or out of its range.
    """
    if not isinstance(data, Mapping):
        raise BadValue(f"a change must be an object, got {_describe(data)}")
    values: dict[str, Any] = {}
    for name, value in data.items():
        if name not in CHANGE_NAMES:
            raise UnknownName("setting", name, CHANGE_NAMES)
        if name in ("weights", "constraints"):
            if not isinstance(value, Mapping):
                raise BadValue(f"{name} must be an object by name, got {_describe(value)}")
            values[name] = dict(value)
        elif name in ("targets", "body"):
            values[name] = _parse_names(name, value)
        else:
            if not isinstance(value, str):
                raise BadValue(f"{name} must be a name, got {_describe(value)}")
            values[name] = _parse_mode(value) if name == "mode" else value
    for name, value in values.get("weights", {}).items():
        if value == "inf":  # JSON has no infinity
            values["weights"][name] = math.inf
    return Change(**values)


def _to_json(weights: Mapping[str, float]) -> dict[str, float | str]:
    return {name: "inf" if value == math.inf else value for name, value in weights.items()}


def make_toggle(name: str, settings: Settings) -> Change:
    """Make the change that toggles a constraint, or a preset against `default`.

    Raises:
        UnknownName: If `name` is neither a constraint nor a preset; lists both.
    """
    if name in CONSTRAINTS:
        return Change(constraints={name: name not in settings.constraints})
    if name in PRESETS:
        return Change(preset="default" if settings.preset == name else name)
    raise UnknownName("constraint or preset", name, (*CONSTRAINTS, *PRESETS))


def _parse_names(name: str, value: object) -> tuple[str, ...]:
    if isinstance(value, (list, tuple)) and all(isinstance(each, str) for each in value):
        return tuple(value)
    raise BadValue(f"{name} must be a list of names, got {_describe(value)}")


def _parse_mode(name: str) -> Mode:
    known = [mode.name.lower() for mode in Mode]
    if name not in known:
        raise UnknownName("mode", name, known)
    return Mode[name.upper()]


def _describe(value: object) -> str:
    return f"{value!r:.80}"


@dataclass(frozen=True)
class Settings:
    """Settings in force: preset, manual weights, and the binding of targets to the body.

    Attributes:
        preset: Preset.
        weights: Weights that were set manually; they override those of the preset.
        variant: Binding that was selected last.
        targets: Tracked frames that the retargeter follows.
        body: Commands and arm joints that it may move for them; empty for the whole command.
        constraints: Active constraints.
    """

    preset: str
    weights: Mapping[str, float]
    variant: str
    targets: tuple[str, ...]
    body: tuple[str, ...]
    constraints: frozenset[str]

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-compatible dictionary."""
        return {
            "preset": self.preset,
            "weights": _to_json(self.weights),
            "variant": self.variant,
            "targets": list(self.targets),
            "body": list(self.body),
            "constraints": sorted(self.constraints),
        }


def make_settings(morphology: Morphology, config: RetargeterConfig) -> Settings:
    """Make the settings that a session of `morphology` starts with.

    Raises:
        UnknownName: If `config` names an unknown variant, target or part of the body.
    """
    variant = config.variant or next(iter(morphology.variants))
    start = Settings(config.preset, {}, variant, (), (), frozenset(split_names(config.constraints)))
    return apply_change(
        morphology,
        start,
        Change(
            variant=variant,
            targets=split_names(config.targets) or None,
            body=split_names(config.body) or None,
        ),
    )


def apply_change(morphology: Morphology, settings: Settings, change: Change) -> Settings:
    """Compute the settings after `change`, without side effects.

    Raises:
        UnknownName: If the robot has no such variant, target or part of the body.
        BadValue: If no target would be left, or a name occurs twice.
    """
    weights = {} if change.preset is not None else dict(settings.weights)
    variant, targets, body = settings.variant, settings.targets, settings.body
    if change.variant is not None:
        variant = change.variant
        if variant not in morphology.variants:
            raise UnknownName(f"variant of {morphology.name}", variant, morphology.variants)
        targets, body = morphology.variants[variant].targets, morphology.variants[variant].body
    if change.targets is not None:
        targets = change.targets
    if change.body is not None:
        body = change.body
    check_binding(morphology, targets, body)
    on = {name for name, value in change.constraints.items() if value}
    off = set(change.constraints) - on
    return Settings(
        preset=settings.preset if change.preset is None else change.preset,
        weights=MappingProxyType(weights | dict(change.weights)),
        variant=variant,
        targets=targets,
        body=body,
        constraints=frozenset(settings.constraints - off | on),
    )


def check_binding(morphology: Morphology, targets: Iterable[str], body: Iterable[str]) -> None:
    """Check that the robot has these targets and parts of the body, each named once.

    Raises:
        UnknownName: If it lacks one; lists those it has.
        BadValue: If there is no target, or a name occurs twice.
    """
    joints = [joint for arm in morphology.arms for joint in arm.joints]
    movable = (*morphology.command_space.names, *joints)
    targets, body = tuple(targets), tuple(body)
    if not targets:
        raise BadValue(f"there must be a target: {', '.join(morphology.frames)}")
    for kind, names, known in (
        ("target", targets, tuple(morphology.frames)),
        ("part of the body", body, movable),
    ):
        for name in names:
            if name not in known:
                raise UnknownName(kind, name, known)
            if names.count(name) > 1:
                raise BadValue(f"{kind} {name!r} is named twice")
