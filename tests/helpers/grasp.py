"""A robot that stands still takes a box between its hands, by inverse kinematics of its arms."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from xop_lerobot.core.command import Mode, RobotAction
from xop_lerobot.core.state import Goal
from xop_lerobot.core.transforms import make_pose, quat_from_rpy, quat_rotate
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.retarget.arms.driver import ArmDriver
from xop_lerobot.tasks import furniture
from xop_lerobot.tasks.box_pick_and_place import BOX, SPOT, SUPPORT, BoxPickAndPlace
from xop_lerobot.tasks.stage import Stage

DT = 0.02
NO_TURN = np.array([1.0, 0, 0, 0])


@dataclass
class Log:
    """What happened, a row a control step."""

    box: list[np.ndarray] = field(default_factory=list)
    speed: list[float] = field(default_factory=list)
    touched: list[set[str]] = field(default_factory=list)
    effort: list[np.ndarray] = field(default_factory=list)


class Grasp:
    """Stands before the support, the box where its palms are at rest.

    Args:
        robot: Its name.
        policy: Its low-level policy, the robot's own by default.
        press: How far the palms' goals are inside the box [m]; the task's hint by default.
        ahead: The box is so much farther than the palms at rest [m].
    """

    def __init__(
        self, robot: str, policy: str = "", press: float | None = None, ahead: float = 0.03
    ) -> None:
        self.morphology = make_morphology(robot)
        self.stage = Stage(self.morphology, "box_pick_and_place")
        self.loop = PolicyLoop(
            self.morphology, self.stage.plant, make_policy(policy or self.morphology.policies[0])
        )
        self.driver = ArmDriver(self.morphology)
        task = self.stage.task
        assert isinstance(task, BoxPickAndPlace)
        self.task, self.hints = task, task.hints
        self.press = self.hints["press"] if press is None else press
        self.loop.reset(0)
        self.stage.reset(0)
        self._put_support(ahead)
        self.log = Log()
        self.goals = {
            side: self.stage.plant.get_site_pose(f"{side}_palm") for side in ("left", "right")
        }
        plant = self.stage.plant
        self.to_wrist = {}
        for side in ("left", "right"):
            palm, wrist = (plant.get_site_pose(f"{side}_{part}") for part in ("palm", "wrist"))
            reach = np.linalg.norm(palm[:3] - wrist[:3])
            self.to_wrist[side] = np.array([-reach, 0, 0])
            if robot == "g1":  # the palm's site is beside the wrist's axis
                self.to_wrist[side] = np.array([-0.1, 0, 0.013])

    def _put_support(self, ahead: float) -> None:
        task, plant = self.task, self.stage.plant
        self.middle = np.array([task.reach.forward + ahead, 0, task.reach.height])
        top = self.middle - [0, 0, BOX[2]] + [SUPPORT[0] - BOX[0] - SPOT, 0, 0]
        furniture.place(plant, "support", top, NO_TURN)
        plant.set_object_pose("box", make_pose(self.middle, NO_TURN))
        plant.rearrange()
        task._rest = self.middle[2]

    def _step(self) -> None:
        state = self.loop.state
        wrists = {}
        for side, goal in self.goals.items():
            wrist = goal[:3] + quat_rotate(goal[3:], self.to_wrist[side])
            wrists[f"{side}_wrist"] = make_pose(wrist, goal[3:])
        head = self.stage.plant.get_site_pose("head")
        arms = self.driver.compute(state, Goal({"head": head, **wrists}), head, {}, DT)
        command = self.morphology.command_space.neutral
        action = self.loop.execute(RobotAction(command, Mode.STATIONARY, arms), DT)
        self.driver.note(action.arms)
        self.stage.update()
        plant, task = self.stage.plant, self.task
        self.log.box.append(plant.get_object_pose("box"))
        self.log.speed.append(self.stage.status.figures["speed_m_s"])
        self.log.touched.append(task._touching.find())
        self.log.effort.append(plant.data.actuator_force.copy())

    def move(self, gap: float, lift: float, seconds: float) -> None:
        """Palms to `gap` from the box's sides (negative: inside), the box's middle up by `lift`."""
        begin = {side: goal.copy() for side, goal in self.goals.items()}
        steps = round(seconds / DT)
        for i in range(steps):
            s = (i + 1) / steps
            s = s**3 * (10 - 15 * s + 6 * s * s)
            for side, sign in (("left", 1), ("right", -1)):
                out = BOX[1] + self.hints["palm_outside"] + gap
                end = self.middle + [self.hints["palm_forward"], sign * out, lift]
                position = begin[side][:3] * (1 - s) + s * end
                # Rolled by a quarter turn the thumb is up and the palm faces inwards.
                self.goals[side] = make_pose(position, quat_from_rpy(-sign * np.pi / 2, 0, 0))
            self._step()

    def take(self, lift: float = 0.08, hold_s: float = 5.0) -> Log:
        """Approach from both sides, press, lift, hold."""
        self.move(0.06, 0.0, 2.0)
        self.move(-self.press, 0.0, 1.0)
        self.move(-self.press, 0.0, 0.5)
        self.move(-self.press, lift, 1.5)
        self.move(-self.press, lift, hold_s)
        return self.log
