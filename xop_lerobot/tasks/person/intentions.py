"""Registry of the simulated person's intentions, by task name."""

from __future__ import annotations

from collections.abc import Callable

from xop_lerobot.core.registry import Registry
from xop_lerobot.tasks.person.box_pick_and_place import carry_box
from xop_lerobot.tasks.person.dual_point_touch import (
    reach_two_points,
    touch_two_points,
)
from xop_lerobot.tasks.person.mind import Doing, Mind
from xop_lerobot.tasks.person.non_prehensile_transport import carry_toy, meet_hand

INTENTIONS: Registry[Callable[[Mind], Doing]] = Registry("task of the simulated operator")
"""Performs a task, as a generator over ticks, by task name."""
INTENTIONS.add("dual_point_touch", touch_two_points)
INTENTIONS.add("dual_point_reach", reach_two_points)
INTENTIONS.add("box_pick_and_place", carry_box)
INTENTIONS.add("non_prehensile_transport", carry_toy)

PREPARATIONS: dict[str, Callable[[Mind], None]] = {"non_prehensile_transport": meet_hand}
"""Posture taken before engaging, by the name of a task that needs one."""
