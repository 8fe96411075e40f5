"""Settings that can be changed from any thread while the robot is driven."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from xop_lerobot.errors import BadValue
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.retarget.changes import Change, Settings, apply_change, make_settings
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


class OnlineSettings:
    """Takes changes from any thread and hands them over, all at once, at the next tick.

    A change is checked against what will be in force when its turn comes, in the thread of who
    asks for it: it is refused there with the reason, and then changes nothing. What is accepted
    can't fail later.

    Args:
        morphology: The robot.
        config: Settings of the session.

    Raises:
        UnknownName: If `config` names a variant, target or part of the body that is not there.
    """

    def __init__(self, morphology: Morphology, config: RetargeterConfig) -> None:
        self._morphology, self._config = morphology, config
        self._lock = threading.Lock()
        self._coming = self._current = make_settings(morphology, config)
        self._pending: list[AppliedChange] = []

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
        with self._lock:
            change = make(self._coming)
            if self._config.type != "mpc" and set(change.to_dict()) != {"mode"}:
                raise BadValue(
                    f"retargeter {self._config.type!r} has no presets, weights, targets or "
                    "constraints; its mode alone can be changed"
                )
            coming = apply_change(self._morphology, self._coming, change)
            build_configs(self._morphology, self._config, coming)
            self._coming = coming
            self._pending.append(AppliedChange(source, change))
            return coming

    def take(self) -> tuple[AppliedChange, ...]:
        """Put into force what was asked for since the last call, and return it in order."""
        with self._lock:
            taken, self._pending = tuple(self._pending), []
            self._current = self._coming
            return taken
