"""Settings that can be changed from any thread while the robot is driven."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadValue
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.retarget.changes import (
    Change,
    Settings,
    apply_change,
    join_change,
    make_settings,
    split_change,
)
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.presets import build_configs


@dataclass(frozen=True)
class AppliedChange:
    """A change and where it came from.

    Attributes:
        source: Who asked for it: `control`, `key`, `gesture`, `device`, `call`.
        change: What was changed.
    """

    source: str
    change: Change

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON knows it."""
        return {"source": self.source, "change": self.change.to_dict()}


class ModeSwitch:
    """Mode that is asked for: the last one of who asked, be it a change, a gesture or the device.

    A device that states a mode in each frame, as recordings do, is heeded where it states another
    than when it was overruled.

    Args:
        mode: Mode to begin with.
    """

    def __init__(self, mode: Mode) -> None:
        self.mode = mode
        self._stated: Mode | None = None
        self._overruled: Mode | None = None

    def set(self, mode: Mode) -> None:
        """Overrule the device until it states another mode."""
        self.mode, self._overruled = mode, self._stated

    @property
    def other(self) -> Mode:
        """The mode that is not asked for."""
        return Mode(1 - self.mode)

    def toggle(self) -> None:
        """Change between the two modes, as a gesture does."""
        self.mode = self.other

    def follow(self, stated: Mode | None) -> None:
        """Take the mode that the device itself states, None if it states none."""
        if stated is not None and stated is not self._overruled:
            self.mode, self._overruled = stated, None
        self._stated = stated


class OnlineSettings:
    """Takes changes from any thread and hands them over, all at once, at the next tick.

    A change is checked against what will be in force when its turn comes, in the thread of who
    asks for it: it is refused there with the reason, and then changes nothing. What is accepted
    can't fail later.

    However often somebody asks, what waits for the tick does not grow: of each thing that can be
    changed (`split_change`) only what was asked for last is kept, with who asked. Applied in
    order, what `take` returns makes the same settings as all that was asked for.

    Args:
        morphology: The robot.
        config: Settings of the session.

    Raises:
        UnknownName: If `config` names a variant, target or part of the body that is not there.
    """

    def __init__(self, morphology: Morphology, config: RetargeterConfig) -> None:
        self._morphology, self._config = morphology, config
        self._turn = threading.Lock()  # held by who asks, while a change is checked
        self._lock = threading.Lock()  # held for an instant: the tick never waits for a check
        self._coming = self._current = make_settings(morphology, config)
        self._pending: dict[tuple[str, ...], tuple[int, str, Any]] = {}  # request, source, value
        self._count = 0

    @property
    def current(self) -> Settings:
        """What is in force."""
        with self._lock:
            return self._current

    @property
    def coming(self) -> Settings:
        """What will be in force at the next tick."""
        with self._lock:
            return self._coming

    def request(self, change: Change, source: str) -> Settings:
        """Ask for a change; returns what will be in force with it.

        Raises:
            UnknownName: If the robot has no such variant, target or part of the body.
            BadValue: If the result would not be valid.
        """
        return self.request_from(lambda _: change, source)

    def request_from(self, make: Callable[[Settings], Change], source: str) -> Settings:
        """Ask for a change that depends on what will be in force, as a toggle does.

        Raises:
            UnknownName: As `request`.
            BadValue: As `request`.
        """
        with self._turn:
            change = make(self._coming)
            if self._config.type != "mpc" and set(change.to_dict()) != {"mode"}:
                raise BadValue(
                    f"retargeter {self._config.type!r} has no presets, weights, targets or "
                    "constraints; its mode alone can be changed"
                )
            coming = apply_change(self._morphology, self._coming, change)
            build_configs(self._morphology, self._config, coming)
            with self._lock:
                self._coming = coming
                self._queue(change, source)
            return coming

    def _queue(self, change: Change, source: str) -> None:
        """Add a change to those that wait, less what it makes void."""
        self._count += 1
        for part, value in split_change(change).items():
            for void in [other for other in self._pending if _makes_void(part, other)]:
                del self._pending[void]
            self._pending[part] = (self._count, source, value)

    def take(self) -> tuple[AppliedChange, ...]:
        """Put into force what was asked for since the last call, and return it in order.

        What was asked for anew before it came into force is left out.
        """
        with self._lock:
            pending, self._pending = self._pending, {}
            self._current = self._coming
        requests: dict[tuple[int, str], dict[tuple[str, ...], Any]] = {}
        for part, (number, source, value) in pending.items():
            requests.setdefault((number, source), {})[part] = value
        return tuple(
            AppliedChange(source, join_change(parts)) for (_, source), parts in requests.items()
        )


def _makes_void(part: tuple[str, ...], other: tuple[str, ...]) -> bool:
    """Whether setting `part` leaves nothing of what was set of `other` before."""
    resets = {"preset": ("weights",), "variant": ("targets", "body")}
    return part == other or other[0] in resets.get(part[0], ())
