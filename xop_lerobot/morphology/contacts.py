"""Kinds of ground contact: `Feet`, which are lifted and set down, and `Wheels`.

A `ContactKind` holds all that differs between them in the stance cost and in the state
synchronisation (Eq. 4): residuals, velocity constraints and their standard deviations.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.transforms import skew


@dataclass(frozen=True)
class Contact:
    """A foot or a wheel.

    Attributes:
        name: Site of its first point.
        body: Id of its body.
        point: Mean of its contact points, or centre of the wheel, in the body's frame [m].
            Shape (3,).
        axis: Normal of the sole, or axle of the wheel, in the body's frame. Shape (3,).
        forward: Forward direction of a foot in the body's frame. Shape (3,).
        height: Height of `point` over z = 0 under its share of the weight [m].
        radius: Distance from `point` down to the ground, 0 for a foot [m].
        rolls: Whether the body turns on a hinge about `axis`.
    """

    name: str
    body: int
    point: np.ndarray
    axis: np.ndarray
    forward: np.ndarray
    height: float
    radius: float
    rolls: bool


class ContactKind(ABC):
    """Constraints of a kind of contact: its residuals and the velocities that are zero.

    Attributes:
        rows: Number of residuals of a contact; see `fill_residuals`.
        height_row: Row of its height.
        steps: Whether contacts are lifted and set down. If so, only the lowest is active in mobile
            mode, and one that has just touched down is not yet at rest.
        tells_speed: Whether contacts measure the base velocity better than any prediction.
        keeps_level: Whether the base can neither roll nor pitch while all contacts are down.
    """

    rows: int
    height_row: int
    steps: bool
    tells_speed: bool
    keeps_level: bool

    @abstractmethod
    def holds_place(self, mode: Mode) -> bool:
        """Whether an active contact is stationary in `mode`."""

    @abstractmethod
    def make_contact(
        self,
        name: str,
        body: int,
        point: np.ndarray,
        rotation: np.ndarray,
        height: float,
        hinge: np.ndarray | None,
    ) -> Contact:
        """Make one contact of a standing robot.

        Args:
            name: Site of its first point.
            body: Id of its body.
            point: Mean of its points in the body's frame [m]. Shape (3,).
            rotation: Orientation of the body in the world. Shape (3, 3).
            height: Height of `point` under the robot's weight [m].
            hinge: Axis of the body's hinge in its frame; None for a body without one. Shape (3,).
        """

    @abstractmethod
    def compute_tilt(self, upright: float) -> float:
        """Tilt of a contact whose `axis` has the cosine `upright` to the vertical [rad]."""

    @abstractmethod
    def arrange_std(self, place: float, heading: float, height: float, tilt: float) -> np.ndarray:
        """Standard deviation of each residual of a contact. Shape (rows,).

        Args:
            place: Standard deviation of its horizontal position [m].
            heading: Standard deviation of its heading [rad].
            height: Standard deviation of its height [m].
            tilt: Standard deviation of its tilt [rad].
        """

    @abstractmethod
    def fill_residuals(
        self,
        contact: Contact,
        rotation: np.ndarray,
        point: np.ndarray,
        stance: np.ndarray,
        linear: np.ndarray,
        angular: np.ndarray,
        error: np.ndarray,
        jacobian: np.ndarray,
    ) -> None:
        """Compute the residuals of a contact and their derivatives (Eq. 4).

        Args:
            contact: The contact.
            rotation: Orientation of its body in the world. Shape (3, 3).
            point: Its point in the world [m]. Shape (3,).
            stance: Stance location: x, y [m] and heading [rad]. Shape (3,).
            linear: Jacobian of the velocity of its point, world axes. Shape (3, nv).
            angular: Jacobian of the angular velocity of its body, world axes. Shape (3, nv).
            error: Output: the residuals. Shape (rows,).
            jacobian: Output: their derivatives. Shape (rows, nv).
        """

    @abstractmethod
    def select_velocities(
        self, contact: Contact, rotation: np.ndarray, jacobian: np.ndarray
    ) -> np.ndarray:
        """Select the velocities that are zero while a contact holds.

        Args:
            contact: The contact.
            rotation: Orientation of its body in the world. Shape (3, 3).
            jacobian: Jacobian of the velocity of the material point on the ground and of its
                body's angular velocity, world axes. Shape (6, nv).

        Returns:
            Shape (m, nv).
        """

    @abstractmethod
    def arrange_variance(self, contact: Contact, linear: float, angular: float) -> np.ndarray:
        """Variance of each row of `select_velocities`. Shape (m,).

        Args:
            contact: The contact.
            linear: Variance of a linear velocity [m²/s²].
            angular: Variance of an angular velocity [rad²/s²].
        """


class Feet(ContactKind):
    r"""Feet: flat soles with several contact points, which are lifted and set down.

    Residuals, with the point :math:`c_i = p + R(\theta) p_{c,i}(q)`:

    ============ ================================================ ==== ====
    residual     formula                                          rows unit
    ============ ================================================ ==== ====
    position     :math:`c_i - p^{world}_{c,i}`                    3    m
    flat         :math:`R R_{c,i} e_z - e_z`                      3    1
    heading      :math:`\psi(R R_{c,i} e_x) - \psi^{world}_i`     1    rad
    ============ ================================================ ==== ====

    The heading is an addition to the paper, which has only the position of a foot. Linear and
    angular velocity of a stance foot are zero, 6 rows.
    """

    rows = 7
    height_row = 2
    steps = True
    tells_speed = False
    keeps_level = False

    def holds_place(self, mode: Mode) -> bool:
        """Stance feet are stationary in either mode."""
        del mode
        return True

    def make_contact(
        self,
        name: str,
        body: int,
        point: np.ndarray,
        rotation: np.ndarray,
        height: float,
        hinge: np.ndarray | None,
    ) -> Contact:
        """Make the contact of a flat foot; the hinge of its ankle is irrelevant."""
        del hinge
        up, forward = rotation.T[:, 2].copy(), rotation.T[:, 0].copy()
        return Contact(name, body, point, up, forward, height, 0.0, rolls=False)

    def compute_tilt(self, upright: float) -> float:
        """Angle of the sole's normal to the vertical [rad]."""
        return math.acos(max(-1.0, min(1.0, upright)))

    def arrange_std(self, place: float, heading: float, height: float, tilt: float) -> np.ndarray:
        """Standard deviation of each residual of a foot. Shape (7,)."""
        return np.array([place, place, height, tilt, tilt, tilt, heading])

    def fill_residuals(
        self,
        contact: Contact,
        rotation: np.ndarray,
        point: np.ndarray,
        stance: np.ndarray,
        linear: np.ndarray,
        angular: np.ndarray,
        error: np.ndarray,
        jacobian: np.ndarray,
    ) -> None:
        """Compute position, flatness and heading of a foot."""
        error[:2] = point[:2] - stance[:2]
        error[2] = point[2] - contact.height
        jacobian[:3] = linear
        up, forward = rotation @ contact.axis, rotation @ contact.forward
        error[3:6] = up
        error[5] -= 1
        jacobian[3:6] = -skew(up) @ angular
        # psi = atan2(f_y, f_x) of the forward direction f, with f' = omega x f
        length = forward[0] ** 2 + forward[1] ** 2
        turn = np.array([-forward[0] * forward[2], -forward[1] * forward[2], length]) / length
        jacobian[6] = turn @ angular
        error[6] = _wrap(math.atan2(forward[1], forward[0]) - stance[2])

    def select_velocities(
        self, contact: Contact, rotation: np.ndarray, jacobian: np.ndarray
    ) -> np.ndarray:
        """All six velocities of a foot. Shape (6, nv)."""
        del contact, rotation
        return jacobian

    def arrange_variance(self, contact: Contact, linear: float, angular: float) -> np.ndarray:
        """Variance of the six velocities of a foot. Shape (6,)."""
        del contact
        return np.array([linear] * 3 + [angular] * 3)


class Wheels(ContactKind):
    r"""Wheels that roll without slip, all of them on the ground.

    Residuals, with the centre :math:`c_i`, 1 row each: height :math:`e_z^\top c_i - r_i` [m] and
    axle :math:`e_z^\top R R_{c,i} e_y` [1]. Velocities that are zero while it rolls:

    - Wheel on a hinge: velocity of the material point on the ground, :math:`c - r e_z`, 3 rows: no
      lateral and no vertical velocity, forward velocity of the centre equal to wheel speed times
      radius.
    - Wheel whose rotation is not a joint of the model: velocity of its centre along the axle and
      vertical, 2 rows.
    """

    rows = 2
    height_row = 0
    steps = False
    tells_speed = True
    keeps_level = True

    def holds_place(self, mode: Mode) -> bool:
        """Wheels are stationary in stationary mode only."""
        return mode is Mode.STATIONARY

    def make_contact(
        self,
        name: str,
        body: int,
        point: np.ndarray,
        rotation: np.ndarray,
        height: float,
        hinge: np.ndarray | None,
    ) -> Contact:
        """Make the contact of a wheel; without a hinge its axle is the world's Y axis."""
        axle = rotation.T[:, 1] if hinge is None else hinge
        forward, rolls = rotation.T[:, 0].copy(), hinge is not None
        return Contact(name, body, point, axle.copy(), forward, height, height, rolls)

    def compute_tilt(self, upright: float) -> float:
        """Angle of the axle to the ground [rad]."""
        return abs(math.asin(max(-1.0, min(1.0, upright))))

    def arrange_std(self, place: float, heading: float, height: float, tilt: float) -> np.ndarray:
        """Standard deviation of height and axle; a wheel has no stance location. Shape (2,)."""
        del place, heading
        return np.array([height, tilt])

    def fill_residuals(
        self,
        contact: Contact,
        rotation: np.ndarray,
        point: np.ndarray,
        stance: np.ndarray,
        linear: np.ndarray,
        angular: np.ndarray,
        error: np.ndarray,
        jacobian: np.ndarray,
    ) -> None:
        """Compute height and axle of a wheel."""
        del stance
        axle = rotation @ contact.axis
        error[0], error[1] = point[2] - contact.height, axle[2]
        jacobian[0] = linear[2]
        jacobian[1] = axle[1] * angular[0] - axle[0] * angular[1]  # (w x axle)_z

    def select_velocities(
        self, contact: Contact, rotation: np.ndarray, jacobian: np.ndarray
    ) -> np.ndarray:
        """Velocity of the ground point, or of the centre. Shape (3, nv) or (2, nv)."""
        if contact.rolls:
            return jacobian[:3]
        return np.stack([(rotation @ contact.axis) @ jacobian[:3], jacobian[2]])

    def arrange_variance(self, contact: Contact, linear: float, angular: float) -> np.ndarray:
        """Variance of those velocities. Shape (3,) or (2,)."""
        del angular
        return np.full(3 if contact.rolls else 2, linear)


def _wrap(angle: float) -> float:
    """Wrap to [-pi, pi) [rad]."""
    return (angle + math.pi) % (2 * math.pi) - math.pi
