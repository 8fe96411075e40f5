"""Thread-safe changes of the settings and of the mode while the robot is driven.

`OnlineSettings` validates changes in the requester's thread and applies them at the next tick;
`ModeSwitch` arbitrates the requested mode.
"""

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
    """A change and its source.

    Attributes:
        source: Source of the request: `control`, `key`, `gesture`, `device`, `call`.
        change: The change.
    """

    source: str
    change: Change

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-compatible dictionary."""
        return {"source": self.source, "change": self.change.to_dict()}


class ModeSwitch:
    """The requested mode: the latest request wins, be it a change, a gesture or the device.

    A device that reports a mode in every frame, as recordings do, would undo any other request at
    once. So after being overruled it is ignored until the mode that it reports changes.

    Args:
        mode: Initial mode.
    """

    def __init__(self, mode: Mode) -> None:
        self.mode = mode
        self._stated: Mode | None = None
        self._overruled: Mode | None = None

    def set(self, mode: Mode) -> None:
        """Overrule the device until it reports a different mode."""
        self.mode, self._overruled = mode, self._stated

    @property
    def other(self) -> Mode:
        """The mode that is not requested."""
        return Mode(1 - self.mode)

    def toggle(self) -> None:
        """Switch to the other mode, as a gesture does."""
        self.mode = self.other

    def follow(self, stated: Mode | None) -> None:
        """Take the mode that the device reports, None if it reports none."""
        if stated is not None and stated is not self._overruled:
            self.mode, self._overruled = stated, None
        self._stated = stated


class OnlineSettings:
    """Queue of changes from any thread, applied together at the next tick.

    A change is validated in the requester's thread, against the settings that will be in force
    when it is applied. An invalid one is rejected there and changes nothing; an accepted one
    cannot fail later.

    The queue is bounded, however often changes are requested: per setting (`split_change`) only
    the last request is kept, with its source. Applied in order, the changes that `take` returns
    give the same settings as all requests.

    Args:
        morphology: The robot.
        config: Settings of the session.

    Raises:
        UnknownName: If `config` names an unknown variant, target or part of the body.
    """

    def __init__(self, morphology: Morphology, config: RetargeterConfig) -> None:
        self._morphology, self._config = morphology, config
        self._turn = threading.Lock()  # serialises requests while they are validated
        self._lock = threading.Lock()  # held briefly: the tick never waits for a validation
        self._coming = self._current = make_settings(morphology, config)
        self._pending: dict[tuple[str, ...], tuple[int, str, Any]] = {}  # request, source, value
        self._count = 0

    @property
    def current(self) -> Settings:
        """Settings in force."""
        with self._lock:
            return self._current

    @property
    def coming(self) -> Settings:
        """Settings that will be in force at the next tick."""
        with self._lock:
            return self._coming

    def request(self, change: Change, source: str) -> Settings:
        """Request a change; returns the settings that will be in force with it.

        Raises:
            UnknownName: If the robot has no such variant, target or part of the body.
            BadValue: If the resulting settings would be invalid.
        """
        return self.request_from(lambda _: change, source)

    def request_from(self, make: Callable[[Settings], Change], source: str) -> Settings:
        """Request a change that depends on the coming settings, such as a toggle.

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
        """Append a change to the pending ones and drop those that it supersedes."""
        self._count += 1
        for part, value in split_change(change).items():
            for old in [other for other in self._pending if _supersedes(part, other)]:
                del self._pending[old]
            self._pending[part] = (self._count, source, value)

    def take(self) -> tuple[AppliedChange, ...]:
        """Apply the changes requested since the last call, and return them in order.

        Superseded requests are left out.
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


def _supersedes(part: tuple[str, ...], other: tuple[str, ...]) -> bool:
    """Whether setting `part` overrides an earlier setting of `other`."""
    resets = {"preset": ("weights",), "variant": ("targets", "body")}
    return part == other or other[0] in resets.get(part[0], ())
