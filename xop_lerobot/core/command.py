"""Commands of low-level policies: names, units, bounds and rate limits, and robot actions.

`CommandSpace` limits commands, `RobotAction` is what a robot executes, and `ActionLayout` converts
it from and to LeRobot's flat dictionaries.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property

import numpy as np

from xop_lerobot.core.errors import BadShape, BadValue, UnknownName


class Mode(IntEnum):
    """Mode of the lower body: standing in place, or walking and driving."""

    STATIONARY = 0
    MOBILE = 1


@dataclass(frozen=True)
class CommandDim:
    """One entry of a command.

    Attributes:
        name: The command's own name, ``"vx"``.
        key: Its LeRobot action key, ``"x.vel"``.
        unit: ``"m"``, ``"rad"``, ``"m/s"`` or ``"rad/s"``.
        low: Lower bound [unit].
        high: Upper bound [unit].
        neutral: Value at which the robot stands at rest [unit].
        max_rate: Rate limit [unit/s].
        mobile_only: Whether the entry is held at `neutral` in stationary mode.
        sway: Largest distance of a `mobile_only` entry from `neutral` in stationary mode [unit]: a
            standing policy may respond to a small velocity by shifting its weight.
        sway_rate: Rate limit of such an entry in stationary mode [unit/s]; faster changes make a
            standing policy step.
        stop_rate: Rate limit of a `mobile_only` entry when the robot has to stop [unit/s]; stopping
            a walk too suddenly throws a robot back. None for `max_rate`.
        max_accel: Acceleration limit in teleoperation, applied by `CommandSmoother` [unit/s²];
            None for no limit.
        alone: Whether the entry changes at its own rate instead of together with the posture, see
            `CommandSpace.straighten`.

    Raises:
        BadValue: If the bounds are in the wrong order, `neutral` is not between them, or a limit
            is not positive.
    """

    name: str
    key: str
    unit: str
    low: float
    high: float
    neutral: float
    max_rate: float
    mobile_only: bool = False
    sway: float = 0.0
    sway_rate: float = 0.1
    stop_rate: float | None = None
    max_accel: float | None = None
    alone: bool = False

    def __post_init__(self) -> None:
        if not self.low <= self.neutral <= self.high:
            raise BadValue(
                f"command {self.name!r} must have low <= neutral <= high, got {self.low}, "
                f"{self.neutral}, {self.high}"
            )
        for limit in ("max_rate", "stop_rate", "max_accel"):
            value = getattr(self, limit)
            if value is not None and not value > 0:
                raise BadValue(f"{limit} of command {self.name!r} must be positive, got {value}")


@dataclass(frozen=True)
class CommandSpace:
    r"""The admissible set :math:`\mathcal A = \{a \mid a_{min} \le a \le a_{max}\}` (Eq. 1d).

    Attributes:
        dims: The entries, in order; their bounds hold in all modes.
        ranges: Narrower bounds by mode and entry, which a low-level policy can follow.
        dead_zones: Magnitude of a velocity below which a low-level policy does not react, by
            entry.
    """

    dims: tuple[CommandDim, ...]
    ranges: Mapping[Mode, Mapping[str, tuple[float, float]]] = field(default_factory=dict)
    dead_zones: Mapping[str, float] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.dims)

    def _column(self, field: str) -> np.ndarray:
        column = np.array([getattr(dim, field) for dim in self.dims], dtype=float)
        column.setflags(write=False)  # cached, so all callers share the array
        return column

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names in order. Shape (k,)."""
        return tuple(dim.name for dim in self.dims)

    @cached_property
    def keys(self) -> tuple[str, ...]:
        """LeRobot action keys in order. Shape (k,)."""
        return tuple(dim.key for dim in self.dims)

    @cached_property
    def low(self) -> np.ndarray:
        """Lower bounds. Shape (k,)."""
        return self._column("low")

    @cached_property
    def high(self) -> np.ndarray:
        """Upper bounds. Shape (k,)."""
        return self._column("high")

    @cached_property
    def _bounds(self) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
        """Bounds by mode. Shapes (k,)."""
        bounds = []
        for mode in Mode:
            low, high = self.low.copy(), self.high.copy()
            for name, (least, most) in self.ranges.get(mode, {}).items():
                i = self.index(name)
                low[i], high[i] = max(low[i], least), min(high[i], most)
            low.setflags(write=False)
            high.setflags(write=False)
            bounds.append((low, high))
        return tuple(bounds)

    def bounds(self, mode: Mode) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds in `mode`. Shapes (k,)."""
        return self._bounds[mode]

    def fit(
        self,
        ranges: Mapping[Mode, Mapping[str, tuple[float, float]]],
        dead_zones: Mapping[str, float],
        stop_rates: Mapping[str, float] | None = None,
    ) -> CommandSpace:
        """Return the subset of this space that a low-level policy can follow.

        Args:
            ranges: Bounds by mode and entry; entries that are not named keep theirs.
            dead_zones: Magnitude of a velocity below which the policy does not react, by entry.
            stop_rates: `CommandDim.stop_rate` of velocities, by entry.

        Raises:
            BadValue: If a range does not overlap with the robot's bounds, or a stop rate is not
                positive or not of a velocity.
            UnknownName: If there is no such entry.
        """
        for mode, limits in ranges.items():
            for name, (least, most) in limits.items():
                dim = self.dims[self.index(name)]
                if least > most or most < dim.low or least > dim.high:
                    raise BadValue(
                        f"command {name!r} is {dim.low} to {dim.high} {dim.unit} for this robot, "
                        f"and the policy's range in {mode.name.lower()} mode is {least} to {most}"
                    )
        dims = list(self.dims)
        for name, rate in (stop_rates or {}).items():
            i = self.index(name)
            if not dims[i].mobile_only:
                raise BadValue(f"the policy's stop rate must be of a velocity, got {name!r}")
            dims[i] = replace(dims[i], stop_rate=float(rate))
        fitted = replace(self, dims=tuple(dims), ranges=ranges, dead_zones=dead_zones)
        # Entries get the widest bounds of both modes; neutral must lie within them.
        low = np.min([fitted.bounds(mode)[0] for mode in Mode], axis=0)
        high = np.max([fitted.bounds(mode)[1] for mode in Mode], axis=0)
        bounded = tuple(
            replace(dim, low=least, high=most, neutral=min(max(dim.neutral, least), most))
            for dim, least, most in zip(dims, low.tolist(), high.tolist(), strict=True)
        )
        return replace(fitted, dims=bounded)

    def extend(self, dims: tuple[CommandDim, ...]) -> CommandSpace:
        """Return this space with additional entries at the end."""
        return replace(self, dims=(*self.dims, *dims))

    @cached_property
    def _dead(self) -> np.ndarray:
        """Dead zone of each entry. Shape (k,)."""
        return np.array([self.dead_zones.get(dim.name, 0.0) for dim in self.dims])

    @cached_property
    def neutral(self) -> np.ndarray:
        """Neutral command. Shape (k,)."""
        return self._column("neutral")

    @cached_property
    def max_rate(self) -> np.ndarray:
        """Rate limits [unit/s]. Shape (k,)."""
        return self._column("max_rate")

    @cached_property
    def max_accel(self) -> np.ndarray:
        """Acceleration limits [unit/s²], infinite for none. Shape (k,)."""
        limits = [np.inf if dim.max_accel is None else dim.max_accel for dim in self.dims]
        column = np.array(limits, dtype=float)
        column.setflags(write=False)
        return column

    @cached_property
    def mobile_only(self) -> np.ndarray:
        """Mask of the entries that are neutral in stationary mode. Shape (k,), bool."""
        column = np.array([dim.mobile_only for dim in self.dims], dtype=bool)
        column.setflags(write=False)
        return column

    @cached_property
    def sway(self) -> np.ndarray:
        """Largest distance of `mobile_only` entries from neutral in stationary mode. (k,)."""
        return self._column("sway")

    @cached_property
    def _sways(self) -> np.ndarray:
        return self.sway > 0

    @cached_property
    def _sway_rate(self) -> np.ndarray:
        return self._column("sway_rate")

    @cached_property
    def stop_rate(self) -> np.ndarray:
        """Rate limits while the robot stops in order to stand [unit/s]. Shape (k,)."""
        rates = [
            dim.stop_rate if dim.mobile_only and dim.stop_rate is not None else dim.max_rate
            for dim in self.dims
        ]
        column = np.array(rates, dtype=float)
        column.setflags(write=False)
        return column

    def compute_max_rate(self, mode: Mode, executed: np.ndarray) -> np.ndarray:
        """Rate limits after the command `executed` [unit/s]. Shapes (k,) -> (k,)."""
        if mode is Mode.MOBILE:
            return self.max_rate
        if not self._sways.any():
            return self.stop_rate
        # A velocity above the sway limit is being stopped, at its stop rate.
        sways = self.mobile_only & (np.abs(executed - self.neutral) <= self.sway + 1e-6)
        return np.where(sways & self._sways, self._sway_rate, self.stop_rate)

    def restrict(self, command: np.ndarray, mode: Mode) -> np.ndarray:
        """Restrict a command to what `mode` and the bounds allow. Shapes (..., k)."""
        if mode is Mode.STATIONARY:
            still = np.clip(command, self.neutral - self.sway, self.neutral + self.sway)
            command = np.where(self.mobile_only, still, command)
        return np.clip(command, *self.bounds(mode))

    def leave_dead_zones(self, command: np.ndarray, mode: Mode) -> np.ndarray:
        """Move velocities out of the policy's dead zones in mobile mode. Shapes (..., k).

        A velocity within its dead zone is rounded to zero or to the edge of the zone. Only
        planners need this; a robot executes velocities within the zone, too, while ramping.
        """
        if mode is not Mode.MOBILE or not self.dead_zones:
            return command
        size = np.abs(command)
        acts = np.where(size < 0.5 * self._dead, 0.0, np.sign(command) * self._dead)
        return np.where(size < self._dead, acts, command)

    def compute_rest(self, command: np.ndarray, mode: Mode) -> np.ndarray:
        """Command to hold in place a robot that executes `command` in `mode`. Shape (k,).

        A standing robot keeps its weight shift. In mobile mode, or above the sway limit, velocities
        go to neutral. While they decrease below the sway limit they must not be taken for a weight
        shift, so compute this once when stopping, or stay in mobile mode until they are zero.
        """
        stops = self.mobile_only & (np.abs(command - self.neutral) > self.sway + 1e-6)
        if mode is Mode.MOBILE:
            stops = self.mobile_only
        low, high = self.bounds(mode)
        return np.clip(np.where(stops, self.neutral, command), low, high)

    def straighten(self, step: np.ndarray, missing: np.ndarray) -> np.ndarray:
        r"""Shorten steps so that a posture changes along a straight line.

        All entries but velocities and those that are `alone` move by one share of what they miss,
        :math:`s = \min_i |\delta_i| / |\Delta_i|`, and so arrive together. With each at its own
        rate, quick joints of a chain run ahead of slow ones: between two postures that have the
        head in the same place it would go a long way round.

        Args:
            step: Steps :math:`\delta` within the rate limits, towards what is missing. (..., k).
            missing: Distance :math:`\Delta` to what is wanted. Shape (..., k).

        Returns:
            The steps, none of them longer. Shape (..., k).
        """
        size, distance = np.abs(step), np.abs(missing)
        counts = ~self._apart & (distance > 1e-12)
        shares = np.divide(size, distance, out=np.ones_like(size), where=counts)
        share = shares.min(axis=-1, keepdims=True, initial=1.0)
        return np.where(self._apart, step, share * missing)

    @cached_property
    def _apart(self) -> np.ndarray:
        """Which entries change at their own rates. Shape (k,), bool."""
        return self.mobile_only | np.array([dim.alone for dim in self.dims], dtype=bool)

    def index(self, name: str) -> int:
        """Return the index of `name`.

        Raises:
            UnknownName: Listing the names of this space.
        """
        try:
            return self.names.index(name)
        except ValueError:
            raise UnknownName("command", name, self.names) from None

    def limit(
        self, command: np.ndarray, previous: np.ndarray | None, dt: float, mode: Mode
    ) -> np.ndarray:
        r"""Clip to the bounds and to :math:`|a - a_{prev}| \le \dot a_{max}\,dt`.

        In stationary mode `mobile_only` entries go to within their `sway` of neutral, at the rate
        limits of that mode.

        Args:
            command: Desired command. Shape (k,).
            previous: Command executed last; None for no rate limit. Shape (k,).
            dt: Time since `previous` [s].
            mode: Mode of the robot.

        Returns:
            The command to execute. Shape (k,).
        """
        command = check_vector("command", command, len(self))
        wanted = self.restrict(command, mode)
        if previous is None:
            return wanted
        step = self.compute_max_rate(mode, previous) * dt
        return np.clip(wanted, previous - step, previous + step)


@dataclass(frozen=True)
class RobotAction:
    """Action of one `send_action`.

    Attributes:
        command: Low-level command. Shape (k,).
        mode: Stationary or mobile.
        arms: Arm joint targets [rad], then gripper openings [m]. Shape (m,).
    """

    command: np.ndarray
    mode: Mode
    arms: np.ndarray


MODE_KEY = "mode.pos"


@dataclass(frozen=True)
class ActionLayout:
    """Layout of a `RobotAction` in LeRobot's flat action dictionary.

    Attributes:
        space: The command space.
        arm_names: Arm joints, then grippers, in the order of `RobotAction.arms`. Shape (m,).
    """

    space: CommandSpace
    arm_names: tuple[str, ...]

    @cached_property
    def keys(self) -> tuple[str, ...]:
        """Action keys in the order of the dataset's `action` column."""
        return (*self.space.keys, MODE_KEY, *(f"{name}.pos" for name in self.arm_names))

    def to_dict(self, action: RobotAction) -> dict[str, float]:
        """Convert `action` to a flat dictionary."""
        values = (*action.command, float(action.mode), *action.arms)
        return {key: float(value) for key, value in zip(self.keys, values, strict=True)}

    def from_dict(self, values: Mapping[str, float], previous: RobotAction) -> RobotAction:
        """Convert a flat dictionary to an action; absent keys keep their value in `previous`.

        Raises:
            UnknownName: If a key is not an action key of this robot.
            BadValue: If a value is not a finite number.
        """
        flat = self.to_dict(previous)
        for key, value in values.items():
            if key not in flat:
                raise UnknownName("action key", key, self.keys)
            number = float(value)
            if not np.isfinite(number):
                raise BadValue(f"action {key!r} must be finite, got {number}")
            flat[key] = number
        column = np.array(list(flat.values()))
        k = len(self.space)
        # In LeRobot's actions the mode is a float, which a learned policy hits only roughly.
        mode = Mode.MOBILE if column[k] >= 0.5 else Mode.STATIONARY
        return RobotAction(column[:k], mode, column[k + 1 :])


def check_vector(name: str, vector: np.ndarray, size: int) -> np.ndarray:
    """Return `vector` as a float array of shape (size,).

    Raises:
        BadShape: If it has another shape.
        BadValue: If it holds a number that is not finite.
    """
    array = np.asarray(vector, dtype=float)
    if array.shape != (size,):
        raise BadShape(name, (size,), array.shape)
    if not np.isfinite(array).all():
        raise BadValue(f"{name} must be finite, got {array}")
    return array
