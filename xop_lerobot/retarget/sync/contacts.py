"""Ground contacts of feet or wheels: equilibrium depth, active set, and memory of stance feet."""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.morphology.contacts import Contact, ContactKind
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.retarget.sync.config import SyncConfig

_CONTACT_ROWS = (
    int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS),
    int(mujoco.mjtConstraint.mjCNSTR_CONTACT_PYRAMIDAL),
    int(mujoco.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC),
)


def make_contacts(
    morphology: Morphology, model: mujoco.MjModel, *, equilibrium: bool = True
) -> tuple[Contact, ...]:
    """Describe each of the robot's `contact_groups`.

    Args:
        morphology: The robot.
        model: Its planning model, with the floor.
        equilibrium: Whether heights are those under the robot's weight; otherwise those at first
            touch.

    Raises:
        UnknownName: If a contact point is not a site of the model.
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
        turns = model.body_jntnum[body] and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
        hinge = model.jnt_axis[joint] if turns else None
        contacts.append(
            morphology.contact_kind.make_contact(group[0], body, point, rotation, height, hinge)
        )
    return tuple(contacts)


def compute_height(contact: Contact, data: mujoco.MjData) -> float:
    """Height of a contact over its equilibrium [m]; needs up-to-date kinematics."""
    body = contact.body
    return float(data.xpos[body, 2] + data.xmat[body, 6:9] @ contact.point - contact.height)


def compute_equilibrium(
    model: mujoco.MjModel, qpos: np.ndarray, iterations: int = 50
) -> np.ndarray:
    r"""Find the static equilibrium of a posture on MuJoCo's soft ground.

    A soft contact at rest exerts :math:`f_i = D_i a^{ref}_i` (MuJoCo's constraint at zero
    acceleration). Newton's method finds the height, roll and pitch of the base at which
    :math:`(J^\top f)_{z,\phi,\theta}` balances gravity. Without a solution (the centre of mass is
    outside the feet, or there is no ground) the posture is returned unchanged.

    Args:
        model: Model with the ground and a free base.
        qpos: Posture near the ground. Shape (nq,).
        iterations: Largest number of steps.

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
        small = 1e-7  # finite-difference step [m, rad]
        slope = np.array(
            [(compute_excess(step + d)[0] - excess) / small for d in np.eye(3) * small]
        )
        try:
            change = np.linalg.solve(slope.T, -excess)
        except np.linalg.LinAlgError:
            break  # nothing touches the ground
        if not np.isfinite(change).all():
            break
        # At most 0.5 mm or mrad per step: contact forces are not smooth where contacts begin.
        step = step + change * min(1.0, 5e-4 / max(np.abs(change).max(), 1e-12))
    return qpos.copy()


def _find_gap(model: mujoco.MjModel, qpos: np.ndarray) -> float:
    """Height of a robot over the ground, up to 2 cm, with a resolution of 0.1 mm [m]."""
    data = mujoco.MjData(model)
    for gap in np.arange(0, 0.02, 1e-4):
        data.qpos[:] = qpos
        data.qpos[2] -= gap
        mujoco.mj_fwdPosition(model, data)
        if data.ncon:
            return float(gap)
    return 0.0


def _compute_depth(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Mean penetration depth of the contacts [m]."""
    mujoco.mj_fwdPosition(model, data)
    depths = [-contact.dist for contact in data.contact[: data.ncon]]
    return float(np.mean(depths)) if depths else 0.0


_RECENT = 0.2  # share of the newest tick in the recent mean of a foot's measured position


class StanceMemory:
    r"""Active set C of Eq. 4, and memory of the stance locations :math:`p^{world}_{c,i}`.

    C holds all wheels; in stationary mode both feet, in mobile mode the lower foot. Lifted feet,
    and contacts that are tilted or far from the ground (the robot fell or was lifted), are not in
    it.

    The remembered position of a foot is the mean of its filtered measurements since touch-down,
    with a limited memory:

    .. math::

        \hat p \leftarrow \hat p + \frac{\Delta t}{\min(T, T_{mem})} (p_c(\tilde x) - \hat p),
        \qquad \sigma^2 = \sigma_{best}^2 + \sigma_p^2\,\frac{\Delta t}{T}

    with T the time since it stands. A foot that slips or lifts restarts; slow creep is followed
    within the memory time. A foot that has just touched down is not yet at rest: `get_landing`
    decays from 1 with `touchdown_s` and loosens its residuals.

    Args:
        contacts: The robot's feet or wheels.
        kind: Kind of the contacts; only feet have a touch-down.
        config: Times and tolerances.
    """

    def __init__(self, contacts: Sequence[Contact], kind: ContactKind, config: SyncConfig) -> None:
        self.contacts, self.kind, self.config = tuple(contacts), kind, config
        self.places = np.zeros((len(self.contacts), 3))
        """x, y [m] and heading [rad] of every foot in the world. Shape (contacts, 3)."""
        self.active: tuple[int, ...] = ()
        """Indices of the active contacts."""
        self.reset()

    def reset(self) -> None:
        """Forget all stance locations; contacts that are active next count as long at rest."""
        self.active = ()
        self._stood = [0.0] * len(self.contacts)  # time covered by the mean [s]
        self._landed = [math.inf] * len(self.contacts)  # time since touch-down [s]
        self._departure = np.zeros((len(self.contacts), 3))  # recent mean less remembered place
        self._spread = [(math.inf, math.inf)] * len(self.contacts)
        self._is_new = True

    def release(self, index: int) -> None:
        """Forget the location of a contact that moves."""
        self._stood[index], self._landed[index] = 0.0, 0.0

    def get_landing(self, index: int) -> float:
        """Remaining effect of a contact's touch-down, decaying from 1 to 0."""
        if not self.kind.steps:
            return 0.0
        return math.exp(-self._landed[index] / self.config.touchdown_s)

    def update_contacts(self, data: mujoco.MjData, mode: Mode, dt: float) -> None:
        """Update the active set.

        Args:
            data: Pose of the robot, with up-to-date kinematics.
            mode: Mode of the robot.
            dt: Time since the last update [s].
        """
        heights = [compute_height(contact, data) for contact in self.contacts]
        lowest = min(range(len(heights)), key=heights.__getitem__)
        active = []
        for index, contact in enumerate(self.contacts):
            raised = heights[index] - heights[lowest] > self.config.lift_height
            if self.kind.steps:
                raised |= mode is Mode.MOBILE and index != lowest
            if raised or not self._is_near_ground(contact, heights[index], data):
                self.release(index)
                continue
            active.append(index)
            if not self._is_new and index not in self.active:
                self.release(index)
            else:
                self._landed[index] += dt
        self.active, self._is_new = tuple(active), False

    def _is_near_ground(self, contact: Contact, height: float, data: mujoco.MjData) -> bool:
        upright = float(data.xmat[contact.body, 6:9] @ contact.axis)  # cosine to the vertical
        tilt = self.kind.compute_tilt(upright)
        return abs(height) < self.config.lost_height and tilt < self.config.lost_tilt

    def remember(
        self,
        places: np.ndarray,
        dt: float,
        noise: tuple[float, float],
        std: tuple[float, float],
        memory_s: float,
    ) -> None:
        """Update the mean locations of the active contacts by the filtered measurement.

        Args:
            places: x, y [m] and heading [rad] of every contact. Shape (contacts, 3).
            dt: Time since the last update [s].
            noise: Standard deviations of the measured position [m] and heading [rad] of the base.
            std: Standard deviations of the filtered position [m] and heading [rad].
            memory_s: Longest averaging time [s].
        """
        for index in self.active:
            stood = self._stood[index]
            if stood == 0:
                self.places[index], self._departure[index] = places[index], 0
            self._stood[index] = stood = min(stood + dt, memory_s)
            share = dt / stood if stood else 1.0
            change = places[index] - self.places[index]
            change[2] = math.remainder(change[2], 2 * math.pi)
            self._departure[index] += _RECENT * (change - self._departure[index])
            if stood > dt and self._has_left(index, std):
                self._stood[index] = stood = dt
                self._departure[index] = 0
                share = 1.0
            self.places[index] += share * change
            small, config = math.sqrt(share), self.config
            self._spread[index] = (
                math.hypot(config.stance_position, small * noise[0]),
                math.hypot(config.stance_heading, small * noise[1]),
            )

    def _has_left(self, index: int, std: tuple[float, float]) -> bool:
        """Whether a foot has been measured off its remembered location for several ticks."""
        place, heading = self._spread[index]
        moved, turned = self._departure[index, :2], abs(self._departure[index, 2])
        gate = self.config.gate
        return bool(
            np.abs(moved).max() > gate * math.hypot(place, std[0])
            or turned > gate * math.hypot(heading, std[1])
        )

    def compute_std(self) -> list[np.ndarray]:
        """Standard deviations of the residuals of each active contact; see `SyncTask`."""
        config, rows = self.config, []
        for index in self.active:
            landing = self.get_landing(index)
            height = config.contact_height + landing * config.touchdown_height
            tilt = config.contact_tilt + landing * config.touchdown_tilt
            rows.append(self.kind.arrange_std(*self._spread[index], height, tilt))
        return rows
