"""Movable objects of a scene, by name."""

from __future__ import annotations

import mujoco
import numpy as np

from xop_lerobot.core.errors import UnknownName


class SceneObjects:
    """Bodies on free joints that are not the robot's.

    Args:
        model: Model with the robot in its scene.
        robot_bodies: Ids of the robot's bodies.
    """

    def __init__(self, model: mujoco.MjModel, robot_bodies: np.ndarray) -> None:
        self._addresses: dict[str, tuple[int, int]] = {}
        for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
            body = int(model.jnt_bodyid[joint])
            if body not in robot_bodies:
                self._addresses[model.body(body).name] = (
                    int(model.jnt_qposadr[joint]),
                    int(model.jnt_dofadr[joint]),
                )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the objects' bodies."""
        return tuple(sorted(self._addresses))

    def get_pose(self, data: mujoco.MjData, name: str) -> np.ndarray:
        """Pose of `name`, x y z qw qx qy qz. Shape (7,).

        Raises:
            UnknownName: Listing the objects.
        """
        address = self._look_up(name)[0]
        return data.qpos[address : address + 7].copy()

    def set_pose(self, data: mujoco.MjData, name: str, pose: np.ndarray) -> None:
        """Place `name` at rest at `pose`, x y z qw qx qy qz. Shape (7,).

        Raises:
            UnknownName: Listing the objects.
        """
        address, dof = self._look_up(name)
        data.qpos[address : address + 3] = pose[:3]
        data.qpos[address + 3 : address + 7] = pose[3:] / np.linalg.norm(pose[3:])
        data.qvel[dof : dof + 6] = 0

    def _look_up(self, name: str) -> tuple[int, int]:
        if name not in self._addresses:
            raise UnknownName("object", name, self._addresses)
        return self._addresses[name]
