"""What a command does, to first order: the cheap model behind proposals and the cost-to-go."""

from __future__ import annotations

import mujoco
import numpy as np

from xop_lerobot.command import CommandSpace, Mode
from xop_lerobot.morphology.effect import Acts, Effect
from xop_lerobot.transforms import quat_from_yaw, quat_multiply, quat_yaw

_TWIST = (Acts.FORWARD, Acts.LEFT, Acts.TURN)


class CommandModel:
    r"""Extrapolates a configuration under a command held for a time.

    The base moves with the commanded twist around its pivot; height and joints follow with a
    first-order lag, :math:`q(t) = q + (a - q)(1 - e^{-t/T})`; all else stays. It knows neither
    balance nor contacts: it only ranks and proposes, the rollout in MuJoCo decides.

    Args:
        model: The robot's model.
        space: Its command space.
        effects: One effect for each entry of the command.
        pivot: Forward distance from the base's frame to its centre of turning [m].
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        space: CommandSpace,
        effects: tuple[Effect, ...],
        pivot: float = 0.0,
    ) -> None:
        self.space, self.effects, self.pivot = space, effects, pivot
        self._address = [
            int(model.joint(effect.joint).qposadr[0]) if effect.joint else 2 for effect in effects
        ]

    def acting(self, mode: Mode) -> np.ndarray:
        """Which entries have an effect in `mode`. Shape (k,), bool."""
        acts = np.array([mode in effect.modes for effect in self.effects])
        return acts & ~(self.space.mobile_only & (mode == Mode.STATIONARY))

    @property
    def is_nonholonomic(self) -> bool:
        """Whether the base drives forward but not sideways."""
        acts = {effect.acts for effect in self.effects}
        return Acts.FORWARD in acts and Acts.LEFT not in acts

    def is_velocity(self) -> np.ndarray:
        """Which entries are velocities of the base. Shape (k,), bool."""
        return np.array([effect.acts in _TWIST for effect in self.effects])

    def compute_twist(self, command: np.ndarray) -> np.ndarray:
        """Commanded base velocity: along, across [m/s], yaw rate [rad/s]. (..., k) -> (..., 3)."""
        twist = np.zeros((*command.shape[:-1], 3))
        for i, effect in enumerate(self.effects):
            if effect.acts in _TWIST:
                twist[..., _TWIST.index(effect.acts)] += command[..., i]
        return twist

    def _ramp(self, command: np.ndarray, executed: np.ndarray, dt: float) -> np.ndarray:
        """What the rate limits make of a command: its mean for velocities, its end for the rest."""
        rate = self.space.max_rate
        wanted = command - executed
        reached = executed + np.clip(wanted, -rate * dt, rate * dt)
        ramp = np.minimum(np.abs(wanted) / rate, dt) / dt  # share of the time spent on the ramp
        mean = reached - (reached - executed) * ramp / 2
        return np.where(self.is_velocity(), mean, reached)

    def extrapolate(
        self,
        qpos: np.ndarray,
        command: np.ndarray,
        dt: float,
        mode: Mode,
        drift: np.ndarray | None = None,
        executed: np.ndarray | None = None,
    ) -> np.ndarray:
        """Compute the configuration after `dt` of a command.

        Args:
            qpos: Configurations now. Shape (..., nq).
            command: Commands that are held. Shape (..., k).
            dt: How long [s].
            mode: Mode of the robot; only what acts in it has an effect.
            drift: Base velocity beyond the commanded one, as `compute_twist`. Shape (3,).
            executed: Command executed now, from which the robot ramps at its rate limits to
                `command`; None where the command is executed already. Shape (..., k).

        Returns:
            Configurations then. Shape (..., nq).
        """
        shape = np.broadcast_shapes(qpos.shape[:-1], command.shape[:-1])
        if executed is not None:
            command = self._ramp(command, executed, dt)
        result = np.broadcast_to(qpos, (*shape, qpos.shape[-1])).copy()
        for i, (effect, acts) in enumerate(zip(self.effects, self.acting(mode), strict=True)):
            if acts and effect.acts not in _TWIST:
                share = 1 - np.exp(-dt / effect.lag_s)
                address = self._address[i]
                result[..., address] += share * (command[..., i] - result[..., address])
        if not (self.acting(mode) & self.is_velocity()).any():
            return result
        twist = self.compute_twist(command) + (0 if drift is None else drift)
        forward, left, turn = np.moveaxis(np.broadcast_to(twist, (*shape, 3)), -1, 0)
        yaw = quat_yaw(result[..., 3:7])
        middle = yaw + turn * dt / 2  # heading halfway: the chord of the arc
        x, y = np.cos(middle), np.sin(middle)
        result[..., 0] += dt * (forward * x - left * y)
        result[..., 1] += dt * (forward * y + left * x)
        if self.pivot:
            result[..., 0] += self.pivot * (np.cos(yaw) - np.cos(yaw + turn * dt))
            result[..., 1] += self.pivot * (np.sin(yaw) - np.sin(yaw + turn * dt))
        result[..., 3:7] = quat_multiply(quat_from_yaw(turn * dt), result[..., 3:7])
        return result
