"""First-order model of the effect of a command, for the kinematic proposal and the cost-to-go.

`CommandModel` extrapolates a configuration under a held command, and gives the derivative by it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from xop_lerobot.core.command import CommandSpace, Mode
from xop_lerobot.core.transforms import (
    compute_heading,
    quat_conjugate,
    quat_from_yaw,
    quat_multiply,
    quat_rotate,
    quat_yaw,
    wrap_angle,
)
from xop_lerobot.low_level.rest import BaseRest, RestMap
from xop_lerobot.morphology.effect import Acts, Effect, Gaze
from xop_lerobot.morphology.morphology import Morphology

_TWIST = (Acts.FORWARD, Acts.LEFT, Acts.TURN)
_TURN = 2
_BEHIND = 2.5  # heading of a goal from which a neck may turn on either side [rad]
_ALONG = 0.99  # cosine of the angle up to which a joint axis counts as parallel to an axis


@dataclass(frozen=True)
class Start:
    """Initial state of an extrapolation; leading dimensions make a batch.

    Attributes:
        qpos: Configuration. Shape (..., nq).
        executed: Present command, from which the robot ramps at its rate limits to the next one;
            None if commands take effect at once. Shape (..., k).
        drift: Base velocity beyond the commanded one: along, across [m/s], yaw rate [rad/s]; zero
            by default. Shape (3,).
        offset: Steady-state error of heights and joints from their command; zero by default.
            Shape (k,).
        settled: The executed command after the robot's lags, to which its present base pose
            belongs; neutral by default. Shape (..., k).
    """

    qpos: np.ndarray
    executed: np.ndarray | None = None
    drift: np.ndarray | None = None
    offset: np.ndarray | None = None
    settled: np.ndarray | None = None

    def without_ramp(self) -> Start:
        """Return the same state for a command that takes effect at once, without rate limits."""
        return Start(self.qpos, drift=self.drift, offset=self.offset, settled=self.settled)


@dataclass(frozen=True)
class PlannerState:
    """State of the robot as all parts of a solve see it.

    Attributes:
        qpos: Configuration. Shape (nq,).
        executed: Decision being executed. Shape (n,).
        drift: As in `Start`. Shape (3,).
        offset: As in `Start`. Shape (n,).
        settled: As in `Start`. Shape (n,).
        poses: Pose of each tracked frame. Shapes (7,).
        time: The robot's clock [s].
    """

    qpos: np.ndarray
    executed: np.ndarray
    drift: np.ndarray
    offset: np.ndarray
    settled: np.ndarray
    poses: Mapping[str, np.ndarray]
    time: float

    @cached_property
    def start(self) -> Start:
        """Initial state of extrapolations."""
        return Start(self.qpos, self.executed, self.drift, self.offset, self.settled)


class CommandModel:
    r"""Extrapolates a configuration under a command that is held for a given time.

    The base moves with the commanded twist about its pivot; height and joints follow with a
    first-order lag, :math:`q(t) = q + (a - q)(1 - e^{-t/T})`; all else stays. It models neither
    balance nor contacts: it proposes and ranks, the rollout in MuJoCo decides. In stationary mode
    a velocity displaces the base by `Effect.sway_s` times its change, with a lag (weight shift).

    Args:
        model: The robot's model.
        space: Its command space, or its decision space.
        effects: One effect for each entry.
        pivot: Forward distance from the base's frame to its centre of rotation [m].
        rest: Lean and displacement of a standing base by its policy; None if it has none.

    Attributes:
        neck: Mask of the joints of a neck. Shape (k,), bool.

    Raises:
        UnknownName: If `rest` names entries that are not in `space`.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        space: CommandSpace,
        effects: tuple[Effect, ...],
        pivot: float = 0.0,
        rest: RestMap | None = None,
    ) -> None:
        self.space, self.effects, self.pivot = space, effects, pivot
        self._rest = rest
        self._rest_entries = np.array(
            [space.index(name) for name in rest.entries] if rest else [], int
        )
        self._shares: dict[float, np.ndarray] = {}
        self._nv = model.nv
        self._twist = [
            (i, _TWIST.index(effect.acts))
            for i, effect in enumerate(effects)
            if effect.acts in _TWIST
        ]
        self._is_velocity = np.array([effect.acts in _TWIST for effect in effects])
        held = np.isin(space.names, list(rest.held) if rest else [])
        self._follows = {
            mode: ~self._is_velocity & ~(held & (mode is Mode.STATIONARY)) for mode in Mode
        }
        joints = [model.joint(e.joint) if e.joint else None for e in effects]
        self._address = np.array([int(joint.qposadr[0]) if joint else 2 for joint in joints])
        self._dof = np.array([int(joint.dofadr[0]) if joint else 2 for joint in joints])
        self._lag = np.array([effect.lag_s for effect in effects])
        self._gazes = [(i, effect.gaze) for i, effect in enumerate(effects) if effect.gaze]
        self.neck = np.array([effect.neck for effect in effects])
        self._sway = np.array([effect.sway_s for effect in effects])
        self._sways, self._body = True, np.ones(len(space), dtype=bool)
        self._find_acting()

    @property
    def body(self) -> np.ndarray:
        """Mask of the free entries; initially all. Shape (k,), bool."""
        return self._body

    @body.setter
    def body(self, mask: np.ndarray) -> None:
        self._body = np.array(mask, dtype=bool)
        self._body.setflags(write=False)
        self._find_acting()

    @property
    def sways(self) -> bool:
        """Whether velocities may shift the weight of a standing robot; initially true."""
        return self._sways

    @sways.setter
    def sways(self, sways: bool) -> None:
        self._sways = sways
        self._find_acting()

    def _find_acting(self) -> None:
        """Find the free entries that have an effect in each mode."""
        shifts = (self.space.sway > 0) & self._sways
        still = self.space.mobile_only & ~shifts
        self._acting = {
            mode: self._body
            & np.array([mode in effect.modes for effect in self.effects])
            & ~(still & (mode is Mode.STATIONARY))
            for mode in Mode
        }
        self._following = {
            mode: np.flatnonzero(acting & self._follows[mode])
            for mode, acting in self._acting.items()
        }
        self._moves_base = {
            mode: bool((acting & self._is_velocity).any()) for mode, acting in self._acting.items()
        }
        # The lean of the base changes only if entries that it depends on are free.
        self._leans = bool(self._acting[Mode.STATIONARY][self._rest_entries].any())

    def acting(self, mode: Mode) -> np.ndarray:
        """Mask of the free entries that have an effect in `mode`. Shape (k,), bool."""
        return self._acting[mode]

    def hold(
        self,
        decisions: np.ndarray,
        executed: np.ndarray,
        mode: Mode,
        proposal: np.ndarray | None = None,
    ) -> np.ndarray:
        """Set the entries that are not free: velocities to zero, the others as executed.

        With a proposal, the joints of a neck move as proposed: they are light, so that nothing
        has to be tried out.

        Shapes (..., k), (k,), (k,) -> (..., k).
        """
        stays = ~self.body & ~self._is_velocity
        held = np.where(stays, executed, self.space.neutral)
        held = np.where(self.acting(mode), decisions, held)
        return held if proposal is None else np.where(self.neck & self.body, proposal, held)

    def _compute_share(self, dt: float) -> np.ndarray:
        """Fraction of a step response that height and joints reach after `dt`. Shape (k,)."""
        share = self._shares.get(dt)
        if share is None:
            share = self._shares[dt] = 1 - np.exp(-dt / self._lag)
        return share

    @cached_property
    def is_nonholonomic(self) -> bool:
        """Whether the base drives forward but not sideways."""
        acts = {effect.acts for effect in self.effects}
        return Acts.FORWARD in acts and Acts.LEFT not in acts

    def limit_gaze(
        self,
        bounds: tuple[np.ndarray, np.ndarray],
        head: np.ndarray,
        base: np.ndarray,
        mode: Mode,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Limit joints to between neutral and the angles by which the goal of the head is turned.

        A neck that turned further, or the other way, would let the chest, and the arms with it,
        twist and bend for a centimetre of the head; a waist that did would bend a walking robot
        towards a goal that it is late for. Towards a goal behind the robot a joint may turn on
        either side.

        Args:
            bounds: Lower and upper bounds of the command. Shapes (k,).
            head: Goal of the head. Shape (7,).
            base: Pose of the base. Shape (7,).
            mode: Mode of the robot.
        """
        if not self._gazes:
            return bounds
        low, high = bounds[0].copy(), bounds[1].copy()
        heading = float(compute_heading(head[3:]))
        w, x, y, _ = quat_multiply(quat_from_yaw(-heading), head[3:])
        angles = {
            Gaze.HEADING: float(wrap_angle(heading - quat_yaw(base[3:7]))),
            Gaze.PITCH: float(wrap_angle(2 * math.atan2(y, w))),
            Gaze.ROLL: float(wrap_angle(2 * math.atan2(x, w))),
        }
        for i, limit in self._gazes:
            angle, neutral = angles[limit.angle], self.space.neutral[i]
            behind = limit.angle is Gaze.HEADING and abs(angle) > _BEHIND
            if behind or mode not in limit.modes:
                continue
            low[i] = max(low[i], min(neutral, angle) - limit.margin)
            high[i] = min(high[i], max(neutral, angle) + limit.margin)
        return low, high

    def is_velocity(self) -> np.ndarray:
        """Mask of the entries that are base velocities. Shape (k,), bool."""
        return self._is_velocity

    def compute_twist(self, command: np.ndarray) -> np.ndarray:
        """Commanded base velocity: along, across [m/s], yaw rate [rad/s]. (..., k) -> (..., 3)."""
        twist = np.zeros((*command.shape[:-1], 3))
        for i, axis in self._twist:
            twist[..., axis] += command[..., i]
        return twist

    def read(self, qpos: np.ndarray) -> np.ndarray:
        """Height and joint angles that the entries act on; 0 for velocities. (nq,) -> (k,)."""
        return np.where(self._is_velocity, 0.0, qpos[self._address])

    def limit_rates(
        self, executed: np.ndarray, commands: np.ndarray, mode: Mode, dt: float
    ) -> np.ndarray:
        """Apply the rate limits to command sequences with a step of `dt` [s].

        Shapes (k,), (K, H, k) -> (K, H, k).
        """
        step = self.space.compute_max_rate(mode, executed) * dt
        horizon = commands.shape[1]
        if (commands == commands[:, :1]).all():  # held commands (one knot) need no loop
            return self._approach(executed, commands, step * np.arange(1, horizon + 1)[:, None])
        limited = np.empty_like(commands)
        for k in range(horizon):
            executed = limited[:, k] = self._approach(executed, commands[:, k], step)
        return limited

    def _approach(
        self, executed: np.ndarray, commands: np.ndarray, reach: np.ndarray
    ) -> np.ndarray:
        """Go towards commands by at most `reach`, as `CommandSmoother` does. Shapes (..., k)."""
        missing = commands - executed
        return executed + self.space.straighten(np.clip(missing, -reach, reach), missing)

    def find_lowest_height(self) -> float:
        """Lowest base height that can be commanded [m]; infinite if none can."""
        low, _ = self.space.bounds(Mode.STATIONARY)
        heights = [low[i] for i, effect in enumerate(self.effects) if effect.acts is Acts.HEIGHT]
        return float(min(heights, default=math.inf))

    def compute_rest_tilt(self, command: np.ndarray, mode: Mode) -> float:
        """Tilt at which a standing base rests under a command [rad]; 0 if unknown.

        Args:
            command: The command. Shape (k,).
            mode: Mode of the robot; in mobile mode it does not rest.
        """
        if self._rest is None or mode is not Mode.STATIONARY:
            return 0.0
        return abs(float(self._find_rest(command).pitch))

    def settle(self, settled: np.ndarray, command: np.ndarray, dt: float) -> np.ndarray:
        """Lagged command after `dt` [s] more of `command`. (..., k)."""
        return command + (settled - command) * np.exp(-dt / self._lag)

    def _ramp(
        self, command: np.ndarray, executed: np.ndarray, dt: float, mode: Mode
    ) -> tuple[np.ndarray, np.ndarray]:
        """Effective command under the rate limits: mean of velocities, final value of the rest.

        Returns:
            The effective command and its derivative by the command. Shapes (..., k).
        """
        reach = self.space.compute_max_rate(mode, executed) * dt
        asked = command - executed
        reached = np.minimum(np.maximum(asked, -reach), reach)
        inside = np.abs(asked) <= reach
        if mode is Mode.STATIONARY:  # velocities do not integrate: only the final value counts
            return executed + reached, inside.astype(float)
        ramp = np.abs(reached) / np.maximum(reach, 1e-12)  # share of the time spent on the ramp
        mean = reached * (1 - ramp / 2)
        slope = np.where(self._is_velocity, 1 - ramp, 1.0) * inside
        return executed + np.where(self._is_velocity, mean, reached), slope

    def extrapolate(self, start: Start, command: np.ndarray, dt: float, mode: Mode) -> np.ndarray:
        """Compute the configuration after holding a command for `dt`.

        Args:
            start: Initial state.
            command: Held commands. Shape (..., k).
            dt: Duration [s].
            mode: Mode of the robot; only entries that act in it have an effect.

        Returns:
            Final configurations. Shape (..., nq).
        """
        qpos, offset = start.qpos, start.offset
        shape = command.shape[:-1]
        if qpos.ndim > 1:
            shape = np.broadcast_shapes(qpos.shape[:-1], shape)
        if start.executed is not None:
            command, _ = self._ramp(command, start.executed, dt, mode)
        result = np.broadcast_to(qpos, (*shape, qpos.shape[-1])).copy()
        index = self._following[mode]
        share, address = self._compute_share(dt)[index], self._address[index]
        target = command[..., index] if offset is None else command[..., index] + offset[index]
        result[..., address] += share * (target - result[..., address])
        if mode is Mode.STATIONARY:
            settled = self.space.neutral if start.settled is None else start.settled
            if self._leans:
                self._lean_base(result, command, settled, dt)
            if self._moves_base[mode]:
                self._sway_base(result, command, settled, dt)
            return result
        if not self._moves_base[mode]:
            return result
        twist = self.compute_twist(command) + (0 if start.drift is None else start.drift)
        forward, left, turn = twist[..., 0], twist[..., 1], twist[..., 2]
        yaw = quat_yaw(result[..., 3:7])
        middle = yaw + turn * dt / 2  # heading at half time: direction of the arc's chord
        x, y = np.cos(middle), np.sin(middle)
        result[..., 0] += dt * (forward * x - left * y)
        result[..., 1] += dt * (forward * y + left * x)
        if self.pivot:
            result[..., 0] += self.pivot * (np.cos(yaw) - np.cos(yaw + turn * dt))
            result[..., 1] += self.pivot * (np.sin(yaw) - np.sin(yaw + turn * dt))
        result[..., 3:7] = quat_multiply(quat_from_yaw(turn * dt), result[..., 3:7])
        return result

    def _lean_base(
        self, qpos: np.ndarray, command: np.ndarray, settled: np.ndarray, dt: float
    ) -> None:
        """Lean and move the base, in place, as its policy does at rest under a command.

        Applies the difference to the rest pose under `settled`, since the present pose is measured.
        """
        assert self._rest is not None
        before = self._find_rest(settled)
        after = self._find_rest(settled + self._compute_share(dt) * (command - settled))
        yaw = quat_yaw(qpos[..., 3:7])
        forward = after.forward - before.forward
        qpos[..., 0] += forward * np.cos(yaw)
        qpos[..., 1] += forward * np.sin(yaw)
        half = (after.pitch - before.pitch) / 2
        axis = np.sin(half)
        lean = np.stack([np.cos(half), -axis * np.sin(yaw), axis * np.cos(yaw), 0 * half], axis=-1)
        qpos[..., 3:7] = quat_multiply(lean, qpos[..., 3:7])

    def _find_rest(self, command: np.ndarray) -> BaseRest:
        """Rest pose of a standing base under a command. Shape (..., k)."""
        assert self._rest is not None
        first, second = self._rest_entries
        return self._rest(command[..., first], command[..., second])

    def _sway_base(
        self, qpos: np.ndarray, command: np.ndarray, settled: np.ndarray, dt: float
    ) -> None:
        """Shift the weight over standing feet, in place."""
        shift = self.compute_twist(self._sway * self._compute_share(dt) * (command - settled))
        yaw = quat_yaw(qpos[..., 3:7])
        x, y = np.cos(yaw), np.sin(yaw)
        qpos[..., 0] += shift[..., 0] * x - shift[..., 1] * y
        qpos[..., 1] += shift[..., 0] * y + shift[..., 1] * x

    def linearise(
        self, start: Start, command: np.ndarray, dt: float, mode: Mode
    ) -> tuple[np.ndarray, np.ndarray]:
        r"""Compute one extrapolation and :math:`\partial\phi_\tau(q, a)/\partial a`.

        Arguments as for `extrapolate`, without leading dimensions; plain floats instead of arrays
        make it fast. The derivative is in MuJoCo's tangent space: linear velocity of the base in
        the world frame, its angular velocity in the body frame.

        Returns:
            Final configuration, shape (nq,), and its derivative, shape (nv, k), zero for entries
            without effect.
        """
        qpos, offset, slope = start.qpos, start.offset, np.ones(len(command))
        if start.executed is not None:
            command, slope = self._ramp(command, start.executed, dt, mode)
        index, share = self._following[mode], self._compute_share(dt)
        future, jacobian = np.array(qpos), np.zeros((self._nv, len(command)))
        address, gain = self._address[index], share[index]
        target = command[index] if offset is None else command[index] + offset[index]
        future[address] += gain * (target - future[address])
        jacobian[self._dof[index], index] = gain * slope[index]
        stands = mode is Mode.STATIONARY
        if self._moves_base[mode] or (stands and self._leans):
            w, x, y, z = (float(value) for value in qpos[3:7])
            yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
            if stands:
                settled = self.space.neutral if start.settled is None else start.settled
                if self._leans:
                    self._linearise_lean(future, jacobian, command, settled, slope, share, yaw)
                self._linearise_sway(future, jacobian, command - settled, slope, share, yaw)
            else:
                twist = self.compute_twist(command) + (0 if start.drift is None else start.drift)
                self._linearise_drive(future, jacobian, twist, slope, yaw, dt)
        return future, jacobian

    def _linearise_lean(
        self,
        future: np.ndarray,
        jacobian: np.ndarray,
        command: np.ndarray,
        settled: np.ndarray,
        slope: np.ndarray,
        share: np.ndarray,
        yaw: float,
    ) -> None:
        """Lean and move the base at rest under a command; see `_lean_base`."""
        before = self._find_rest(settled)
        after = self._find_rest(settled + share * (command - settled))
        cosine, sine = math.cos(yaw), math.sin(yaw)
        forward = float(after.forward - before.forward)
        future[0] += forward * cosine
        future[1] += forward * sine
        half = float(after.pitch - before.pitch) / 2
        c, n = math.cos(half), math.sin(half)
        lean = np.array([c, -n * sine, n * cosine, 0.0])
        future[3:7] = quat_multiply(lean, future[3:7])
        left = quat_rotate(quat_conjugate(future[3:7]), np.array([-sine, cosine, 0.0]))
        for i, entry in enumerate(self._rest_entries):
            if self._acting[Mode.STATIONARY][entry]:
                gain = share[entry] * slope[entry]
                jacobian[0, entry] += gain * after.forward_slope[i] * cosine
                jacobian[1, entry] += gain * after.forward_slope[i] * sine
                jacobian[3:6, entry] += gain * after.pitch_slope[i] * left

    def _linearise_sway(
        self,
        future: np.ndarray,
        jacobian: np.ndarray,
        change: np.ndarray,
        slope: np.ndarray,
        share: np.ndarray,
        yaw: float,
    ) -> None:
        """Shift the weight over standing feet; see `_sway_base`."""
        axes = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
        gain = self._sway * share
        for i, acts in self._twist:
            if self._acting[Mode.STATIONARY][i] and acts != _TURN:
                jacobian[:2, i] = gain[i] * slope[i] * axes[acts]
        shift = self.compute_twist(gain * change)
        future[:2] += shift[0] * axes[0] + shift[1] * axes[1]

    def _linearise_drive(
        self,
        future: np.ndarray,
        jacobian: np.ndarray,
        twist: np.ndarray,
        slope: np.ndarray,
        yaw: float,
        dt: float,
    ) -> None:
        """Drive the base along the chord of its arc; see `extrapolate`."""
        forward, left, turn = (float(value) for value in twist)
        middle, end = yaw + turn * dt / 2, yaw + turn * dt
        cosine, sine = math.cos(middle), math.sin(middle)
        across = dt * dt / 2
        turning = (
            -across * (forward * sine + left * cosine) + self.pivot * dt * math.sin(end),
            across * (forward * cosine - left * sine) - self.pivot * dt * math.cos(end),
        )
        columns = ((dt * cosine, dt * sine), (-dt * sine, dt * cosine), turning)
        w, x, y, z = (float(value) for value in future[3:7])
        # The vertical in the body frame, R^T e_z; a turn about it leaves it unchanged.
        axis = (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
        for i, acts in self._twist:
            if self._acting[Mode.MOBILE][i]:
                jacobian[:2, i] = np.multiply(columns[acts], slope[i])
                if acts == _TURN:
                    jacobian[3:6, i] = np.multiply(axis, slope[i] * dt)
        future[0] += dt * (forward * cosine - left * sine)
        future[1] += dt * (forward * sine + left * cosine)
        future[0] += self.pivot * (math.cos(yaw) - math.cos(end))
        future[1] += self.pivot * (math.sin(yaw) - math.sin(end))
        c, n = math.cos(turn * dt / 2), math.sin(turn * dt / 2)
        future[3:7] = c * w - n * z, c * x - n * y, c * y + n * x, c * z + n * w


def find_joints_along(
    morphology: Morphology, model: mujoco.MjModel, command_model: CommandModel, axis: int
) -> np.ndarray:
    """Mask of the entries whose joint axis is parallel to a body axis in the standing posture.

    Args:
        morphology: The robot.
        model: Its model.
        command_model: Model with the effects of the entries.
        axis: 0 forward (roll), 1 left (pitch), 2 up (yaw).

    Returns:
        Shape (k,), bool.
    """
    data = mujoco.MjData(model)
    data.qpos[: len(morphology.standing_qpos())] = morphology.standing_qpos()
    mujoco.mj_kinematics(model, data)
    commands = {effect.joint for effect in morphology.effects}
    along = [
        effect.acts is Acts.JOINT
        and effect.joint in commands
        and abs(data.xaxis[model.joint(effect.joint).id, axis]) > _ALONG
        for effect in command_model.effects
    ]
    return np.array(along)
