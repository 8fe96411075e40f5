"""Where the parts of the robot are that the cost terms ask for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numpy as np

from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.morphology.sensing import Sensing
from xop_lerobot.retarget.model.linearisation import Placement


class Parts(NamedTuple):
    """Places of a batch of states; leading dimensions as asked.

    Attributes:
        poses: Pose of each tracked frame. Shapes (..., 7).
        points: Position of contact and hull sites [m]. Shapes (..., 3).
        velocities: Velocity of contact sites [m/s]; only of rollouts. Shapes (..., 3).
        com: Centre of mass [m]; empty for a robot without a support area. Shape (..., 3).
    """

    poses: Mapping[str, np.ndarray]
    points: Mapping[str, np.ndarray]
    velocities: Mapping[str, np.ndarray]
    com: np.ndarray


class Readings:
    """Reads rollouts' sensor data, and places the sites of other configurations.

    Args:
        morphology: The robot.
        model: Its planning model.
        hull: Sites that obstacles are avoided with.
    """

    def __init__(
        self, morphology: Morphology, model: mujoco.MjModel, hull: Mapping[str, float]
    ) -> None:
        self._sensing = Sensing(model)
        self._frames, self._hull = morphology.frames, tuple(hull)
        self._contacts = morphology.contact_points
        self._com_of = morphology.base_body if morphology.support else None
        self._model = model
        self._placements: dict[tuple[str, ...], Placement] = {}

    def _get_placement(self, sites: tuple[str, ...]) -> Placement:
        if sites not in self._placements:
            self._placements[sites] = Placement(self._model, sites, self._hull, self._com_of)
        return self._placements[sites]

    def compute_poses(self, qpos: np.ndarray, frames: Mapping[str, str]) -> dict[str, np.ndarray]:
        """Poses of tracked frames, given with their sites, in one configuration. Shapes (7,)."""
        poses, _, _ = self._get_placement(tuple(frames.values())).compute(qpos[None])
        return {name: poses[site][0] for name, site in frames.items()}

    def compute_com(self, qpos: np.ndarray) -> np.ndarray:
        """Centre of mass in one configuration [m]. Shape (3,)."""
        return self._get_placement(()).compute(qpos[None])[2][0]

    def place(self, qpos: np.ndarray, frames: Mapping[str, str]) -> Parts:
        """Places in configurations, (n, nq): tracked frames, hull and centre of mass."""
        poses, points, com = self._get_placement(tuple(frames.values())).compute(qpos)
        return Parts({name: poses[site] for name, site in frames.items()}, points, {}, com)

    def read(self, sensordata: np.ndarray, frames: Mapping[str, str]) -> Parts:
        """Places in rollouts, from `Prediction.sensordata`, (K, H + 1, n)."""
        sensing = self._sensing
        return Parts(
            {name: sensing.read_pose(sensordata, site) for name, site in frames.items()},
            {
                site: sensing.read_position(sensordata, site)
                for site in (*self._contacts, *self._hull)
            },
            {site: sensing.read_velocity(sensordata, site) for site in self._contacts},
            sensing.read_com(sensordata) if self._com_of else np.zeros(0),
        )
