"""Cost terms of the controller, one file each (Eq. 3)."""

from xop_lerobot.retarget.costs.change import ChangeCost
from xop_lerobot.retarget.costs.collision import CollisionCost
from xop_lerobot.retarget.costs.control import ControlCost
from xop_lerobot.retarget.costs.cost import Cost, Evaluation
from xop_lerobot.retarget.costs.factory import make_costs
from xop_lerobot.retarget.costs.fall import FallCost
from xop_lerobot.retarget.costs.lateral import LateralCost
from xop_lerobot.retarget.costs.stance import StanceCost
from xop_lerobot.retarget.costs.support import SupportArea, SupportCost
from xop_lerobot.retarget.costs.terminal import TerminalCost
from xop_lerobot.retarget.costs.tracking import TrackingCost
from xop_lerobot.retarget.costs.upright import UprightCost

__all__ = [
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
