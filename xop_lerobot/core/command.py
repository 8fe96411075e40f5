"""Commands of a low-level policy: named, bounded, with units, and what of them a robot executes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property

import numpy as np

from xop_lerobot.core.errors import BadShape, BadValue, UnknownName


class Mode(IntEnum):
    """What the lower body may do; a double pinch toggles it."""

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
        max_rate: Largest change per second that the robot executes [unit/s].
        mobile_only: Whether the entry is held at `neutral` in stationary mode.
        sway: How far a `mobile_only` entry may leave `neutral` in stationary mode all the same
            [unit]. A policy that stands may answer to a small velocity by shifting its weight.
        sway_rate: Largest change per second of an entry that sways, since haste makes a standing
            policy step [unit/s].
        stop_rate: Largest change per second of an entry that is `mobile_only` on its way to neutral
            once the robot is to stand, since a walk that ends too suddenly throws a robot back
            [unit/s]; None for `max_rate`.
        max_accel: Largest change of its rate per second that a teleoperation asks for [unit/s²];
            None for no limit. `CommandSmoother` keeps it.

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
        ranges: Narrower bounds in a mode, by entry: what a low-level policy can do.
        dead_zones: Size of a velocity under which a low-level policy does nothing, by entry.
    """

    dims: tuple[CommandDim, ...]
    ranges: Mapping[Mode, Mapping[str, tuple[float, float]]] = field(default_factory=dict)
    dead_zones: Mapping[str, float] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.dims)

    def _column(self, field: str) -> np.ndarray:
        column = np.array([getattr(dim, field) for dim in self.dims], dtype=float)
        column.setflags(write=False)
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
        """Bounds in each mode. Shapes (k,)."""
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
        """Lowest and highest command in `mode`. Shapes (k,)."""
        return self._bounds[mode]

    def fit(
        self,
        ranges: Mapping[Mode, Mapping[str, tuple[float, float]]],
        dead_zones: Mapping[str, float],
        stop_rates: Mapping[str, float] | None = None,
    ) -> CommandSpace:
        """The part of this space that a low-level policy can do.

        Args:
            ranges: Bounds in each mode, by entry; entries that are not named keep theirs.
            dead_zones: Size of a velocity under which nothing happens, by entry.
            stop_rates: `CommandDim.stop_rate` of velocities, by entry.

        Raises:
            BadValue: If a range and the robot's bounds have nothing in common, or a stop rate is
                not positive, or not of a velocity.
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
        low = np.min([fitted.bounds(mode)[0] for mode in Mode], axis=0)
        high = np.max([fitted.bounds(mode)[1] for mode in Mode], axis=0)
        bounded = tuple(
            replace(dim, low=least, high=most, neutral=min(max(dim.neutral, least), most))
            for dim, least, most in zip(dims, low.tolist(), high.tolist(), strict=True)
        )
        return replace(fitted, dims=bounded)

    def extend(self, dims: tuple[CommandDim, ...]) -> CommandSpace:
        """This space with further entries behind its own."""
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
        """Rate limits per second. Shape (k,)."""
        return self._column("max_rate")

    @cached_property
    def max_accel(self) -> np.ndarray:
        """Largest changes of the rate per second, infinite where there is no limit. (k,)."""
        limits = [np.inf if dim.max_accel is None else dim.max_accel for dim in self.dims]
        column = np.array(limits, dtype=float)
        column.setflags(write=False)
        return column

    @cached_property
    def mobile_only(self) -> np.ndarray:
        """Whether an entry is neutral in stationary mode. Shape (k,), bool."""
        column = np.array([dim.mobile_only for dim in self.dims], dtype=bool)
        column.setflags(write=False)
        return column

    @cached_property
    def sway(self) -> np.ndarray:
        """How far `mobile_only` entries may leave neutral in stationary mode. Shape (k,)."""
        return self._column("sway")

    @cached_property
    def _sways(self) -> np.ndarray:
        return self.sway > 0

    @cached_property
    def _sway_rate(self) -> np.ndarray:
        return self._column("sway_rate")

    @cached_property
    def stop_rate(self) -> np.ndarray:
        """Rate limits per second of a robot that stops in order to stand. Shape (k,)."""
        rates = [
            dim.stop_rate if dim.mobile_only and dim.stop_rate is not None else dim.max_rate
            for dim in self.dims
        ]
        column = np.array(rates, dtype=float)
        column.setflags(write=False)
        return column

    def compute_max_rate(self, mode: Mode, executed: np.ndarray) -> np.ndarray:
        """Rate limits per second after `executed`. Shapes (k,) -> (k,)."""
        if mode is Mode.MOBILE:
            return self.max_rate
        if not self._sways.any():
            return self.stop_rate
        # What is still faster than any sway is being stopped.
        sways = self.mobile_only & (np.abs(executed - self.neutral) <= self.sway + 1e-6)
        return np.where(sways & self._sways, self._sway_rate, self.stop_rate)

    def restrict(self, command: np.ndarray, mode: Mode) -> np.ndarray:
        """What of a command `mode` and the bounds allow. Shapes (..., k)."""
        if mode is Mode.STATIONARY:
            still = np.clip(command, self.neutral - self.sway, self.neutral + self.sway)
            command = np.where(self.mobile_only, still, command)
        return np.clip(command, *self.bounds(mode))

    def leave_dead_zones(self, command: np.ndarray, mode: Mode) -> np.ndarray:
        """Move what a policy would not answer to where it does. Shapes (..., k).

        In mobile mode a velocity within its dead zone goes to the nearer end: to zero, or to
        where it acts. For planners: a robot executes what is on the way there too.
        """
        if mode is not Mode.MOBILE or not self.dead_zones:
            return command
        size = np.abs(command)
        acts = np.where(size < 0.5 * self._dead, 0.0, np.sign(command) * self._dead)
        return np.where(size < self._dead, acts, command)

    def compute_rest(self, command: np.ndarray, mode: Mode) -> np.ndarray:
        """What a robot that executes `command` in `mode` keeps of it to stand still. (k,).

        A standing robot keeps its sway, which holds its weight where it is. A walking one keeps
        nothing of a velocity, nor does one that is faster than any sway: it is being stopped, and
        what is left of its velocity on the way down is no sway either. So who stops a robot asks
        this once, or leaves it mobile until its velocities have stopped.
        """
        stops = self.mobile_only & (np.abs(command - self.neutral) > self.sway + 1e-6)
        if mode is Mode.MOBILE:
            stops = self.mobile_only
        low, high = self.bounds(mode)
        return np.clip(np.where(stops, self.neutral, command), low, high)

    def straighten(self, step: np.ndarray, missing: np.ndarray) -> np.ndarray:
        r"""Shorten steps so that a posture changes along a straight line.

        All entries but velocities move by one share of what they miss,
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
        counts = ~self.mobile_only & (distance > 1e-12)
        shares = np.divide(size, distance, out=np.ones_like(size), where=counts)
        share = shares.min(axis=-1, keepdims=True, initial=1.0)
        return np.where(self.mobile_only, step, share * missing)

    def index(self, name: str) -> int:
        """Return the position of `name`.

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

        Entries that are `mobile_only` go to neutral, or as near as their `sway`, in stationary
        mode, also at their rate.

        Args:
            command: Wanted command. Shape (k,).
            previous: Command executed last, None for no rate limit. Shape (k,).
            dt: Time since then [s].
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
    """What one `send_action` asks of a robot.

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
    """How a `RobotAction` is laid out in LeRobot's flat action dictionary.

    Attributes:
        space: The command space.
        arm_names: Arm joints, then grippers, as the low-level policy takes them. Shape (m,).
    """

    space: CommandSpace
    arm_names: tuple[str, ...]

    @cached_property
    def keys(self) -> tuple[str, ...]:
        """Action keys in the order of the dataset's `action` column."""
        return (*self.space.keys, MODE_KEY, *(f"{name}.pos" for name in self.arm_names))

    def to_dict(self, action: RobotAction) -> dict[str, float]:
        """Return the flat dictionary of `action`."""
        values = (*action.command, float(action.mode), *action.arms)
        return {key: float(value) for key, value in zip(self.keys, values, strict=True)}

    def from_dict(self, values: Mapping[str, float], previous: RobotAction) -> RobotAction:
        """Read a flat, possibly partial dictionary; what is absent stays as in `previous`.

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
