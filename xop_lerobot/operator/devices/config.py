"""Settings of operator devices."""

from __future__ import annotations

import math
from dataclasses import dataclass

from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.yaml_words import fill_nulls


@dataclass
class DeviceConfig:
    """Settings of an operator device.

    Attributes:
        type: ``"replay"`` plays a recorded person, ``"scripted"`` a list of waypoints,
            ``"simulated"`` is a person who watches the robot and performs its task, ``"avp"`` is a
            person with an Apple Vision Pro, ``"webxr"`` with any headset that has a browser.
        path: `replay`: an ``.npz`` recording, or the directory of a recorded dataset. `scripted`: a
            YAML file, or the name of a built-in script.
        mode: Initial mode, ``"stationary"`` or ``"mobile"``, if the recording or script states
            none; None is stationary.
        episode: `replay` of a dataset: index of the episode.
        speed: Playback speed; 0.5 is half speed.
        hold_s: Time the last frame is held before the device is finished [s].
        seed: `scripted`: seed of sway and tremor; `simulated`: of the person.
        noise: `scripted`, `simulated`: scale of sway and tremor; 0 is none, 1 as published for
            healthy people.
        host: `avp`: name or address of the headset. `webxr`: address of this machine to listen at;
            None is 127.0.0.1, and 0.0.0.0 is all addresses.
        port: `avp`: port of the app; 0 is 12345. `webxr`: port to listen at; 0 is 8012.
        stale_s: `avp`, `webxr`: time without a new head pose after which the operator is disengaged
            [s].
        tls: `webxr`: whether the page is served over TLS; None: unless it listens on loopback,
            where browsers do not require it.
        code: `webxr`: pairing code, at least 6 letters or digits; None generates one per session.
        smoothing: `avp`, `webxr`: strength of smoothing head and wrists at rest; 0 is none
            (`OneEuro`).
        max_delay_s: `webxr`: delay above which frames are dropped on arrival; if all are, the
            operator is disengaged [s].
    """

    type: str = "scripted"
    path: str | None = None
    mode: str | None = None
    episode: int = 0
    speed: float = 1.0
    hold_s: float = 6.0
    seed: int = 0
    noise: float = 1.0
    host: str | None = None
    port: int = 0
    stale_s: float = 0.25
    tls: bool | None = None
    code: str | None = None
    max_delay_s: float = 0.3
    smoothing: float = 1.0

    def __post_init__(self) -> None:
        """Validate all values.

        Raises:
            UnknownName: If `mode` is not a mode, listing the known ones.
            BadValue: If a number is out of its range.
        """
        fill_nulls(self)
        if self.mode is not None and self.mode.upper() not in Mode.__members__:
            raise UnknownName("device.mode", self.mode, (name.lower() for name in Mode.__members__))
        _check_at_least("device.episode", self.episode, 0)
        _check_at_least("device.hold_s", self.hold_s, 0)
        _check_at_least("device.noise", self.noise, 0)
        _check_at_least("device.seed", self.seed, 0)
        _check_at_least("device.port", self.port, 0)
        _check_at_least("device.smoothing", self.smoothing, 0)
        for name in ("stale_s", "max_delay_s", "speed"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise BadValue(f"device.{name} must be finite and above 0, got {value}")

    @property
    def start_mode(self) -> Mode:
        """Initial mode of the operator."""
        return Mode.STATIONARY if self.mode is None else Mode[self.mode.upper()]


def _check_at_least(name: str, value: float, low: float) -> None:
    if not (math.isfinite(value) and value >= low):
        raise BadValue(f"{name} must be finite and at least {low}, got {value}")
