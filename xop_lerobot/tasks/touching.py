"""What touches what in a simulation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

if TYPE_CHECKING:
    from xop_lerobot.plant.simulation import Simulation

ROBOT = "robot"
"""What `Touching.find` calls any part of the robot."""


class Touching:
    """Finds what touches a body.

    Args:
        plant: The simulation.
        name: The body.
    """

    def __init__(self, plant: Simulation, name: str) -> None:
        self._data = plant.data
        model = plant.model
        body = model.body(name).id
        self._own = np.flatnonzero(model.geom_bodyid == body)
        root = model.body_rootid[model.body(plant.morphology.base_body).id]
        self._names = []
        for geom in range(model.ngeom):
            holder = int(model.geom_bodyid[geom])
            if model.body_rootid[holder] == root:
                self._names.append(ROBOT)
            elif holder == 0:
                self._names.append(model.geom(geom).name)
            else:
                self._names.append(model.body(holder).name)

    def find(self) -> set[str]:
        """Names of furniture, walls, floor and objects that touch it; `robot` for the robot."""
        data = self._data
        if data.ncon == 0:
            return set()
        pairs = data.contact.geom
        is_own = np.isin(pairs, self._own)
        met = np.where(is_own[:, :1], pairs[:, 1:], pairs[:, :1])[:, 0]
        hits = met[is_own.any(axis=1) & (data.contact.dist <= 0)]
        return {self._names[int(geom)] for geom in hits}


def compute_speed(plant: Simulation, name: str) -> float:
    """Speed of a free body's middle [m/s]."""
    velocity = np.zeros(6)
    body = plant.model.body(name).id
    mujoco.mj_objectVelocity(plant.model, plant.data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
    return float(np.linalg.norm(velocity[3:]))


def compute_tilt(quat: np.ndarray) -> float:
    """Angle between a body's Z axis and the vertical [rad]."""
    _, x, y, _ = quat / np.linalg.norm(quat)
    return float(np.arccos(np.clip(1 - 2 * (x * x + y * y), -1, 1)))
