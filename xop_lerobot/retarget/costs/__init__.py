"""Cost terms of the controller (Eq. 3): tracking, effort, balance, collision."""

from xop_lerobot.retarget.costs.balance import (
    FallCost,
    LateralCost,
    StanceCost,
    SupportArea,
    SupportCost,
)
from xop_lerobot.retarget.costs.collision import CollisionCost
from xop_lerobot.retarget.costs.cost import Cost, Evaluation
from xop_lerobot.retarget.costs.effort import ChangeCost, ControlCost
from xop_lerobot.retarget.costs.factory import COSTS, make_costs
from xop_lerobot.retarget.costs.tracking import TerminalCost, TrackingCost, UprightCost

__all__ = [
    "COSTS",
    "ChangeCost",
    "CollisionCost",
    "ControlCost",
    "Cost",
    "Evaluation",
    "FallCost",
    "LateralCost",
    "StanceCost",
    "SupportArea",
    "SupportCost",
    "TerminalCost",
    "TrackingCost",
    "UprightCost",
    "make_costs",
]
