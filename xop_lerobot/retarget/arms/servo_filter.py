"""Angles of joints on stiff servos, without the noise of their encoders."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from xop_lerobot.morphology.effect import Acts

if TYPE_CHECKING:
    import mujoco

    from xop_lerobot.morphology.morphology import Morphology


class ServoFilter:
    r"""Estimates where servos hold their joints, from what they were told and where they are seen.

    A stiff servo follows its target s as a first-order lag, :math:`\dot m = (s - m)/T`, but for
    an offset that changes slowly, such as a sag. So of the measured angle q only the slow part of
    what the lag does not explain is believed,

    .. math:: b \leftarrow b + (1 - e^{-dt/\tau})(q - m - b), \qquad \hat q = m + b.

    White noise of q is damped by :math:`\sqrt{dt/2\tau}`, and no motion that was asked for is late.

    Args:
        lag: T of each joint [s]. Shape (n,).
        time_constant: τ [s].
    """

    def __init__(self, lag: np.ndarray, *, time_constant: float = 0.4) -> None:
        self.lag, self.time_constant = lag, time_constant
        self.reset()

    def reset(self) -> None:
        """Start anew from the next measurement."""
        self._model: np.ndarray | None = None
        self._offset = np.zeros(len(self.lag))

    def update(self, targets: np.ndarray, angles: np.ndarray, dt: float) -> np.ndarray:
        """Estimate the angles of now.

        Args:
            targets: What the servos have been told since the last update [rad]. Shape (n,).
            angles: Measured [rad]. Shape (n,).
            dt: Time since then [s].

        Returns:
            Estimated angles [rad]. Shape (n,).
        """
        if self._model is None:
            self._model, self._offset = targets.copy(), angles - targets
            return angles.copy()
        self._model += -np.expm1(-dt / self.lag) * (targets - self._model)
        error = angles - self._model - self._offset
        self._offset += -np.expm1(-dt / self.time_constant) * error
        return self._model + self._offset


class SteadyBody:
    """The configuration that the arms hang on, with the joints of stiff servos filtered.

    Args:
        morphology: The robot; says whether its body is on stiff servos.
        model: Any model of it, to find the joints.
    """

    def __init__(self, morphology: Morphology, model: mujoco.MjModel) -> None:
        effects = morphology.effects if morphology.has_stiff_body else ()
        held = [i for i, effect in enumerate(effects) if effect.acts is Acts.JOINT]
        self._entries = np.array(held, dtype=int)
        joints = [model.joint(effects[i].joint) for i in held]
        self._address = np.array([int(joint.qposadr[0]) for joint in joints], dtype=int)
        self._filter = ServoFilter(np.array([effects[i].lag_s for i in held]))

    def reset(self) -> None:
        """Start anew from the next configuration."""
        self._filter.reset()

    def update(self, qpos: np.ndarray, command: np.ndarray, dt: float) -> np.ndarray:
        """Return the configuration of now.

        Args:
            qpos: As measured. Shape (nq,).
            command: Command that is executed. Shape (k,).
            dt: Time since the last update [s].
        """
        if not len(self._address):
            return qpos
        steady = qpos.copy()
        angles = qpos[self._address]
        steady[self._address] = self._filter.update(command[self._entries], angles, dt)
        return steady
