"""Which feet or wheels stand on the ground, since when, and where."""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.retarget.sync.config import SyncConfig
from xop_lerobot.retarget.sync.contacts import Contact, compute_height

_RECENT = 0.2  # share of the newest tick in the recent mean of where a foot is seen


class StanceMemory:
    r"""The active set C of Eq. 4 and the known stance locations :math:`p^{world}_{c,i}`.

    C holds all wheels; both feet while stationary; the lower foot while mobile. A foot that is
    lifted, and any contact that is tilted or far from the ground (the robot fell or was lifted),
    does not count.

    The place of a foot is the mean of where the filtered measurement has seen it since it came
    to stand, forgetting with the memory's time:

    .. math::

        \hat p \leftarrow \hat p + \frac{\Delta t}{\min(T, T_{mem})} (p_c(\tilde x) - \hat p),
        \qquad \sigma^2 = \sigma_{best}^2 + \sigma_p^2\,\frac{\Delta t}{T}

    with T the time it stands. A foot that slips or lifts begins anew; one that creeps is followed
    within the memory. A foot that has just touched down is not at rest yet: `get_landing` decays
    from 1 with `touchdown_s`, and loosens its residuals.

    Args:
        contacts: The robot's feet or wheels.
        wheeled: Whether they are wheels; wheels have no place.
        config: Times and tolerances.
    """

    def __init__(self, contacts: Sequence[Contact], wheeled: bool, config: SyncConfig) -> None:
        self.contacts, self.wheeled, self.config = tuple(contacts), wheeled, config
        self.places = np.zeros((len(self.contacts), 3))
        """x, y [m] and heading [rad] of every foot in the world. Shape (contacts, 3)."""
        self.active: tuple[int, ...] = ()
        """Contacts that count now."""
        self.reset()

    def reset(self) -> None:
        """Forget where anything stands; what stands now has not just landed."""
        self.active = ()
        self._stood = [0.0] * len(self.contacts)  # time in the mean [s]
        self._landed = [math.inf] * len(self.contacts)  # time since the touch-down [s]
        self._departure = np.zeros((len(self.contacts), 3))  # recent mean, from the place
        self._spread = [(math.inf, math.inf)] * len(self.contacts)
        self._is_new = True

    def release(self, index: int) -> None:
        """Forget where a contact stood, because it moves."""
        self._stood[index], self._landed[index] = 0.0, 0.0

    def get_landing(self, index: int) -> float:
        """How much of its touch-down is left in a contact, 1 at first, then falling to 0."""
        if self.wheeled:
            return 0.0
        return math.exp(-self._landed[index] / self.config.touchdown_s)

    def update_contacts(self, data: mujoco.MjData, mode: Mode, dt: float) -> None:
        """Find what stands on the ground.

        Args:
            data: Pose of the robot, kinematics up to date.
            mode: Mode of the robot.
            dt: Time since the last update [s].
        """
        heights = [compute_height(contact, data) for contact in self.contacts]
        lowest = min(range(len(heights)), key=heights.__getitem__)
        active = []
        for index, contact in enumerate(self.contacts):
            raised = heights[index] - heights[lowest] > self.config.lift_height
            if not self.wheeled:
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
        tilt = (
            abs(math.asin(max(-1.0, min(1.0, upright))))
            if self.wheeled
            else math.acos(max(-1.0, min(1.0, upright)))
        )
        return abs(height) < self.config.lost_height and tilt < self.config.lost_tilt

    def remember(
        self,
        places: np.ndarray,
        dt: float,
        noise: tuple[float, float],
        std: tuple[float, float],
        memory_s: float,
    ) -> None:
        """Take the feet of the filtered measurement into the mean of their places.

        Args:
            places: x, y [m] and heading [rad] of every contact. Shape (contacts, 3).
            dt: Time since the last one [s].
            noise: Standard deviations of a measured position [m] and heading [rad] of the base.
            std: Those of the filtered position and heading.
            memory_s: Longest time over which to average [s].
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
        """Whether a foot has been seen beside its place for several ticks: it crept away."""
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
            if self.wheeled:
                rows.append(np.array([height, tilt]))
                continue
            place, heading = self._spread[index]
            rows.append(np.array([place, place, height, tilt, tilt, tilt, heading]))
        return rows
