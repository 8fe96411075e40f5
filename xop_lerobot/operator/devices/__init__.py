"""Devices by name: `make_device(DeviceConfig(type="replay", path="recording.npz"))`."""

from __future__ import annotations

from collections.abc import Callable

from xop_lerobot.core.registry import Registry
from xop_lerobot.operator.device import Device
from xop_lerobot.operator.devices.config import DeviceConfig

DEVICES: Registry[Callable[[DeviceConfig], Device]] = Registry(
    "device",
    {
        "avp": "xop_lerobot.operator.devices.avp:AvpDevice",
        "replay": "xop_lerobot.operator.devices.replay:ReplayDevice",
        "scripted": "xop_lerobot.operator.devices.scripted:ScriptedDevice",
        "simulated": "xop_lerobot.tasks.person.device:SimulatedDevice",
        "webxr": "xop_lerobot.operator.devices.webxr:WebXrDevice",
    },
)
"""Factories of devices by name, called as ``factory(config)``."""


def make_device(config: DeviceConfig) -> Device:
    """Make the device that `config` names; `connect()` then opens it.

    Raises:
        UnknownName: Listing the available devices.
        BadValue: If a setting is out of its range, or a required one is missing.
    """
    return DEVICES[config.type](config)


__all__ = ["DEVICES", "DeviceConfig", "make_device"]
