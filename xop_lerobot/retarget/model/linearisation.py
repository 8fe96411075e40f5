"""Forward kinematics and Jacobians by MuJoCo, and the poses and positions that cost terms need.

`Linearisation` differentiates one configuration, `Placement` evaluates small batches, and
`Readings` reads the same quantities from the sensor data of rollouts.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import mujoco
import numpy as np

from xop_lerobot.core.errors import UnknownName
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.morphology.sensing import Sensing
from xop_lerobot.retarget.static_load import StaticLoad


def find_site(model: mujoco.MjModel, name: str) -> int:
    """Return the id of a site.

    Raises:
        UnknownName: Listing the model's sites.
    """
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name)
    if index < 0:
        raise UnknownName("site", name, [model.site(i).name for i in range(model.nsite)])
    return index


def find_sites_on(model: mujoco.MjModel, body: str, names: Iterable[str]) -> tuple[str, ...]:
    """Select the sites among `names` that are attached to a body."""
    wanted = model.body(body).id
    return tuple(n for n in names if model.site_bodyid[find_site(model, n)] == wanted)


class Linearisation:
    r"""Kinematics and Jacobians at one configuration at a time.

    A pass over the kinematic tree takes 4 µs, a Jacobian 1 µs; for batches see `SiteKinematics`.

    Args:
        model: The robot's model.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model, self._data = model, mujoco.MjData(model)

    def update(self, qpos: np.ndarray) -> None:
        """Update the kinematics to `qpos`. Shape (nq,)."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self._data)
        mujoco.mj_comPos(self.model, self._data)

    def compute_site(self, site: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        r"""Compute pose and Jacobians of a site.

        Returns:
            Position [m] (3,), orientation wxyz (4,), and the Jacobians of its linear and angular
            velocity in world axes by :math:`\dot q`. Shapes (3, nv), (3, nv).
        """
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, self._data.site_xmat[site])
        linear = np.empty((3, self.model.nv))
        angular = np.empty((3, self.model.nv))
        mujoco.mj_jacSite(self.model, self._data, linear, angular, site)
        return self._data.site_xpos[site], quat, linear, angular

    def compute_com(self, body: int) -> tuple[np.ndarray, np.ndarray]:
        """Centre of mass of a body's subtree [m] (3,), and its Jacobian (3, nv)."""
        jacobian = np.empty((3, self.model.nv))
        mujoco.mj_jacSubtreeCom(self.model, self._data, jacobian, body)
        return self._data.subtree_com[body], jacobian

    def compute_load(self, load: StaticLoad) -> tuple[np.ndarray, np.ndarray]:
        """Static loads beyond their allowed share (n,), and their Jacobian (n, nv)."""
        return load.linearise_excess(self._data)


class Placement:
    """Forward kinematics of sites and centre of mass for a small batch of configurations.

    One MuJoCo pass of 4 µs each: up to a few hundred configurations that is faster than one NumPy
    pass over the tree for all of them (`SiteKinematics`).

    Args:
        model: The robot's model.
        poses: Sites whose poses to compute.
        points: Sites whose positions to compute.
        com_of: Body whose subtree's centre of mass to compute; None for no centre of mass.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        poses: tuple[str, ...],
        points: tuple[str, ...] = (),
        com_of: str | None = None,
    ) -> None:
        self.model, self._data = model, mujoco.MjData(model)
        self._names, self._points = poses, points
        self._pose_ids = [find_site(model, site) for site in poses]
        self._ids = np.array([find_site(model, site) for site in (*poses, *points)], dtype=int)
        self._com = model.body(com_of).id if com_of else None
        # Keep views of MuJoCo's arrays: an attribute lookup takes as long as the copy itself.
        data = self._data
        self._qpos, self._site_xpos = data.qpos, data.site_xpos
        self._matrices = [data.site_xmat[site] for site in self._pose_ids]
        self._subtree_com = data.subtree_com[self._com or 0]

    def compute(
        self, qpos: np.ndarray
    ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], np.ndarray]:
        """Compute poses, positions and centre of mass. Shape (n, nq).

        Returns:
            Poses of the sites, shapes (n, 7); positions of the points, shapes (n, 3); centre of
            mass, shape (n, 3), or (0, 3) if none was requested.
        """
        model, data = self.model, self._data
        positions = np.empty((len(qpos), len(self._ids), 3))
        quats = np.empty((len(qpos), len(self._pose_ids), 4))
        com = np.empty((len(qpos) if self._com is not None else 0, 3))
        for i, configuration in enumerate(qpos):
            self._qpos[:] = configuration
            mujoco.mj_kinematics(model, data)
            self._site_xpos.take(self._ids, axis=0, out=positions[i], mode="clip")
            for quat, matrix in zip(quats[i], self._matrices, strict=True):
                mujoco.mju_mat2Quat(quat, matrix)
            if self._com is not None:
                mujoco.mj_comPos(model, data)
                com[i] = self._subtree_com
        count = len(self._pose_ids)
        poses = np.concatenate([positions[:, :count], quats], axis=2)
        return (
            {name: poses[:, i] for i, name in enumerate(self._names)},
            {name: positions[:, count + i] for i, name in enumerate(self._points)},
            com,
        )


class Parts(NamedTuple):
    """Poses and positions in a batch of states, with its leading dimensions.

    Attributes:
        poses: Pose of each tracked frame. Shapes (..., 7).
        points: Position of contact and hull sites [m]. Shapes (..., 3).
        velocities: Velocity of contact sites [m/s]; only in rollouts. Shapes (..., 3).
        com: Centre of mass [m]; empty in rollouts and for a robot without a support area.
            Shape (..., 3).
    """

    poses: Mapping[str, np.ndarray]
    points: Mapping[str, np.ndarray]
    velocities: Mapping[str, np.ndarray]
    com: np.ndarray


class Readings:
    """Poses and positions from the sensor data of rollouts, or from configurations.

    Args:
        morphology: The robot.
        model: Its planning model.
        hull: Hull sites for obstacle avoidance, with their radii [m].
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
        """Poses, hull points and centre of mass in configurations, (n, nq)."""
        poses, points, com = self._get_placement(tuple(frames.values())).compute(qpos)
        return Parts({name: poses[site] for name, site in frames.items()}, points, {}, com)

    def read(self, sensordata: np.ndarray, frames: Mapping[str, str]) -> Parts:
        """Poses and points in rollouts, from `Prediction.sensordata`, (K, H + 1, n)."""
        sensing = self._sensing
        return Parts(
            {name: sensing.read_pose(sensordata, site) for name, site in frames.items()},
            {
                site: sensing.read_position(sensordata, site)
                for site in (*self._contacts, *self._hull)
            },
            {site: sensing.read_velocity(sensordata, site) for site in self._contacts},
            np.zeros(0),
        )
