"""List of all cost terms, and the factory of those of a robot."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.retarget.costs.balance import (
    FallCost,
    LateralCost,
    StanceCost,
    SupportArea,
    SupportCost,
)
from xop_lerobot.retarget.costs.collision import CollisionCost
from xop_lerobot.retarget.costs.cost import Cost
from xop_lerobot.retarget.costs.effort import ChangeCost, ControlCost
from xop_lerobot.retarget.costs.tracking import TerminalCost, TrackingCost, UprightCost
from xop_lerobot.retarget.static_load import StaticLoad

if TYPE_CHECKING:
    from xop_lerobot.retarget.model.command_model import CommandModel


COSTS: tuple[type[Cost], ...] = (
    TrackingCost,
    StanceCost,
    CollisionCost,
    UprightCost,
    ControlCost,
    ChangeCost,
    TerminalCost,
    SupportCost,
    LateralCost,
    FallCost,
)
"""All terms; datasets store them in this order, so append new ones."""


def make_costs(
    morphology: Morphology,
    command_model: CommandModel,
    support: SupportArea | None,
    collision: CollisionCost,
    fall: FallCost,
    load: StaticLoad | None = None,
) -> tuple[Cost, ...]:
    """Make all of `COSTS`; terms that do not apply to a robot are zero."""
    space = command_model.space
    costs = (
        TrackingCost(),
        TerminalCost(),
        StanceCost(morphology.contact_groups, morphology.contact_kind),
        collision,
        ControlCost((space.high - space.low) / 2),
        ChangeCost((space.high - space.low) / 2),
        UprightCost(),
        SupportCost(support, load),
        LateralCost(command_model.is_nonholonomic),
        fall,
    )
    assert {type(cost) for cost in costs} == set(COSTS)
    return costs
