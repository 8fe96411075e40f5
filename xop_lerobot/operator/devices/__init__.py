"""Devices by name: `make_device(DeviceConfig(type="replay", path="recording.npz"))`."""

from __future__ import annotations

from collections.abc import Callable

from xop_lerobot.core.registry import Registry
from xop_lerobot.operator.device import Device
from xop_lerobot.operator.devices.config import DeviceConfig

DEVICES: Registry[Callable[[DeviceConfig], Device]] = Registry("device")
"""Devices by name, each made as ``factory(config)``."""


@DEVICES.register("avp")
def _make_avp(config: DeviceConfig) -> Device:
    # gRPC starts threads of its own; who needs no headset shall not have them.
    from xop_lerobot.operator.devices.avp import AvpDevice  # noqa: PLC0415

    return AvpDevice(config)


@DEVICES.register("webxr")
def _make_webxr(config: DeviceConfig) -> Device:
    from xop_lerobot.operator.devices.webxr import WebXrDevice  # noqa: PLC0415

    return WebXrDevice(config)


def make_device(config: DeviceConfig) -> Device:
    """Make the device that `config` names; `connect()` then opens it.

    Raises:
        UnknownName: Listing the available devices.
        BadValue: If a setting is out of its range, or one that the device needs is absent.
    """
    # Implementations register themselves when they are imported.
    from xop_lerobot.operator.devices import replay, scripted, simulated  # noqa: F401, PLC0415

    return DEVICES[config.type](config)


__all__ = ["DEVICES", "DeviceConfig", "make_device"]
