"""A robot without physics that does what the operator does, late, and with a drift if asked to."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.transforms import (
    compute_heading,
    interpolate_poses,
    make_pose,
    pose_inverse,
    pose_multiply,
    quat_from_yaw,
)
from xop_lerobot.operator.alignment import Alignment
from xop_lerobot.operator.device import Device
from xop_lerobot.operator.display import SeenObject, View
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.gestures import Gesture, GestureReader

DT = 0.04
PALM = np.array([0.1, 0, 0, 1, 0, 0, 0])
IDENTITY = np.array([1.0, 0, 0, 0])


def make_body(head_height: float = 1.21) -> dict[str, np.ndarray]:
    """Head, wrists and palms of a robot that stands at the origin. Shapes (7,)."""
    head = make_pose(np.array([0, 0, head_height]), IDENTITY)
    wrists = {
        f"{side}_wrist": make_pose(np.array([0.15, y, head_height - 0.42]), IDENTITY)
        for side, y in (("left", 0.18), ("right", -0.18))
    }
    palms = {
        f"{side}_palm": pose_multiply(wrists[f"{side}_wrist"], PALM) for side in ("left", "right")
    }
    return {"head": head, **wrists, **palms}


@dataclass
class ToyWorld:
    """Frames go to their goals within `lag`; a standing robot's feet stay.

    Attributes:
        objects: What is there to be seen.
        lag: Time constant of all frames [s].
        drift: Velocity of the ground under a robot in mobile mode [m/s].
        deaf: How many gestures are not understood.
        slide: Displacement of the robot each time it comes to stand [m].
    """

    objects: dict[str, SeenObject]
    lag: float = 0.3
    drift: tuple[float, float] = (0.0, 0.0)
    deaf: int = 0
    slide: tuple[float, float] = (0.0, 0.0)
    task: str = "dual_point_touch"
    time: float = 0.0
    mode: Mode = Mode.STATIONARY
    success: bool = False
    frames: dict[str, np.ndarray] = field(default_factory=make_body)
    history: list[OperatorFrame] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._alignment, self._gestures = Alignment(), GestureReader()
        self._drifted = np.zeros(3)

    def palm(self, side: str) -> np.ndarray:
        """Pose of a palm. Shape (7,)."""
        return pose_multiply(self.frames[f"{side}_wrist"], PALM)

    def view(self) -> View:
        """What a headset shows."""
        palms = {f"{side}_palm": self.palm(side) for side in ("left", "right")}
        frames = {**self.frames, **palms}
        return View(
            self.time, self.task, frames, self.objects, self.mode, True, success=self.success
        )

    def step(self, device: Device) -> OperatorFrame:
        """Show, read and follow for one tick."""
        device.see(self.view())
        if not self.history:
            device.start(self.time)
        frame = device.read(self.time)
        assert frame is not None
        if not self.history:
            self._alignment.engage(frame, self.frames, float(self.frames["head"][2]))
        self.history.append(frame)
        if self._gestures.update(frame) is Gesture.DOUBLE_PINCH:
            if self.deaf:
                self.deaf -= 1
            else:
                self.mode = Mode(1 - self.mode)
                if self.mode is Mode.STATIONARY:
                    self._drifted[:2] += self.slide
                    step = np.array([*self.slide, 0, 0, 0, 0, 0])
                    self.frames = {name: pose + step for name, pose in self.frames.items()}
        self._follow(self._alignment.goal_poses(frame))
        self.time += DT
        return frame

    def _follow(self, goals: dict[str, np.ndarray]) -> None:
        share = 1 - np.exp(-DT / self.lag)
        if self.mode is Mode.MOBILE:
            self._drifted[:2] += DT * np.array(self.drift)
        else:
            # Only a walking robot gets far.
            reach = goals["head"][:2] + self._drifted[:2] - self.frames["head"][:2]
            excess = max(0.0, 1 - 0.15 / max(float(np.linalg.norm(reach)), 1e-9))
            self._drifted[:2] -= excess * reach
        for name, goal in goals.items():
            aim = goal.copy()
            aim[:3] += self._drifted
            self.frames[name] = interpolate_poses(self.frames[name], aim, share)


def level(pose: np.ndarray) -> np.ndarray:
    """Place and heading of a pose. Shape (7,)."""
    return make_pose(pose[:3], quat_from_yaw(compute_heading(pose[3:])))


__all__ = ["DT", "ToyWorld", "level", "make_body", "pose_inverse"]
