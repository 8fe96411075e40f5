"""A robot driven through a headset's stream in lock-step, for tests of what goes wrong with it.

Real messages over a real connection; the stamps come from a clock that moves with the messages,
so that every run is the same however slow the machine is.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from avp_server import wait_for

from xop_lerobot.core.command import RobotAction
from xop_lerobot.core.state import Goal
from xop_lerobot.core.transforms import make_pose, quat_exp, quat_multiply
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.operator.devices import DeviceConfig
from xop_lerobot.operator.devices.live import LiveDevice
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.plant.config import SimulationConfig
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.plant.simulation import Simulation
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.session import RobotInfo, Tick
from xop_lerobot.teleoperation import Teleoperation, TeleoperationConfig

POLICIES = {"g1": "default", "rby1": "diff_drive"}
FPS, RATE = 25, 50
RETARGETER = os.environ.get("XOP_TEST_RETARGETER", "direct")
"""`mpc` takes minutes for what takes seconds; it is run by hand."""
UP = quat_exp(np.array([np.pi, 0, 0]))

M = TypeVar("M")
"""What a fault may put on the wire, frames beside."""
Fault = Callable[[float, OperatorFrame], list[OperatorFrame | M]]


def make_person(t: float, gesture: bool) -> OperatorFrame:
    """Somebody who sways a little, squats a little, and moves the hands."""
    sway = 0.004 * np.array([np.sin(3 * t), np.cos(2 * t), np.sin(5 * t)])
    quat = quat_exp(sway)
    reach = 0.0 if gesture else 0.05 * np.sin(1.5 * t)
    hand = quat_multiply(quat, UP) if gesture else quat
    wrists = [make_pose(sway + [0.3 + reach, y, 1.15], hand) for y in (0.2, -0.2)]
    head = make_pose(sway + [0, 0, 1.6], quat)
    return OperatorFrame(t, head, *wrists, pinch=np.full(2, 0.008 if gesture else 0.07))


def pass_on(t: float, frame: OperatorFrame) -> list[OperatorFrame]:
    del t
    return [frame]


def get_goal(record: Tick) -> Goal:
    """The goal of a tick in which the operator drives."""
    assert record.goal is not None
    return record.goal


class Rig:
    """Headset, connection, teleoperation and robot; `run` lets time pass, message by message.

    Args:
        name: Morphology of the robot.
        config: The device.
        send: Puts a frame, or what a fault has made, on the wire.
    """

    def __init__(self, name: str, config: DeviceConfig, send: Callable[..., None]) -> None:
        self._send, self.now, self.sent = send, 0.0, 0
        morphology = make_morphology(name)
        self.morphology = morphology
        plant = Simulation(morphology, SimulationConfig(), kind="planning")
        self.loop = PolicyLoop(morphology, plant, make_policy(POLICIES[name]))
        info = RobotInfo(f"xop_{name}", morphology, POLICIES[name], None, "empty", FPS, 0)
        retargeter = RetargeterConfig(type=RETARGETER)
        self.teleop = Teleoperation(TeleoperationConfig(device=config, retargeter=retargeter), info)
        device = self.teleop.device
        assert isinstance(device, LiveDevice)
        self.device = device
        device.clock = lambda: self.now
        self.teleop.connect()
        self.loop.reset(seed=0, settle_s=0.8)
        self.ticks: list[tuple[RobotAction, Tick]] = []
        self.notices: list[str] = []
        self.troubles: list[str] = []

    def run(self, seconds: float, fault: Fault = pass_on, gesture: bool = False) -> None:
        start = self.now
        for i in range(round(seconds * FPS)):
            for k in range(RATE // FPS):
                self.now = start + i / FPS + (k + 1) / RATE
                for message in fault(self.now - start, make_person(self.now, gesture)):
                    self.now += 1e-5  # no two messages come at once
                    self._send(message)
                    self.sent += 1
                    wait_for(lambda: self.device.handled >= self.sent)
            action, record = self.teleop.step(Tick(self.loop.state))
            self.loop.execute(action, 1 / FPS)
            self.ticks.append((action, record))
            self.notices.append(self.teleop.notice)
            self.troubles.append(self.device.trouble)

    def engage(self) -> None:
        self.run(0.8)  # after a jump, until head and then open hands are believed
        self.run(1.6, gesture=True)  # to turn the hands over counts as a jump
        assert self.is_engaged, self.teleop.notice
        self.run(0.4)

    @property
    def is_engaged(self) -> bool:
        return self.ticks[-1][1].engaged

    def compute_head(self) -> np.ndarray:
        """Pose of the robot's head. Shape (7,)."""
        poses = self.teleop._kinematics.compute_poses(self.loop.state.true_qpos)
        return poses[self.morphology.frames["head"]]

    def compute_largest_steps(self, since: int = 0) -> tuple[float, float]:
        """Largest step of a command against its rate limit, and of an arm joint [rad]."""
        commands = np.array([action.command for action, _ in self.ticks[since:]])
        limit = self.teleop.morphology.command_space.max_rate / FPS
        num_joints = self.teleop._arms.ik.num_joints
        arms = np.array([action.arms for action, _ in self.ticks[since:]])[:, :num_joints]
        steps = np.abs(np.diff(commands, axis=0)) / limit
        return float(steps.max()), float(np.abs(np.diff(arms, axis=0)).max())

    def check(self) -> None:
        """No command above its rate limit, no arm faster than arms are, no fall."""
        assert not self.loop.state.fallen
        command, arms = self.compute_largest_steps()
        assert command <= 1 + 1e-5
        assert arms <= 3.0 / FPS + 1e-6

    def close(self) -> None:
        self.teleop.disconnect()
        self.loop.close()

    def assert_left_arm_stood(self, ticks: slice) -> None:
        """The left hand's goal stood still beside the head, while the right one's moved."""
        poses = [get_goal(record).poses for _, record in self.ticks[ticks]]
        spans = {}
        for name in ("left_wrist", "right_wrist"):
            offsets = np.array([each[name][:3] - each["head"][:3] for each in poses])
            spans[name] = np.ptp(offsets, axis=0).max()
        assert spans["left_wrist"] < 0.01  # it turns with the head
        assert spans["right_wrist"] > 0.03
