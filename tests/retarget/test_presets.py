"""Presets in closed loop: conservative is smoother and slower, aggressive faster and rougher."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from tests.test_teleoperation import Person, Rig, make_frame
from xop_lerobot.core.command import Mode
from xop_lerobot.operator.devices import DEVICES
from xop_lerobot.retarget.config import RetargeterConfig

pytestmark = pytest.mark.slow

STEPS = {  # where the person's head goes, and its heading
    Mode.STATIONARY: ((0.03, 0.0, -0.12), 0.4),
    Mode.MOBILE: ((0.7, 0.2, 0.0), 0.3),
}


@functools.cache
def follow(robot: str, mode: Mode, preset: str) -> dict[str, float]:
    """How fast and how smoothly a robot follows a head that goes somewhere within 0.3 s."""
    DEVICES.add("person", Person)
    try:
        rig = Rig(robot, retargeter=RetargeterConfig(threads=1, preset=preset))
    finally:
        DEVICES.remove("person")
    begin = rig.loop.state.time + 0.2
    offset, yaw = STEPS[mode]

    def motion(t: float):
        share = np.clip((t - begin) / 0.3, 0, 1)
        head = np.array([0, 0, 1.7]) + share * np.array(offset)
        return make_frame(t, tuple(head), share * yaw, mode=mode)

    rig.person.motion = motion
    rig.run(0.2)
    commands, heads = [], []
    for _ in range(45):
        action, _ = rig.tick()
        commands.append(action.command)
        heads.append(rig.frames["head"][:3])
    space = rig.morphology.command_space
    rates = np.diff(commands, axis=0) / ((space.high - space.low) / 2) / rig.dt
    heads = np.array(heads)
    # Over 0.2 s: the head of a walking robot bobs.
    speeds = np.linalg.norm(heads[5:] - heads[:-5], axis=1) / (5 * rig.dt)
    covered = np.linalg.norm(heads[20:26, :2] - heads[0, :2], axis=1)
    rig.close()
    return {
        "rate": float(np.sqrt(np.square(rates).sum(axis=1).mean())),
        "jerk": float(np.sqrt(np.square(np.diff(rates, axis=0)).sum(axis=1).mean())) / rig.dt,
        # Far away, all hurry at first: how far it is after a second tells them apart.
        "speed": float(covered.mean() if mode is Mode.MOBILE else speeds.max()),
    }


@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize("robot", ["g1", "rby1"])
def test_conservative_is_smoother_and_slower_than_aggressive(robot, mode):
    calm, plain, hasty = (
        follow(robot, mode, preset) for preset in ("conservative", "default", "aggressive")
    )
    print(robot, mode.name, calm, plain, hasty)
    assert calm["rate"] < 0.85 * hasty["rate"]
    assert calm["rate"] < 0.9 * plain["rate"]
    assert calm["jerk"] < 0.9 * hasty["jerk"]
    assert calm["speed"] < 0.97 * hasty["speed"]
