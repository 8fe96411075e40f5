"""Proprioception and frame poses of a robot, as stored in datasets."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from xop_lerobot.core.state import RobotState
from xop_lerobot.core.transforms import quat_conjugate, quat_rotate, quat_to_rpy

if TYPE_CHECKING:
    from xop_lerobot.morphology.morphology import Morphology

BASE_KEYS = (
    "base.height.pos",
    "base.roll.pos",
    "base.pitch.pos",
    "base.x.vel",
    "base.y.vel",
    "base.z.vel",
    "base.roll.vel",
    "base.pitch.vel",
    "base.yaw.vel",
)
"""Height [m], roll and pitch [rad], then linear [m/s] and angular [rad/s] velocity, body axes."""


class Body:
    """Names, addresses and forward kinematics of a robot, from its planning model.

    Args:
        morphology: The robot.
    """

    def __init__(self, morphology: Morphology) -> None:
        self._sites = dict(morphology.frames)
        self._model = model = morphology.build_spec("planning").compile()
        self._data = mujoco.MjData(model)
        self._base = model.body(morphology.base_body).id
        root = model.body_jntadr[self._base]
        self._base_qpos, self._base_qvel = model.jnt_qposadr[root], model.jnt_dofadr[root]
        driven = model.actuator_trnid[model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT, 0]
        self._joints = list(dict.fromkeys(int(joint) for joint in driven))
        self._qpos = model.jnt_qposadr[self._joints]
        self._qvel = model.jnt_dofadr[self._joints]

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Actuated joints, in the order of the actuators."""
        return tuple(self._model.joint(joint).name for joint in self._joints)

    @cached_property
    def actuator_names(self) -> tuple[str, ...]:
        """Actuators, in the model's order. Shape (nu,)."""
        return tuple(self._model.actuator(i).name for i in range(self._model.nu))

    @cached_property
    def state_keys(self) -> tuple[str, ...]:
        """Keys of `observation.state`: joint positions, joint velocities, then the base."""
        positions = (f"{name}.pos" for name in self.joint_names)
        velocities = (f"{name}.vel" for name in self.joint_names)
        return (*positions, *velocities, *BASE_KEYS)

    def compute_proprioception(self, state: RobotState) -> dict[str, float]:
        """Return the measured value of every key of `state_keys` [m, rad, m/s, rad/s]."""
        start, speed = self._base_qpos, self._base_qvel
        quat = state.qpos[start + 3 : start + 7]
        roll, pitch, _ = quat_to_rpy(quat)
        linear = quat_rotate(quat_conjugate(quat), state.qvel[speed : speed + 3])
        values = np.concatenate(
            [
                state.qpos[self._qpos],
                state.qvel[self._qvel],
                [state.qpos[start + 2], roll, pitch],
                linear,
                state.qvel[speed + 3 : speed + 6],
            ]
        )
        return dict(zip(self.state_keys, values.tolist(), strict=True))

    def get_base(self, qpos: np.ndarray) -> np.ndarray:
        """Return the world pose of the base at `qpos`. Shape (7,)."""
        return qpos[self._base_qpos : self._base_qpos + 7].copy()

    def compute_poses(self, qpos: np.ndarray) -> Mapping[str, np.ndarray]:
        """Return the world pose of `base_pose` and of every tracked frame at `qpos`. Shapes (7,).

        Poses are x y z qw qx qy qz [m]; `qpos` has shape (nq,).
        """
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        poses = {"base_pose": self.get_base(qpos)}
        for frame, name in self._sites.items():
            site, quat = self._data.site(name), np.empty(4)
            mujoco.mju_mat2Quat(quat, site.xmat)
            poses[frame] = np.concatenate([site.xpos, quat])
        return poses
