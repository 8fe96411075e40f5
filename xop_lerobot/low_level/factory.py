"""Low-level policies by name: built-in tables, a user's own tables, and controllers in code."""

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
"""Factories by name, called as ``factory(path=None)``: built-in tables and controllers in code."""

for _name in list_tables():
    POLICIES.add(_name, partial(load_policy, _name))


def make_policy(name: str, path: str | None = None) -> LowLevelPolicy:
    """Make the low-level policy `name`.

    Args:
        name: A registered name such as ``"falcon"``, or the path of a table (``"my_policy.toml"``)
            or of an ONNX file with metadata.
        path: The policy's file, or the folder of its files; None for its default.

    Raises:
        UnknownName: Listing the known policies.
        PolicyFileError: If the table or a file is missing, altered or of the wrong shape.
    """
    if is_table(name):
        return load_policy(name, path)
    return POLICIES[name](path=path)


def list_policies(morphology: Morphology) -> tuple[str, ...]:
    """Names of the policies that fit a robot; its default first."""
    others = [name for name in list_tables() if find_robot(name) == morphology.name]
    return (*morphology.policies, *(name for name in others if name not in morphology.policies))


def resolve_policy(morphology: Morphology, name: str = "") -> str:
    """Resolve a policy name for a robot; empty and ``"default"`` mean the robot's own policy.

    Raises:
        UnknownName: If the policy does not fit the robot; lists those that do.
        PolicyFileError: If it is the path of a table that is missing, malformed, or for another
            robot.
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
