"""Where a robot meets the ground: its feet or wheels, and how deep its weight presses them in."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.morphology.morphology import Morphology

_CONTACT_ROWS = (
    int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS),
    int(mujoco.mjtConstraint.mjCNSTR_CONTACT_PYRAMIDAL),
    int(mujoco.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC),
)


@dataclass(frozen=True)
class Contact:
    """A foot or a wheel.

    Attributes:
        name: Site of its first point.
        body: Body that it is.
        point: Mean of its points in the body's frame, of a wheel its centre [m]. Shape (3,).
        axis: Direction in the body's frame: of a foot, up; of a wheel, its axle. Shape (3,).
        forward: Direction in the body's frame that a foot faces. Shape (3,).
        height: Height of `point` over z = 0 when it bears its share of the weight [m].
        radius: Distance from `point` down to the ground, 0 for a foot [m].
        rolls: Whether the body turns about `axis` against the one it is mounted on.
    """

    name: str
    body: int
    point: np.ndarray
    axis: np.ndarray
    forward: np.ndarray
    height: float
    radius: float
    rolls: bool


def make_contacts(
    morphology: Morphology, model: mujoco.MjModel, *, equilibrium: bool = True
) -> tuple[Contact, ...]:
    """Describe each of the robot's `contact_groups`.

    Args:
        morphology: The robot.
        model: Its planning model, with the floor.
        equilibrium: Whether heights are those under the robot's weight, else of touching.

    Raises:
        UnknownName: If a contact point is no site of the model.
        BadValue: If the points of a group are on different bodies.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = compute_equilibrium(model, morphology.standing_qpos())
    mujoco.mj_kinematics(model, data)
    sink = 0.0 if equilibrium else _compute_depth(model, data)
    sites = [model.site(i).name for i in range(model.nsite)]
    contacts = []
    for group in morphology.contact_groups:
        for site in group:
            if site not in sites:
                raise UnknownName("site", site, sites)
        bodies = {int(model.site(site).bodyid[0]) for site in group}
        if len(bodies) > 1:
            raise BadValue(
                f"contact points {list(group)} must be on one body, they are on "
                f"{sorted(model.body(body).name for body in bodies)}"
            )
        body = bodies.pop()
        point = np.mean([model.site(site).pos for site in group], axis=0)
        rotation = data.xmat[body].reshape(3, 3)
        height = float((data.xpos[body] + rotation @ point)[2]) + sink
        joint = int(model.body_jntadr[body])
        rolls = bool(
            morphology.wheeled
            and model.body_jntnum[body]
            and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
        )
        axis = rotation.T[:, 1] if morphology.wheeled else rotation.T[:, 2]
        contacts.append(
            Contact(
                name=group[0],
                body=body,
                point=point,
                axis=(model.jnt_axis[joint] if rolls else axis).copy(),
                forward=rotation.T[:, 0].copy(),
                height=height,
                radius=height if morphology.wheeled else 0.0,
                rolls=rolls,
            )
        )
    return tuple(contacts)


def compute_height(contact: Contact, data: mujoco.MjData) -> float:
    """Height of a contact over its equilibrium, kinematics up to date [m]."""
    body = contact.body
    return float(data.xpos[body, 2] + data.xmat[body, 6:9] @ contact.point - contact.height)


def compute_equilibrium(
    model: mujoco.MjModel, qpos: np.ndarray, iterations: int = 50
) -> np.ndarray:
    r"""Let a robot sink into the ground until that bears its weight, in its posture.

    A soft contact at rest presses with :math:`f_i = D_i a^{ref}_i` (MuJoCo's constraint at zero
    acceleration). Newton's method finds the height, roll and pitch of the base at which
    :math:`(J^\top f)_{z,\phi,\theta}` balances gravity; a posture that has no such pose (the mass
    is beside the feet) or a model without ground is returned as it is.

    Args:
        model: Model with the ground, on a free base.
        qpos: Posture near the ground. Shape (nq,).
        iterations: Most steps.

    Returns:
        The posture in equilibrium. Shape (nq,).
    """
    data = mujoco.MjData(model)
    weight = float(model.body_subtreemass[0]) * float(np.linalg.norm(model.opt.gravity))

    def compute_excess(step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        q = qpos.copy()
        velocity = np.zeros(model.nv)
        velocity[2:5] = step
        mujoco.mj_integratePos(model, q, velocity, 1.0)
        data.qpos[:], data.qvel[:] = q, 0
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        rows = np.isin(data.efc_type[: data.nefc], _CONTACT_ROWS)
        force = np.where(rows, np.maximum(data.efc_D * data.efc_aref, 0), 0.0)
        wrench = np.zeros(model.nv)
        mujoco.mj_mulJacTVec(model, data, wrench, force)
        return (wrench - data.qfrc_bias)[2:5], q

    has_base = model.njnt > 0 and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    if not has_base or weight == 0:
        return qpos.copy()
    step = np.array([-_find_gap(model, qpos) - 1e-4, 0.0, 0.0])
    for _ in range(iterations):
        excess, q = compute_excess(step)
        if np.abs(excess).max() < 1e-6 * weight:
            return q
        small = 1e-7
        slope = np.array(
            [(compute_excess(step + d)[0] - excess) / small for d in np.eye(3) * small]
        )
        try:
            change = np.linalg.solve(slope.T, -excess)
        except np.linalg.LinAlgError:
            break  # nothing touches the ground
        if not np.isfinite(change).all():
            break
        step = step + change * min(1.0, 5e-4 / max(np.abs(change).max(), 1e-12))
    return qpos.copy()


def _find_gap(model: mujoco.MjModel, qpos: np.ndarray) -> float:
    """How far a robot must be lowered to touch the ground, at most 2 cm, to 0.1 mm [m]."""
    data = mujoco.MjData(model)
    for gap in np.arange(0, 0.02, 1e-4):
        data.qpos[:] = qpos
        data.qpos[2] -= gap
        mujoco.mj_fwdPosition(model, data)
        if data.ncon:
            return float(gap)
    return 0.0


def _compute_depth(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Mean depth to which the contacts of this pose have sunk [m]."""
    mujoco.mj_fwdPosition(model, data)
    depths = [-contact.dist for contact in data.contact[: data.ncon]]
    return float(np.mean(depths)) if depths else 0.0
