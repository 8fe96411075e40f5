"""Sensors of the planning model that rollouts read; MuJoCo evaluates them in its own threads."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.transforms import make_pose

if TYPE_CHECKING:
    import mujoco

    from xop_lerobot.morphology.morphology import Morphology


def add_sensing(spec: mujoco.MjSpec, morphology: Morphology) -> None:
    """Add the sensors that `Sensing` reads to a robot's planning model.

    Poses of the tracked frames, positions of the contact and hull points, and velocities of the
    contact points. They cost almost nothing in the physics, while forward
    kinematics of all predicted states would cost about a tenth of it.
    """
    import mujoco  # noqa: PLC0415

    kinds = mujoco.mjtSensor
    frames = tuple(dict.fromkeys(morphology.frames.values()))
    contacts = morphology.contact_points
    points = tuple(dict.fromkeys((*frames, *contacts, *morphology.hull_points)))
    for kind, label, sites in (
        (kinds.mjSENS_FRAMEPOS, "position", points),
        (kinds.mjSENS_FRAMEQUAT, "quat", frames),
        (kinds.mjSENS_FRAMELINVEL, "velocity", contacts),
    ):
        for site in sites:
            spec.add_sensor(
                name=f"{label}:{site}", type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site
            )


class Sensing:
    """Reads sensor data of rollouts by name, with any leading dimensions.

    Args:
        model: Planning model with the sensors of `add_sensing`.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._slices = {}
        for i in range(model.nsensor):
            start = int(model.sensor_adr[i])
            self._slices[model.sensor(i).name] = slice(start, start + int(model.sensor_dim[i]))

    def _read(self, sensordata: np.ndarray, name: str) -> np.ndarray:
        try:
            return sensordata[..., self._slices[name]]
        except KeyError:
            raise BadValue(
                f"the planning model has no sensor '{name}'. Make it with "
                "build_model(morphology, 'planning'), or call add_sensing on your own spec"
            ) from None

    def read_position(self, sensordata: np.ndarray, site: str) -> np.ndarray:
        """World position of a site [m]. Shape (..., 3)."""
        return self._read(sensordata, f"position:{site}")

    def read_pose(self, sensordata: np.ndarray, site: str) -> np.ndarray:
        """World pose of a tracked frame's site, x y z qw qx qy qz. Shape (..., 7)."""
        position = self.read_position(sensordata, site)
        return make_pose(position, self._read(sensordata, f"quat:{site}"))

    def read_velocity(self, sensordata: np.ndarray, site: str) -> np.ndarray:
        """World velocity of a contact point's site [m/s]. Shape (..., 3)."""
        return self._read(sensordata, f"velocity:{site}")
