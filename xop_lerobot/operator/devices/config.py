"""Settings of operator devices, playback included."""

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
            ``"simulated"`` is a person who sees the robot and does its task, ``"avp"`` is
            somebody in an Apple Vision Pro, ``"webxr"`` in any headset that has a browser.
        path: `replay`: an ``.npz`` recording, or the directory of a recorded dataset.
            `scripted`: a YAML file, or the name of a script that is built in.
        mode: Mode in which the operator starts, ``"stationary"`` or ``"mobile"``, where the
            recording or script states none; None is stationary.
        episode: `replay` of a dataset: which episode.
        speed: Playback speed; 0.5 plays at half the speed.
        hold_s: How long the last frame is held after the end, before the device has
            finished [s].
        seed: `scripted`: seed of the person's sway and tremor; `simulated`: of the person.
        noise: `scripted`, `simulated`: scale of sway and tremor, 0 none, 1 as
            published for healthy people.
        host: `avp`: name or address of the headset. `webxr`: address of this machine at which
            it listens; None is 127.0.0.1, and 0.0.0.0 all of them.
        port: `avp`: its port; 0 is the one of its app, 12345. `webxr`: port at which it listens;
            0 is 8012.
        stale_s: `avp`, `webxr`: without a new pose of the head for so long, the operator has let
            go [s].
        tls: `webxr`: whether the page is served over TLS; None: unless it listens on loopback,
            where browsers ask for none.
        code: `webxr`: pairing code, at least 6 letters or digits; None makes one for each
            session.
        smoothing: `avp`, `webxr`: how much head and wrists are smoothed while they rest, 0 not
            at all (`OneEuro`).
        max_delay_s: `webxr`: frames that are older on their arrival are dropped, so that the
            operator lets go when all are [s].
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
        """Check every value.

        Raises:
            UnknownName: If `mode` is not a mode, with the known ones.
            BadValue: If a number is out of its range, with the range.
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
        """The mode in which the operator starts."""
        return Mode.STATIONARY if self.mode is None else Mode[self.mode.upper()]


def _check_at_least(name: str, value: float, low: float) -> None:
    if not (math.isfinite(value) and value >= low):
        raise BadValue(f"{name} must be finite and at least {low}, got {value}")
