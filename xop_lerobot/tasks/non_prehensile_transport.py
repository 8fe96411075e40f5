"""Non-prehensile transport: a toy on the open palm, past obstacles, into a narrow opening."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from xop_lerobot.core.transforms import (
    make_pose,
    pose_inverse,
    pose_multiply,
    quat_from_yaw,
    quat_multiply,
)
from xop_lerobot.operator.display import SeenObject
from xop_lerobot.session import TaskStatus
from xop_lerobot.tasks import furniture, palm
from xop_lerobot.tasks.furniture import ROBOT, Touching, compute_speed, compute_tilt
from xop_lerobot.tasks.layout import find_palms, make_direction, measure_pad, measure_reach
from xop_lerobot.tasks.task import Hold, Task

if TYPE_CHECKING:
    from xop_lerobot.morphology.morphology import Morphology
    from xop_lerobot.plant.simulation import Simulation

TOY = (0.016, 0.012, 0.012)
"""Half extents of the toy [m]; it is 3.2 cm long."""
TOY_MASS = 0.05
"""Mass of the toy [kg]."""
TOY_FRICTION = (0.5, 0.003, 0.0001)
"""Friction of hard rubber: sliding [1], torsion [m], rolling [m]. It slips at a tilt of 27°."""

OPENING = (0.05, 0.025)
"""Half extents of the container's opening [m]: 10 by 5 cm."""
WALL, DEPTH = 0.008, 0.12
"""Thickness of the container's walls, and its depth [m]."""
OBSTACLE = (0.02, 0.05)
"""Half thickness of the obstacles across the path, and half their breadth along X [m]."""

WALK_BEARING = 0.3
"""Largest bearing of the required walk, to either side [rad]."""
AHEAD = (0.0, 0.08)
"""Distance of the opening ahead of the toy at the start [m]."""
FREE, SPREAD = 0.05, 0.04
"""Gap between hand and obstacle on either side, and its largest random addition [m]."""
FALL = 0.065
"""Measured distance that the toy falls beyond the edge of the rolled palm [m]."""
FAR = 0.26
"""Distance of the second obstacle beyond the opening [m]."""
RIM = (0.10, 0.06)
"""Depth of the rim below the starting palm, largest and least [m]."""
OVER = (0.02, 0.05)
"""Height of the obstacles' tops above the starting palm [m]."""

HELD_S, LEVEL, STILL, CARRIED = 0.5, math.radians(8), 0.05, 0.25
"""The toy is held on the palm until the palm is level to within [rad] and slower than [m/s] for
this long [s], or has moved by this distance [m]."""
HELD_AT_LEAST_S = 1.5
"""Least time for which it is held at the start, while an operator takes over [s]."""
INSIDE_S, AT_REST = 0.5, 0.05
"""Delivered: inside the container for this long [s], slower than [m/s]."""

ORANGE, BLUE = (0.96, 0.62, 0.10, 1), (0.25, 0.45, 0.72, 1)
RED, STEEL = (0.78, 0.28, 0.22, 1), (0.35, 0.36, 0.38, 1)


class NonPrehensileTransport(Task):
    """Carry a toy that lies loose on the open left palm over obstacles, and drop it into a box.

    The robot starts with the palm up and the toy on it, held in place until the palm is level and
    still. Touching an obstacle fails the task, as does the toy on the floor.
    """

    name = "non_prehensile_transport"
    instruction = "Carry the toy on the open left palm past the obstacles and drop it into the box."
    time_limit = 60.0
    room = "small_room"
    furniture = ("container", "obstacle_0", "obstacle_1")
    handled = ("container",)
    close_by = ("obstacle_0", "obstacle_1")
    ends_on_collision = True

    def __init__(self, morphology: Morphology) -> None:
        super().__init__(morphology)
        self.reach, self.pad = measure_reach(morphology), measure_pad(morphology)
        self._held, self._inside = Hold(HELD_S), Hold(INSIDE_S)
        self.has_tray = morphology.work.tray
        model = morphology.build_spec("full").compile()
        data = mujoco.MjData(model)
        data.qpos[:] = morphology.standing_qpos()
        mujoco.mj_kinematics(model, data)
        site, wrist = find_palms(morphology, model)["left_palm"], morphology.frames["left_wrist"]
        poses = [_get_site_pose(model, data, name) for name in (wrist, site)]
        self._palm_in_wrist = pose_multiply(pose_inverse(poses[0]), poses[1])
        self._left = float(poses[1][1]) + 0.1 * self.reach.arm
        self._site = site
        body = int(model.site(site).bodyid[0])
        self._body = model.body(body).name
        palm_in_body = make_pose(model.site(site).pos, model.site(site).quat)
        self._toy_in_body = pose_multiply(palm_in_body, self.toy_in_palm)

    @property
    def toy_in_palm(self) -> np.ndarray:
        """Pose of the toy in the palm site's frame at the start. Shape (7,)."""
        forward, depth = self.pad.forward, self.pad.depth
        if self.has_tray:
            forward = palm.compute_tray_forward(self.pad)
            depth += 2 * palm.TRAY_HALF[2]
        # A palm's Z axis points out of the back of the hand, so the toy is on -Z.
        return make_pose(np.array([forward, 0, -depth - TOY[2]]), np.array([0.0, 1, 0, 0]))

    @property
    def hints(self) -> Mapping[str, float]:
        """Position of the toy on the palm, and how it falls off.

        - `toy_forward`, `toy_over`: middle of the toy ahead of the palm's site along the hand, and
          above it out of the palm.
        - `edge`: distance from the middle of the palm to the edge over which the toy slides when
          the palm rolls to the right.
        - `fall`: distance that it falls beyond that edge.
        """
        toy = self.toy_in_palm
        return {
            "toy_forward": float(toy[0]),
            "toy_over": float(-toy[2]),
            "edge": self._edge,
            "fall": FALL,
        }

    @property
    def _edge(self) -> float:
        return palm.TRAY_HALF[1] if self.has_tray else palm.BARE_EDGE

    @property
    def start_arms(self) -> Mapping[str, float]:
        """Left arm angles with the palm up in front of the robot [rad]."""
        return self._start_arms

    @cached_property
    def _start_arms(self) -> Mapping[str, float]:
        return palm.find_start_arms(self.morphology, self.start_palm, self._palm_in_wrist)

    @cached_property
    def start_palm(self) -> np.ndarray:
        """Position of the palm at the start [m]. Shape (3,)."""
        return palm.compute_start(self.reach, self._left)

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add tray, toy, container and obstacles."""
        if self.has_tray:
            palm.add_tray(spec, self._site, self.pad)
        self._add_container(spec)
        for i, colour in enumerate((RED, RED)):
            body = furniture.add_furniture_body(spec, f"obstacle_{i}", i + 1)
            half = (OBSTACLE[0], OBSTACLE[1], 0.75)
            furniture.add_solid(body, f"obstacle_{i}", "box", half, (0, 0, -0.75), colour)
        toy = furniture.add_object_body(spec, "toy", TOY[2])
        geom = furniture.add_solid(toy, "toy", "box", TOY, (0, 0, 0), ORANGE, TOY_FRICTION)
        geom.mass, geom.condim, geom.priority = TOY_MASS, 4, 1
        geom.conaffinity = furniture.OBJECT_CONTACT["conaffinity"]
        weld = spec.add_equality(
            name="toy_held",
            type=mujoco.mjtEq.mjEQ_WELD,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            name1=self._body,
            name2="toy",
            active=False,
        )
        weld.data[:11] = [0, 0, 0, *self._toy_in_body, 1]

    def _add_container(self, spec: mujoco.MjSpec) -> None:
        """Add four walls and a bottom on a column; the frame is centred in the rim."""
        body = furniture.add_furniture_body(spec, "container")
        x, y, wall = *OPENING, WALL / 2
        middle = -DEPTH / 2
        for name, size, pos in (
            ("front", (wall, y + WALL, DEPTH / 2), (x + wall, 0, middle)),
            ("back", (wall, y + WALL, DEPTH / 2), (-x - wall, 0, middle)),
            ("left", (x, wall, DEPTH / 2), (0, y + wall, middle)),
            ("right", (x, wall, DEPTH / 2), (0, -y - wall, middle)),
            ("bottom", (x + WALL, y + WALL, wall), (0, 0, -DEPTH - wall)),
        ):
            furniture.add_solid(body, f"container_{name}", "box", size, pos, BLUE)
        column = (0.025, 0.025, 0.6)
        below = -DEPTH - WALL - column[2]
        furniture.add_solid(body, "container_column", "box", column, (0, 0, below), STEEL)

    def bind(self, plant: Simulation) -> None:
        """Find the contacts of the toy, and the constraint that holds it."""
        self.plant = plant
        self._touching = Touching(plant, "toy")
        self._weld = plant.model.equality("toy_held").id

    def reset(self, rng: np.random.Generator) -> None:
        """Place container and obstacles at random; the toy is held on the palm."""
        bearing = rng.uniform(-WALK_BEARING, WALK_BEARING)
        low, high = self.morphology.work.walk
        walk = rng.uniform(low, high)
        facing = bearing if walk else 0.0
        ahead, left = make_direction(facing), make_direction(facing + math.pi / 2)
        start, edge = self.start_palm, self._edge
        origin = (walk + start[0]) * ahead + start[1] * left
        # From left to right: the hand, free space, the obstacle, free space, the hand beside the
        # opening, over which the toy falls from the hand's edge.
        obstacle = edge + FREE + OBSTACLE[0] + rng.uniform(0, SPREAD)
        across = obstacle + OBSTACLE[0] + FREE + 2 * edge + FALL + rng.uniform(0, SPREAD)
        forward = self.toy_in_palm[0] + rng.uniform(*AHEAD)
        opening = origin + forward * ahead - across * left
        opening[2] = start[2] - rng.uniform(min(RIM), max(RIM))
        # The container's X axis, the long side of its opening, points to the right.
        quat = quat_from_yaw(facing - math.pi / 2)
        furniture.place(self.plant, "container", opening, quat)
        first = origin - obstacle * left
        second = opening + FAR * ahead + rng.uniform(-0.1, 0.1) * left
        for i, position in enumerate((first, second)):
            position[2] = start[2] + rng.uniform(*OVER)
            turned = quat if i == 0 else quat_from_yaw(facing)
            furniture.place(self.plant, f"obstacle_{i}", position, turned)
        self.facing = facing
        self._hold_toy()
        self._began = self.plant.time
        self._start = self.plant.get_site_pose(self._site)[:3]
        self._held.reset()
        self._inside.reset()
        self._last_palm = (self.plant.time, self._start)
        self._free_time = self._let_go_time = math.nan
        self._success, self._failure = False, ""

    def _hold_toy(self) -> None:
        """Place the toy on the palm and hold it there."""
        hand = furniture.get_body_pose(self.plant, self._body)
        self.plant.set_object_pose("toy", pose_multiply(hand, self._toy_in_body))
        self.plant.data.eq_active[self._weld] = 1

    def _free_toy(self, palm_pose: np.ndarray) -> None:
        """Release the toy once the palm is level and still, or has moved by `CARRIED`."""
        time, (last, position) = self.plant.time, self._last_palm
        speed = math.dist(palm_pose[:3], position) / (time - last) if time > last else 0.0
        self._last_palm = (time, palm_pose[:3])
        tilt = compute_tilt(quat_multiply(palm_pose[3:], np.array([0.0, 1, 0, 0])))
        still = self._held.update(time, tilt < LEVEL and speed < STILL)
        moved = math.dist(palm_pose[:3], self._start) > CARRIED
        if moved or (still and time - self._began >= HELD_AT_LEAST_S):
            self.plant.data.eq_active[self._weld] = 0
            self._free_time = time

    def update(self) -> TaskStatus:
        """Update the status: held, on the palm, in the container, or dropped."""
        time, touched = self.plant.time, self._touching.find()
        palm_pose = self.plant.get_site_pose(self._site)
        if self.plant.data.eq_active[self._weld]:
            self._free_toy(palm_pose)
        elif math.isnan(self._let_go_time) and ROBOT not in touched:
            # No contact may be a bounce: it has left the palm only beyond the palm's edge.
            local = pose_multiply(pose_inverse(palm_pose), self.plant.get_object_pose("toy"))
            if math.dist(local[:3], self.toy_in_palm[:3]) > self._edge:
                self._let_go_time = time
        inside = self._is_inside() and compute_speed(self.plant, "toy") < AT_REST
        self._success |= self._inside.update(time, inside)
        if "floor" in touched and not self._success:
            self._failure = "the toy was dropped"
        figures = {
            "tilt_rad": compute_tilt(quat_multiply(palm_pose[3:], np.array([0.0, 1, 0, 0]))),
            "carried": float(not math.isnan(self._free_time) and math.isnan(self._let_go_time)),
        }
        if not math.isnan(self._free_time):
            figures["free_time_s"] = self._free_time
        if not math.isnan(self._let_go_time):
            figures["let_go_time_s"] = self._let_go_time
        return TaskStatus(
            self._success, self._success or bool(self._failure), self._failure, figures=figures
        )

    def _is_inside(self) -> bool:
        """Whether the toy's middle is within the walls and below the rim."""
        container = furniture.get_body_pose(self.plant, "container")
        local = pose_multiply(pose_inverse(container), self.plant.get_object_pose("toy"))[:3]
        return bool((np.abs(local[:2]) < OPENING).all() and -DEPTH < local[2] < 0)

    @property
    def objects(self) -> Mapping[str, SeenObject]:
        """Toy, container, its opening (X along the 10 cm, to the right) and obstacles."""
        container = furniture.get_body_pose(self.plant, "container")
        half = np.array([OPENING[0] + WALL, OPENING[1] + WALL, (DEPTH + WALL) / 2])
        seen = {
            "toy": SeenObject(self.plant.get_object_pose("toy"), np.array(TOY)),
            "container": SeenObject(container - [0, 0, half[2], 0, 0, 0, 0], half),
            "opening": SeenObject(container, np.array([*OPENING, 0])),
        }
        for i in range(2):
            pose = furniture.get_body_pose(self.plant, f"obstacle_{i}")
            height = pose[2] / 2
            size = np.array([OBSTACLE[0], OBSTACLE[1], height])
            seen[f"obstacle_{i}"] = SeenObject(pose - [0, 0, height, 0, 0, 0, 0], size)
        return seen


def _get_site_pose(model: mujoco.MjModel, data: mujoco.MjData, name: str) -> np.ndarray:
    """Pose of a site. Shape (7,)."""
    quat = np.empty(4)
    site = model.site(name).id
    mujoco.mju_mat2Quat(quat, data.site_xmat[site])
    return make_pose(data.site_xpos[site], quat)
