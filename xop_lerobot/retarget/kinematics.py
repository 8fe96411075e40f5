"""Forward kinematics of a few sites for a whole batch of configurations at once."""

from __future__ import annotations

import mujoco
import numpy as np

from xop_lerobot.errors import BadValue, UnknownName
from xop_lerobot.transforms import make_pose, quat_from_matrix

_HINGE, _SLIDE, _FREE = (
    int(kind)
    for kind in (
        mujoco.mjtJoint.mjJNT_HINGE,
        mujoco.mjtJoint.mjJNT_SLIDE,
        mujoco.mjtJoint.mjJNT_FREE,
    )
)


class SiteKinematics:
    r"""Pose of sites as a function of :math:`q`, broadcast over any leading dimensions.

    A rollout of 30 × 5 states needs 150 head poses; one NumPy pass over the bodies on the way
    to the sites gives them all, where a loop over `mj_kinematics` would cost as much as the
    physics. The local transforms of all joints are computed together,
    :math:`R = R_0 (I + \sin q\,K + (1 - \cos q) K^2)`, and then chained
    body by body. Here q counts from the joint's reference angle, as in MuJoCo.

    Args:
        model: Model whose bodies carry at most one free, hinge or slide joint each.
        sites: Names of the sites.
        com_of: Body whose whole subtree `compute_com` is about, None if it is not needed.

    Raises:
        UnknownName: If a site is not in the model; carries its sites.
        BadValue: If a body on the way has a ball joint, or two joints.
    """

    def __init__(
        self, model: mujoco.MjModel, sites: tuple[str, ...], com_of: str | None = None
    ) -> None:
        known = [model.site(i).name for i in range(model.nsite)]
        self.site_frames: dict[str, tuple[int, np.ndarray]] = {}
        chains: dict[str, list[int]] = {}
        for name in sites:
            if name not in known:
                raise UnknownName("site", name, known)
            site = model.site(name)
            body = int(site.bodyid[0])
            self.site_frames[name] = (body, _make_transform(site.pos, site.quat))
            chains[name] = _find_chain(model, body)
        self._chains = chains
        self.masses = _find_masses(model, com_of) if com_of else {}
        ways = [*chains.values()]
        if com_of:
            ways.append(_find_chain(model, int(model.body(com_of).id)))
        bodies = sorted({*(body for way in ways for body in way), *self.masses})
        self._bodies = bodies
        for body in bodies:
            _check_body(model, body)
        self._parent = {body: int(model.body_parentid[body]) for body in bodies}
        self._fixed = {
            body: _make_transform(model.body_pos[body], model.body_quat[body]) for body in bodies
        }
        self._free = {
            body: int(model.jnt_qposadr[model.body_jntadr[body]])
            for body in bodies
            if model.body_jntnum[body] and model.jnt_type[model.body_jntadr[body]] == _FREE
        }
        self._moving = [
            body for body in bodies if model.body_jntnum[body] and body not in self._free
        ]
        self._row = {body: row for row, body in enumerate(self._moving)}
        joints = [int(model.body_jntadr[body]) for body in self._moving]
        self._address = model.jnt_qposadr[joints]
        self._reference = model.qpos0[self._address]
        self._slides = model.jnt_type[joints] == _SLIDE
        axes = model.jnt_axis[joints]
        self._axes = np.where(self._slides[:, None], axes, 0)
        self._skew = np.array([_make_skew(axis) for axis in axes]).reshape(-1, 3, 3)
        self._skew[self._slides] = 0
        self._square = self._skew @ self._skew
        fixed = [self._fixed[body] for body in self._moving]
        self._fixed_moving = np.array(fixed).reshape(-1, 4, 4)  # (J, 4, 4)

    def compute_bodies(
        self, qpos: np.ndarray, sites: tuple[str, ...] = (), *, com: bool = False
    ) -> Bodies:
        """Place the bodies once, to ask for several things.

        Args:
            qpos: Configurations. Shape (..., nq).
            sites: Sites that will be asked for; all by default.
            com: Whether the centre of mass will be asked for.
        """
        needed = {body for site in sites or self.site_frames for body in self._chains[site]}
        bodies = self._bodies if com else sorted(needed)
        world = self._compute_world(qpos.reshape(-1, qpos.shape[-1]), bodies)
        return Bodies(self, qpos.shape[:-1], world)

    def compute_com(self, qpos: np.ndarray) -> np.ndarray:
        """Centre of mass of the subtree `com_of` in the world [m]. (..., nq) -> (..., 3)."""
        return self.compute_bodies(qpos, com=True).compute_com()

    def compute_positions(
        self, qpos: np.ndarray, sites: tuple[str, ...] = ()
    ) -> dict[str, np.ndarray]:
        """World positions of `sites` [m]. Shape (..., nq) -> (..., 3) each."""
        return self.compute_bodies(qpos, sites).compute_positions(sites or tuple(self.site_frames))

    def compute_poses(self, qpos: np.ndarray, sites: tuple[str, ...] = ()) -> dict[str, np.ndarray]:
        """World poses x y z qw qx qy qz of `sites`. Shape (..., nq) -> (..., 7) each."""
        return self.compute_bodies(qpos, sites).compute_poses(sites or tuple(self.site_frames))

    def _compute_world(self, flat: np.ndarray, needed: list[int]) -> dict[int, np.ndarray]:
        """World transform of each body of `needed`, which holds its ancestors. (n, 4, 4)."""
        local = self._compute_local(flat, [body for body in needed if body in self._row])
        still = np.broadcast_to(np.eye(4), (len(flat), 4, 4))
        world: dict[int, np.ndarray] = {0: still}  # sites may be on the world itself
        for body in needed:
            if body in self._free:
                world[body] = _make_transforms(flat[:, self._free[body] :][:, :7])
                continue
            own = local[body] if body in local else self._fixed[body]
            parent = self._parent[body]
            world[body] = world[parent] @ own if parent else still @ own
        return world

    def _compute_local(self, qpos: np.ndarray, bodies: list[int]) -> dict[int, np.ndarray]:
        """Transform of each body to its parent, all joints at once. Shapes (n, 4, 4)."""
        if not bodies:
            return {}
        rows = [self._row[body] for body in bodies]
        angles = (qpos[:, self._address[rows]] - self._reference[rows]).T  # (J, n)
        joint = np.zeros((len(rows), len(qpos), 4, 4))
        sine, cosine = np.sin(angles)[..., None, None], np.cos(angles)[..., None, None]
        joint[..., :3, :3] = (
            np.eye(3) + sine * self._skew[rows, None] + (1 - cosine) * self._square[rows, None]
        )
        joint[..., :3, 3] = angles[..., None] * self._axes[rows, None]
        joint[..., 3, 3] = 1
        local = self._fixed_moving[rows, None] @ joint
        return dict(zip(bodies, local, strict=True))


class Bodies:
    """The bodies of a batch of configurations, placed in the world.

    Args:
        kinematics: What placed them.
        shape: Leading dimensions of the batch.
        world: Transform of each body. Shapes (n, 4, 4).
    """

    def __init__(
        self, kinematics: SiteKinematics, shape: tuple[int, ...], world: dict[int, np.ndarray]
    ) -> None:
        self._kinematics, self._shape, self._world = kinematics, shape, world

    def _compute_transform(self, site: str) -> np.ndarray:
        body, own = self._kinematics.site_frames[site]
        return (self._world[body] @ own).reshape(*self._shape, 4, 4)

    def compute_positions(self, sites: tuple[str, ...]) -> dict[str, np.ndarray]:
        """World positions of `sites` [m]. Shapes (..., 3)."""
        positions = {}
        for site in sites:
            body, own = self._kinematics.site_frames[site]
            positions[site] = (self._world[body] @ own[:, 3])[:, :3].reshape(*self._shape, 3)
        return positions

    def compute_poses(self, sites: tuple[str, ...]) -> dict[str, np.ndarray]:
        """World poses x y z qw qx qy qz of `sites`. Shapes (..., 7)."""
        transforms = {site: self._compute_transform(site) for site in sites}
        return {
            site: make_pose(transform[..., :3, 3], quat_from_matrix(transform[..., :3, :3]))
            for site, transform in transforms.items()
        }

    def compute_com(self) -> np.ndarray:
        """Centre of mass of the subtree `com_of` in the world [m]. Shape (..., 3)."""
        masses = self._kinematics.masses
        total = sum(mass for mass, _ in masses.values())
        moments = np.array([[*(mass * centre), mass] for mass, centre in masses.values()]) / total
        stacked = np.stack([self._world[body] for body in masses])  # (bodies, n, 4, 4)
        com = np.einsum("bnij,bj->ni", stacked[..., :3, :], moments)
        return com.reshape(*self._shape, 3)


def _find_chain(model: mujoco.MjModel, body: int) -> list[int]:
    """Bodies from the world (excluded) to `body`."""
    chain = []
    while body:
        chain.append(body)
        body = int(model.body_parentid[body])
    return chain[::-1]


def _find_masses(model: mujoco.MjModel, root: str) -> dict[int, tuple[float, np.ndarray]]:
    """Mass and centre of mass of every body in the subtree of `root`."""
    first = int(model.body(root).id)
    return {
        body: (float(model.body_mass[body]), model.body_ipos[body].copy())
        for body in range(first, model.nbody)
        if first in _find_chain(model, body)
    }


def _check_body(model: mujoco.MjModel, body: int) -> None:
    name, count = model.body(body).name, int(model.body_jntnum[body])
    if count > 1:
        raise BadValue(f"body '{name}' has {count} joints, expected at most 1")
    if count:
        joint = int(model.body_jntadr[body])
        if model.jnt_type[joint] not in (_HINGE, _SLIDE, _FREE):
            raise BadValue(f"joint '{model.joint(joint).name}' must be free, hinge or slide")
        if model.jnt_pos[joint].any():
            raise BadValue(f"joint '{model.joint(joint).name}' must sit at its body's origin")


def _make_skew(axis: np.ndarray) -> np.ndarray:
    x, y, z = axis
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=float)


def _make_transform(pos: np.ndarray, quat: np.ndarray) -> np.ndarray:
    return _make_transforms(np.concatenate([pos, quat])[None])[0]


def _make_transforms(poses: np.ndarray) -> np.ndarray:
    """Homogeneous transforms of poses. Shape (n, 7) -> (n, 4, 4)."""
    w, x, y, z = poses[:, 3:].T
    transforms = np.zeros((len(poses), 4, 4))
    transforms[:, 0, 0], transforms[:, 0, 1] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z)
    transforms[:, 0, 2], transforms[:, 1, 0] = 2 * (x * z + w * y), 2 * (x * y + w * z)
    transforms[:, 1, 1], transforms[:, 1, 2] = 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    transforms[:, 2, 0], transforms[:, 2, 1] = 2 * (x * z - w * y), 2 * (y * z + w * x)
    transforms[:, 2, 2] = 1 - 2 * (x * x + y * y)
    transforms[:, :3, 3] = poses[:, :3]
    transforms[:, 3, 3] = 1
    return transforms
