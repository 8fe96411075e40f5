"""Box pick-and-place: carry a box with both hands from a support to a table a few steps away."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from xop_lerobot.core.transforms import make_pose, quat_conjugate, quat_from_yaw, quat_rotate
from xop_lerobot.operator.display import SeenObject
from xop_lerobot.session import TaskStatus
from xop_lerobot.tasks import furniture
from xop_lerobot.tasks.furniture import ROBOT, Touching, compute_speed, compute_tilt
from xop_lerobot.tasks.heights import HeightRange
from xop_lerobot.tasks.layout import (
    find_palms,
    make_direction,
    measure_draw_in,
    measure_pad,
    measure_reach,
)
from xop_lerobot.tasks.task import Hold, Task

if TYPE_CHECKING:
    import mujoco

    from xop_lerobot.morphology.morphology import Morphology
    from xop_lerobot.plant.simulation import Simulation

BOX = (0.08, 0.13, 0.10)
"""Half extents of the box: depth, width, height [m]."""
BOX_MASS = 0.6
"""Mass of a nearly empty cardboard box [kg]."""
BOX_FRICTION = (0.9, 0.02, 0.001)
"""Friction of cardboard on rubber palms and mats: sliding [1], torsion [m], rolling [m]. Tables of
friction give 0.5 to 0.8 for rubber on cardboard, about 1 for soft rubber on dry paper; torsion is
for contact patches of a few centimetres."""
COMPLIANCE = (0.04, 1.0)
"""MuJoCo's time constant [s] and damping ratio of its contacts: box and palm give by about a
centimetre under 100 N. With stiffer ones the grip of a stiff arm rises from zero to full torque
within millimetres."""
LOOK_INSET = 0.005
"""Inset of the visual box on either side, since its soft sides yield [m]."""

SUPPORT = (0.14, 0.17)
"""Half extents of the support's top: depth, width [m]."""
TABLE = (0.22, 0.34)
"""Half extents of the table's top: depth, width [m]."""
TOP = 0.02
"""Half thickness of both tops [m]."""
COLUMN = 1.2
"""Length of the columns, which extend below the floor [m]."""
SPOT = 0.02
"""Distance of the marked spot from the edge, beyond the box's half depth [m]."""

GAP = (0.25, 0.40)
"""Distance from the resting palms to the middle of the box at the start [m]."""
BEARING = 0.3
"""Largest bearing of the box [rad]."""
TURN = (1.2, 1.9)
"""Absolute bearing of the table from the start, to either side [rad]."""
TABLE_DISTANCE = (0.95, 1.15)
"""Distance of the marked spot from the start [m]."""
LEVELS = {"support": (-0.03, 0.03), "table": (-0.06, 0.0)}
"""Heights of the tops relative to that at which the box's middle is level with the resting palms
[m]."""

WRIST_GAP = 0.01
"""Gap between the end of the arm, which is thicker than the hand, and the box [m]."""
LIFT, LIFTED_S = 0.03, 3.0
"""Picked up: this high above its rest [m], for this long [s], held by the robot alone."""
PLACED_S, UPRIGHT, STILL = 1.0, math.radians(15), 0.02
"""Placed: upright to within [rad], slower than [m/s] and released on the table for this long
[s]."""

WOOD, STEEL, CARDBOARD = (0.72, 0.55, 0.38, 1), (0.35, 0.36, 0.38, 1), (0.78, 0.60, 0.40, 1)
PALE, MARK, TAPE = (0.82, 0.80, 0.76, 1), (0.12, 0.55, 0.30, 1), (0.90, 0.84, 0.70, 1)


class BoxPickAndPlace(Task):
    """Squeeze a box between both hands, lift it, carry it to a table, put it down, let go.

    The box stands on a support in front of the robot, one step out of reach; the table is to one
    side. Both tops overhang their columns, so that a robot can come close.
    """

    name = "box_pick_and_place"
    instruction = "Pick up the box with both hands and put it on the green mark of the table."
    time_limit = 150.0
    room = "small_room"
    furniture = ("support", "table")
    handled = ("support", "table")
    passable = ("support_top", "table_top")

    def __init__(self, morphology: Morphology) -> None:
        super().__init__(morphology)
        self.reach, self.pad = measure_reach(morphology), measure_pad(morphology)
        model = morphology.build_spec("full").compile()
        self._palms = tuple(find_palms(morphology, model).values())
        self._draw_in = measure_draw_in(morphology)
        self._lifted, self._placed = Hold(LIFTED_S), Hold(PLACED_S)

    @property
    def height_limits(self) -> Mapping[str, HeightRange]:
        """Allowed heights of the tops of support and table."""
        level = self.reach.height - BOX[2]
        usual = (level + LEVELS["table"][0], level + LEVELS["support"][1])
        return dict.fromkeys(self.furniture, self.morphology.top_heights or usual)

    @property
    def hints(self) -> Mapping[str, float]:
        """How to grasp the box.

        - `palm_forward`: offset of the palm sites beyond the box's middle, along the hands: as far
          as possible without the arms, which are thicker than the hands, touching the box.
        - `palm_outside`: distance of a palm's site from the box's side in contact.
        - `press`: additional inward offset of the wrist goals, which squeezes the box.
        - `draw_in`: distance by which the hands may be drawn in while walking up to it.
        """
        return {
            "palm_forward": min(-self.pad.forward, -self.pad.wrist_end - BOX[0] - WRIST_GAP),
            "palm_outside": self.pad.depth,
            "press": self.morphology.work.press,
            "draw_in": self._draw_in,
        }

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add support, table with its mark, and box."""
        for index, (name, half, colour) in enumerate(
            (("support", SUPPORT, PALE), ("table", TABLE, WOOD))
        ):
            body = furniture.add_furniture_body(spec, name, index)
            furniture.add_solid(body, f"{name}_top", "box", (*half, TOP), (0, 0, -TOP), colour)
            column = (0.06, half[1] * 0.6, COLUMN / 2)
            position = (half[0] - 0.08, 0, -2 * TOP - COLUMN / 2)
            furniture.add_solid(body, f"{name}_column", "box", column, position, STEEL)
        mark = (BOX[0], BOX[1], 0.001)
        furniture.add_look(spec.body("table"), "spot", "box", mark, (self._spot_offset, 0, 0), MARK)
        box = furniture.add_object_body(spec, "box", BOX[2])
        geom = furniture.add_solid(box, "box", "box", BOX, (0, 0, 0), (0, 0, 0, 0), BOX_FRICTION)
        look = (BOX[0], BOX[1] - LOOK_INSET, BOX[2])
        furniture.add_look(box, "box_look", "box", look, (0, 0, 0), CARDBOARD)
        geom.mass, geom.condim, geom.priority = BOX_MASS, 4, 1
        geom.solref = COMPLIANCE
        geom.conaffinity = furniture.OBJECT_CONTACT["conaffinity"]
        furniture.add_grip(spec, geom, self._palms, BOX_FRICTION, COMPLIANCE)
        tape = (0.02, BOX[1] - LOOK_INSET + 0.0005, BOX[2] + 0.0005)
        furniture.add_look(box, "box_tape", "box", tape, (0, 0, 0), TAPE)

    @property
    def _spot_offset(self) -> float:
        """Offset of the spot from the middle of the table, away from the robot [m]."""
        return BOX[0] + SPOT - TABLE[0]

    def bind(self, plant: Simulation) -> None:
        """Find the bodies in contact with the box."""
        self.plant = plant
        self._touching = Touching(plant, "box")

    def reset(self, rng: np.random.Generator) -> None:
        """Place support and box in front of the robot, and the table to one side."""
        level = self.reach.height - BOX[2]
        bearing = rng.uniform(-BEARING, BEARING)
        facing = bearing + rng.uniform(-BEARING, BEARING) / 2
        box = (self.reach.forward + rng.uniform(*GAP)) * make_direction(bearing)
        top = self.draw_height(rng, "support", level, LEVELS["support"])
        offset = SUPPORT[0] - BOX[0] - SPOT
        quat = quat_from_yaw(facing)
        furniture.place(
            self.plant, "support", box + offset * make_direction(facing) + [0, 0, top], quat
        )
        self.plant.set_object_pose("box", make_pose(box + [0, 0, top + BOX[2]], quat))
        self._rest = top + BOX[2]
        self._seen = (math.inf, box)

        turn = rng.choice([-1, 1]) * rng.uniform(*TURN)
        spot = rng.uniform(*TABLE_DISTANCE) * make_direction(turn)
        facing = turn + rng.uniform(-BEARING, BEARING) / 2
        top = self.draw_height(rng, "table", level, LEVELS["table"])
        middle = spot - self._spot_offset * make_direction(facing) + [0, 0, top]
        furniture.place(self.plant, "table", middle, quat_from_yaw(facing))

        self._lifted.reset()
        self._placed.reset()
        self._pickup_time = math.nan
        self._picked_up = self._success = False
        self._failure = ""

    def update(self) -> TaskStatus:
        """Update the status: held up, placed on the table, or dropped."""
        touched, time = self._touching.find(), self.plant.time
        pose = self.plant.get_object_pose("box")
        lift, tilt = pose[2] - self._rest, compute_tilt(pose[3:])
        speed = self._compute_speed(time, pose[:3])
        held = touched == {ROBOT} and lift > LIFT
        if self._lifted.update(time, held) and not self._picked_up:
            self._picked_up, self._pickup_time = True, time
        stands = touched == {"table"} and tilt < UPRIGHT and speed < STILL
        stands = stands and self._picked_up and self._is_over_table(pose[:3])
        self._success |= self._placed.update(time, stands)
        if "floor" in touched and not self._success:
            self._failure = "the box was dropped"
        spot = self.objects["spot"].pose
        figures = {
            "lift_m": lift,
            "held_s": self._lifted.duration,
            "tilt_rad": tilt,
            "speed_m_s": speed,
            "spot_distance_m": math.dist(spot[:2], pose[:2]),
        }
        if self._picked_up:
            figures["pickup_time_s"] = self._pickup_time
        return TaskStatus(
            self._success, self._success or bool(self._failure), self._failure,
            self._picked_up, {name: float(value) for name, value in figures.items()},
        )  # fmt: skip

    def _compute_speed(self, time: float, position: np.ndarray) -> float:
        """Mean speed since the last call [m/s]; the instantaneous one jitters at rest."""
        (before, place), self._seen = self._seen, (time, position)
        if time <= before:
            return compute_speed(self.plant, "box")
        return math.dist(position, place) / (time - before)

    def _is_over_table(self, position: np.ndarray) -> bool:
        table = furniture.get_body_pose(self.plant, "table")
        local = quat_rotate(quat_conjugate(table[3:]), position - table[:3])
        return bool((np.abs(local[:2]) < TABLE).all())

    @property
    def objects(self) -> Mapping[str, SeenObject]:
        """Box, support, table (poses of their middles) and the spot on the table's top.

        X points away from a person who faces the object.
        """
        seen = {"box": SeenObject(self.plant.get_object_pose("box"), np.array(BOX))}
        for name, half in (("support", SUPPORT), ("table", TABLE)):
            pose = furniture.get_body_pose(self.plant, name)
            pose[2] -= TOP
            seen[name] = SeenObject(pose, np.array([*half, TOP]))
        table = furniture.get_body_pose(self.plant, "table")
        spot = table[:3] + quat_rotate(table[3:], np.array([self._spot_offset, 0, 0]))
        seen["spot"] = SeenObject(make_pose(spot, table[3:]), np.array([BOX[0], BOX[1], 0]))
        return seen
