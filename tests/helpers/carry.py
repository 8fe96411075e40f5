"""A robot that stands still carries the toy over the obstacle and lets it slide into the box."""

from __future__ import annotations

import math

import numpy as np

from xop_lerobot.core.command import Mode, RobotAction
from xop_lerobot.core.state import Goal
from xop_lerobot.core.transforms import (
    make_pose,
    pose_inverse,
    pose_multiply,
    quat_from_rpy,
    quat_multiply,
)
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.retarget.arms.driver import ArmDriver
from xop_lerobot.tasks.non_prehensile_transport import NonPrehensileTransport
from xop_lerobot.tasks.palm import PALM_UP
from xop_lerobot.tasks.stage import Stage

DT = 0.02


class Carry:
    """Drives the left palm through waypoints; the right arm stays.

    Args:
        robot: Its name.
        seed: Of the placement.
    """

    def __init__(self, robot: str, seed: int = 0) -> None:
        self.morphology = make_morphology(robot)
        self.stage = Stage(self.morphology, "non_prehensile_transport")
        policy = make_policy(self.morphology.policies[0])
        self.loop = PolicyLoop(self.morphology, self.stage.plant, policy)
        self.driver = ArmDriver(self.morphology)
        self.loop.reset(seed, start=self.stage.start)
        self.stage.reset(seed)
        plant = self.stage.plant
        poses = {name: plant.get_site_pose(f"left_{name}") for name in ("palm", "wrist")}
        self.wrist_in_palm = pose_multiply(pose_inverse(poses["palm"]), poses["wrist"])
        self.right = plant.get_site_pose("right_wrist")
        self.position = poses["palm"][:3].copy()
        self.roll = 0.0
        self.figures: list[dict[str, float]] = []
        self.last_toy = plant.get_object_pose("toy")

    def move(self, position: np.ndarray, seconds: float, roll: float = 0.0) -> None:
        """Palm to `position` [m], rolled to the right by `roll` [rad], by minimum jerk."""
        begin, begin_roll = self.position.copy(), self.roll
        steps = round(seconds / DT)
        for i in range(steps):
            s = (i + 1) / steps
            s = s**3 * (10 - 15 * s + 6 * s * s)
            self.position = begin * (1 - s) + s * np.asarray(position)
            self.roll = begin_roll * (1 - s) + s * roll
            self._step()

    def _step(self) -> None:
        state = self.loop.state
        turn = quat_multiply(quat_from_rpy(self.roll, 0, 0), PALM_UP)
        wrist = pose_multiply(make_pose(self.position, turn), self.wrist_in_palm)
        head = self.stage.plant.get_site_pose("head")
        goal = Goal({"head": head, "left_wrist": wrist, "right_wrist": self.right})
        arms = self.driver.compute(state, goal, head, {}, DT)
        command = self.morphology.command_space.neutral
        action = self.loop.execute(RobotAction(command, Mode.STATIONARY, arms), DT)
        self.driver.note(action.arms)
        self.figures.append(dict(self.stage.update().figures))

    def deliver(self) -> None:
        """Level, over the obstacle, beside the opening, roll."""
        task = self.stage.task
        assert isinstance(task, NonPrehensileTransport)
        seen, hints = task.objects, task.hints
        opening, obstacle = seen["opening"].pose[:3], seen["obstacle_0"]
        over = obstacle.pose[2] + obstacle.size[2] + 0.09
        start = task.start_palm
        self.move(start, 1.0)
        self.move(start, 4.0)
        self.move(np.array([start[0], start[1], over]), 1.5)
        beside = opening + [-hints["toy_forward"], hints["edge"] + 0.01, 0.0]
        self.move(np.array([beside[0], beside[1], over]), 3.0)
        self.move(beside + [0, 0, 0.08 - hints["toy_over"] + 0.03], 1.5)
        self.move(self.position, 0.5)
        self.move(self.position, 1.2, math.radians(50))
        self.move(self.position, 1.5, math.radians(50))
