"""A toy task for `xop-collect`, to be imported by its workers too: `--plugins collect_toy`."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np
import toy_robot  # noqa: F401  registers the robot

from xop_lerobot.operator.device import Device
from xop_lerobot.operator.devices import DEVICES
from xop_lerobot.operator.display import SeenObject
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.session import TaskStatus
from xop_lerobot.tasks.task import TASKS, Task


@TASKS.register("wait")
class Wait(Task):
    """Wait for as long as the draw says; over 0.3 s it is lost.

    The files that the environment names tell an episode to kill its worker or to take its time.
    """

    name = "wait"
    instruction = "wait for a moment"
    time_limit = 1.0

    def add_to(self, spec) -> None:
        body = spec.worldbody.add_body(name="mark", mocap=True)
        body.add_geom(type=2, size=(0.1, 0, 0), contype=0, conaffinity=0)

    def bind(self, plant) -> None:
        self._plant = plant

    def reset(self, rng) -> None:
        self._begin, self._wait = self._plant.time, rng.uniform(0.12, 0.48)
        self._plant.data.mocap_pos[0] = (1, rng.uniform(-0.3, 0.3), 0.4)

    def update(self) -> TaskStatus:
        waited = self._plant.time - self._begin
        if waited > 0.1:
            obey()
        over = waited >= self._wait
        lost = waited >= 0.3
        return TaskStatus(
            success=over and not lost, done=over or lost, failure="too long" if lost else ""
        )

    @property
    def objects(self):
        pose = np.array([*self._plant.data.mocap_pos[0], 1, 0, 0, 0])
        return {"mark": SeenObject(pose)}


def obey() -> None:
    """Do once what a test has asked for."""
    folder = os.environ.get("XOP_TEST_ORDERS")
    orders = [each for each in Path(folder).iterdir() if each.suffix != ".pid"] if folder else []
    for order in orders:
        try:
            order.rename(order.with_name(f"{os.getpid()}.pid"))
        except FileNotFoundError:  # another worker was first
            continue
        if order.name.startswith("die"):
            os.kill(os.getpid(), signal.SIGKILL)
        if order.name.startswith("raise"):
            raise RuntimeError("as the test asked for")
        time.sleep(60)


class Looker(Device):
    """A person who moves by what it sees, and by the episode."""

    self_engaging = True

    def __init__(self, config) -> None:
        self._seed, self._episode = config.seed, 0
        self._side = self._began = 0.0

    def begin_episode(self, index: int) -> None:
        self._episode = index

    def start(self, time: float) -> None:
        self._began = time
        self._rng = np.random.default_rng([self._seed, self._episode])

    def see(self, view) -> None:
        self._side = float(view.objects["mark"].pose[1])

    def read(self, time: float) -> OperatorFrame:
        clock = max(time - self._began, 0.0) if self._began else 0.0
        sway = self._rng.normal(0, 1e-3, 3) if self._began else np.zeros(3)
        head = np.array([0, 0, 1.6 - 0.1 * clock, 1, 0, 0, 0])
        head[:3] += sway
        hand = np.array([0.3, 0.2 + self._side, -0.4, 0, 0, 0, 0])
        return OperatorFrame(
            clock, head, head + hand, head + hand * [1, -1, 1, 1, 1, 1, 1],
            pinch=np.array([0.08, 0.08]),
        )  # fmt: skip


DEVICES.add("looker", Looker)
