"""Methods and variants of a study, by name.

A method is a retargeter with a low-level policy. A variant is a set of user options: a binding that
the robot names, constraints and a preset, joined by underscores (`v2_upright_conservative`).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from xop_lerobot.core.errors import BadValue, PolicyFileError, UnknownName
from xop_lerobot.low_level.factory import make_policy, resolve_policy
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.retarget.config import CONSTRAINTS, PRESETS, RetargeterConfig


@dataclass(frozen=True)
class Method:
    """Method of a study.

    Attributes:
        title: Description for tables.
        retargeter: Settings of `RetargeterConfig`.
        low_level: Low-level policy of the method; empty to use the requested one.
    """

    title: str
    retargeter: Mapping[str, Any] = field(default_factory=dict)
    low_level: str = ""


METHODS: dict[str, Method] = {
    "mpc": Method("MPC retargeter"),
    "mpc_no_sync": Method("MPC, raw measurements into the planner", {"sync": False}),
    "mpc_table1": Method("MPC with the paper's Table I, literally", {"preset": "table1"}),
    "mpc_table1_charitable": Method(
        "MPC with the paper's Table I, charitably", {"preset": "table1_charitable"}
    ),
    "direct": Method("Direct mapping", {"type": "direct"}),
    "direct_amo": Method("Direct mapping with AMO", {"type": "direct"}, low_level="amo"),
}
"""Methods by name."""


def get_method(name: str) -> Method:
    """Return the method `name`.

    Raises:
        UnknownName: Listing the known ones.
    """
    if name not in METHODS:
        raise UnknownName("method", name, METHODS)
    return METHODS[name]


def parse_variant(morphology: Morphology, variant: str) -> dict[str, str]:
    """Parse a variant: a binding of the robot, constraints and a preset, in any order.

    Args:
        morphology: The robot.
        variant: Names joined by underscores; empty for the robot's defaults.

    Returns:
        Settings of `RetargeterConfig`.

    Raises:
        UnknownName: If a part is none of these, listing the known ones.
        BadValue: If there are two bindings or two presets.
    """
    bindings, constraints, presets = [], [], []
    for part in _split(variant, (*morphology.variants, *CONSTRAINTS, *PRESETS)):
        if part in morphology.variants:
            bindings.append(part)
        elif part in CONSTRAINTS:
            constraints.append(part)
        elif part in PRESETS:
            presets.append(part)
        else:
            known = (*morphology.variants, *CONSTRAINTS, *PRESETS)
            raise UnknownName(f"part of variant '{variant}' of {morphology.name}", part, known)
    for what, names in (("bindings", bindings), ("presets", presets)):
        if len(names) > 1:
            raise BadValue(f"variant '{variant}' has two {what}: {', '.join(names)}. Choose one")
    found = {
        "variant": "".join(bindings),
        "constraints": ",".join(constraints),
        "preset": "".join(presets),
    }
    return {name: value for name, value in found.items() if value}


def _split(variant: str, known: Iterable[str]) -> list[str]:
    """Split at underscores, except within a known name."""
    longest = "|".join(re.escape(name) for name in sorted(known, key=len, reverse=True))
    return re.findall(rf"(?:{longest})(?=_|$)|[^_]+", variant)


def make_retargeter_config(
    morphology: Morphology, method: str, variant: str = "", seed: int = 0
) -> RetargeterConfig:
    """Make the retargeter's configuration for one trial, with a single thread.

    Trials run in parallel, one per core, so more threads per trial would only compete.

    Raises:
        UnknownName: If method or variant are unknown, listing the known ones.
        BadValue: If the variant contradicts itself or the method.
    """
    own = dict(get_method(method).retargeter)
    added = parse_variant(morphology, variant)
    twice = own.keys() & added.keys()
    if twice:
        raise BadValue(
            f"method '{method}' sets {', '.join(sorted(twice))} itself; variant '{variant}' "
            "must not"
        )
    return RetargeterConfig(**{"threads": 1, "seed": seed, **own, **added})


def resolve_low_level(morphology: Morphology, method: str, low_level: str = "") -> str:
    """Return the name of the low-level policy that `method` runs with.

    Args:
        morphology: The robot.
        method: Name of the method.
        low_level: Requested policy; empty for the robot's own.

    Raises:
        UnknownName: If it does not fit the robot, listing those that do.
    """
    return resolve_policy(morphology, get_method(method).low_level or low_level)


def find_absence(low_level: str, path: str = "") -> str:
    """Return why a low-level policy cannot run here; empty if it can."""
    try:
        make_policy(low_level, path or None)
    except PolicyFileError as error:
        return f"weights not present: {error}"
    return ""
