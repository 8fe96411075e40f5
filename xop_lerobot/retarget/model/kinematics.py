"""Batched forward kinematics of sites in NumPy, for long trajectories."""

from __future__ import annotations

import mujoco
import numpy as np

from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.transforms import make_pose, quat_from_matrix
from xop_lerobot.retarget.model.linearisation import find_site

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

    For a large batch, one NumPy pass over the bodies between the root and the sites is faster than
    a loop over `mj_kinematics`; below a few hundred configurations use `Placement`. The local
    transforms of all joints are computed together by Rodrigues' formula,
    :math:`R = R_0 (I + \sin q\,K + (1 - \cos q) K^2)`, and then chained body by body. Here q
    counts from the joint's reference angle, as in MuJoCo.

    Args:
        model: Model whose bodies carry at most one free, hinge or slide joint each.
        sites: Names of the sites.

    Raises:
        UnknownName: If a site is not in the model; lists its sites.
        BadValue: If a body in the chain has a ball joint, two joints, or a joint off its origin.
    """

    def __init__(self, model: mujoco.MjModel, sites: tuple[str, ...]) -> None:
        self._sites: dict[str, tuple[int, np.ndarray]] = {}
        chains: set[int] = set()
        for name in sites:
            site = model.site(find_site(model, name))
            body = int(site.bodyid[0])
            self._sites[name] = (body, _make_transform(site.pos, site.quat))
            chains.update(_find_chain(model, body))
        self._bodies = bodies = sorted(chains)
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

    def compute_poses(self, qpos: np.ndarray) -> dict[str, np.ndarray]:
        """World poses x y z qw qx qy qz of the sites. Shape (..., nq) -> (..., 7) each."""
        world = self._compute_world(qpos.reshape(-1, qpos.shape[-1]))
        poses = {}
        for site, (body, own) in self._sites.items():
            transform = world[body] @ own
            pose = make_pose(transform[:, :3, 3], quat_from_matrix(transform[:, :3, :3]))
            poses[site] = pose.reshape(*qpos.shape[:-1], 7)
        return poses

    def _compute_world(self, flat: np.ndarray) -> dict[int, np.ndarray]:
        """World transform of each body in the chains. Shapes (n, 4, 4)."""
        local = self._compute_local(flat)
        still = np.broadcast_to(np.eye(4), (len(flat), 4, 4))
        world: dict[int, np.ndarray] = {0: still}  # sites may be on the world itself
        for body in self._bodies:
            if body in self._free:
                world[body] = _make_transforms(flat[:, self._free[body] :][:, :7])
                continue
            own = local[body] if body in local else self._fixed[body]
            parent = self._parent[body]
            world[body] = world[parent] @ own if parent else still @ own
        return world

    def _compute_local(self, qpos: np.ndarray) -> dict[int, np.ndarray]:
        """Transform of each body to its parent, all joints at once. Shapes (n, 4, 4)."""
        angles = (qpos[:, self._address] - self._reference).T  # (J, n)
        joint = np.zeros((*angles.shape, 4, 4))
        sine, cosine = np.sin(angles)[..., None, None], np.cos(angles)[..., None, None]
        joint[..., :3, :3] = (
            np.eye(3) + sine * self._skew[:, None] + (1 - cosine) * self._square[:, None]
        )
        joint[..., :3, 3] = angles[..., None] * self._axes[:, None]
        joint[..., 3, 3] = 1
        local = self._fixed_moving[:, None] @ joint
        return dict(zip(self._moving, local, strict=True))


def _find_chain(model: mujoco.MjModel, body: int) -> list[int]:
    """Bodies from the world (exclusive) to `body`."""
    chain = []
    while body:
        chain.append(body)
        body = int(model.body_parentid[body])
    return chain[::-1]


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
