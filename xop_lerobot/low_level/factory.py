"""Low-level policies by name: tables that ship with the package, tables of one's own, and code."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from xop_lerobot.core.errors import PolicyFileError, UnknownName
from xop_lerobot.core.registry import Registry
from xop_lerobot.low_level.policy import LowLevelPolicy
from xop_lerobot.low_level.tables import find_robot, is_table, list_tables, load_policy

if TYPE_CHECKING:
    from xop_lerobot.morphology.morphology import Morphology

POLICIES: Registry[Callable[..., LowLevelPolicy]] = Registry(
    "low-level policy",
    {
        "diff_drive": "xop_lerobot.low_level.base_drive:DiffDrive",
        "mecanum_drive": "xop_lerobot.low_level.base_drive:MecanumDrive",
    },
)
"""Factories by name, called as ``factory(path=None)``: the tables that ship with the package, and
the policies that are code."""

for _name in list_tables():
    POLICIES.add(_name, partial(load_policy, _name))


def make_policy(name: str, path: str | None = None) -> LowLevelPolicy:
    """Make the low-level policy `name`.

    Args:
        name: A registered name, for example ``"falcon"``, or the path of a table of your own,
            ``"my_policy.toml"``, or of an ONNX file that describes itself.
        path: The policy's file, or the folder of its files; None for its own default.

    Raises:
        UnknownName: Listing the known policies.
        PolicyFileError: If the table or a file is missing, altered or of the wrong shape.
    """
    if is_table(name):
        return load_policy(name, path)
    return POLICIES[name](path=path)


def list_policies(morphology: Morphology) -> tuple[str, ...]:
    """Names of the policies that fit a robot; its own first."""
    others = [name for name in list_tables() if find_robot(name) == morphology.name]
    return (*morphology.policies, *(name for name in others if name not in morphology.policies))


def resolve_policy(morphology: Morphology, name: str = "") -> str:
    """Return the policy that `name` means for a robot: empty and ``"default"`` are its own.

    Raises:
        UnknownName: If it does not fit the robot, with those that do.
        PolicyFileError: If it is the path of a table that is missing or malformed.
    """
    if is_table(name):
        robot = find_robot(name)
        if robot != morphology.name:
            raise PolicyFileError(
                f"policy table '{name}' is for robot '{robot}', not '{morphology.name}'"
            )
        return name
    known = list_policies(morphology)
    if name in known:
        return name
    if name in ("", "default"):
        return known[0]
    raise UnknownName(f"low-level policy of {morphology.name}", name, known)
