"""Forward kinematics of a few sites for a whole batch of configurations at once."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from xop_lerobot.errors import BadValue, UnknownName
from xop_lerobot.transforms import make_pose, quat_multiply, quat_rotate


@dataclass(frozen=True)
class _Link:
    """One body on the way from the world to a site, and the joint that moves it."""

    pos: np.ndarray
    quat: np.ndarray
    joint: int  # mujoco.mjtJoint of its joint, -1 for none
    address: int  # of the joint in qpos
    axis: np.ndarray
    anchor: np.ndarray


class SiteKinematics:
    r"""Pose of sites as a function of :math:`q`, broadcast over any leading dimensions.

    A rollout of 30 × 5 states needs 150 head poses; one NumPy pass over the chain of a site
    gives them all, where a loop over `mj_kinematics` would cost more than a physics step each.

    Args:
        model: Model whose bodies carry at most one free, hinge or slide joint each.
        sites: Names of the sites.

    Raises:
        UnknownName: If a site is not in the model; carries its sites.
        BadValue: If a chain has a joint of another kind, or two joints on one body.
    """

    def __init__(self, model: mujoco.MjModel, sites: tuple[str, ...]) -> None:
        known = [model.site(i).name for i in range(model.nsite)]
        self._ends: dict[str, tuple[list[_Link], np.ndarray, np.ndarray]] = {}
        links: dict[int, _Link] = {}
        for name in sites:
            if name not in known:
                raise UnknownName("site", name, known)
            site = model.site(name)
            chain = _make_chain(model, int(site.bodyid[0]), links)
            self._ends[name] = (chain, site.pos.copy(), site.quat.copy())

    def compute_poses(self, qpos: np.ndarray, sites: tuple[str, ...] = ()) -> dict[str, np.ndarray]:
        """World poses x y z qw qx qy qz of `sites`, of all by default. (..., nq) -> (..., 7)."""
        bodies: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        poses = {}
        for name in sites or self._ends:
            chain, site_pos, site_quat = self._ends[name]
            pos = np.zeros((*qpos.shape[:-1], 3))
            quat = np.broadcast_to(np.array([1.0, 0, 0, 0]), (*qpos.shape[:-1], 4))
            for link in chain:
                key = id(link)
                if key not in bodies:
                    bodies[key] = _move(link, qpos, pos, quat)
                pos, quat = bodies[key]
            poses[name] = make_pose(
                pos + quat_rotate(quat, site_pos), quat_multiply(quat, site_quat)
            )
        return poses


def _make_chain(model: mujoco.MjModel, body: int, links: dict[int, _Link]) -> list[_Link]:
    """Links from the world to `body`; `links` lets chains share, and so compute, each once."""
    chain: list[_Link] = []
    while body:
        chain.append(links.setdefault(body, _make_link(model, body)))
        body = int(model.body_parentid[body])
    return chain[::-1]


def _make_link(model: mujoco.MjModel, body: int) -> _Link:
    count = int(model.body_jntnum[body])
    if count > 1:
        raise BadValue(f"body '{model.body(body).name}' has {count} joints, expected at most 1")
    joint = int(model.body_jntadr[body]) if count else -1
    kind = int(model.jnt_type[joint]) if count else -1
    if kind == mujoco.mjtJoint.mjJNT_BALL:
        raise BadValue(f"joint '{model.joint(joint).name}' is a ball joint, which is not supported")
    return _Link(
        pos=model.body_pos[body].copy(),
        quat=model.body_quat[body].copy(),
        joint=kind,
        address=int(model.jnt_qposadr[joint]) if count else -1,
        axis=model.jnt_axis[joint].copy() if count else np.zeros(3),
        anchor=model.jnt_pos[joint].copy() if count else np.zeros(3),
    )


def _move(
    link: _Link, qpos: np.ndarray, pos: np.ndarray, quat: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Pose of a body from that of its parent and the value of its joint."""
    if link.joint == mujoco.mjtJoint.mjJNT_FREE:
        address = link.address
        return qpos[..., address : address + 3], qpos[..., address + 3 : address + 7]
    pos = pos + quat_rotate(quat, link.pos)
    quat = quat_multiply(quat, link.quat)
    if link.joint == mujoco.mjtJoint.mjJNT_SLIDE:
        return pos + quat_rotate(quat, link.axis) * qpos[..., link.address, None], quat
    if link.joint == mujoco.mjtJoint.mjJNT_HINGE:
        half = qpos[..., link.address, None] / 2
        turned = quat_multiply(quat, np.concatenate([np.cos(half), np.sin(half) * link.axis], -1))
        if link.anchor.any():
            pos = pos + quat_rotate(quat, link.anchor) - quat_rotate(turned, link.anchor)
        quat = turned
    return pos, quat
