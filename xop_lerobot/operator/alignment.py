"""Alignment: maps the operator's motion into the robot's world, from engagement on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from xop_lerobot.core.errors import BadShape, BadValue, UnknownName, XopError
from xop_lerobot.core.state import FRAMES
from xop_lerobot.core.transforms import (
    compute_heading,
    level_pose,
    make_pose,
    pose_inverse,
    pose_multiply,
    quat_conjugate,
    quat_from_yaw,
    quat_multiply,
    quat_rotate,
)
from xop_lerobot.core.yaml_words import fill_nulls
from xop_lerobot.operator.frame import OperatorFrame

MIN_OPERATOR_HEIGHT = 0.5
"""Head height below which the device's origin cannot be the floor [m]."""
SCALES = ("height_scale", "reach_scale", "walk_scale")
LENGTHS = ("eye_height", "arm_reach")


class EngageRefused(XopError):
    """The operator cannot engage now; the message gives the reason."""


class NotEngaged(XopError):
    """Goals were requested while no operator is engaged."""

    def __init__(self) -> None:
        super().__init__("the operator is not engaged. Call engage() first.")


@dataclass
class AlignmentConfig:
    """Scales from the operator's motion to the robot's.

    Attributes:
        height_scale: Ratio of robot to operator change of head height; None for the ratio of their
            head heights.
        reach_scale: Ratio of robot to operator distance from head to wrist; None for the ratio of
            their reaches if the operator's is known, else for the height scale.
        eye_height: The operator's head height, upright [m]; None to measure it at engage. Set by
            calibration.
        arm_reach: Horizontal distance from the operator's head to the wrists, arms stretched
            forward [m]; None if unknown. Set by calibration.
        walk_scale: Ratio of robot to operator horizontal travel.
        frames: Frames with a goal; the head is used for alignment in any case.
    """

    height_scale: float | None = None
    reach_scale: float | None = None
    walk_scale: float = 1.0
    eye_height: float | None = None
    arm_reach: float | None = None
    frames: tuple[str, ...] = FRAMES

    def __post_init__(self) -> None:
        """Validate all values.

        Raises:
            BadValue: If a scale or length is not a finite number above 0, or there is no frame.
            UnknownName: If a frame is unknown, listing the known ones.
        """
        fill_nulls(self)
        for name in (*SCALES, *LENGTHS):
            scale = getattr(self, name)
            if scale is not None and not (math.isfinite(scale) and scale > 0):
                raise BadValue(f"alignment.{name} must be finite and above 0, got {scale}")
        self.frames = tuple(self.frames)
        if not self.frames:
            raise BadValue(f"alignment.frames must name at least one of {', '.join(FRAMES)}")
        for name in self.frames:
            if name not in FRAMES:
                raise UnknownName("alignment frame", name, FRAMES)


def is_lost(frame: OperatorFrame) -> bool:
    """Whether the head is not tracked, which ends an engagement."""
    return not bool(frame.tracked[0])


@dataclass(frozen=True)
class _Anchor:
    """Measurements at engage.

    Attributes:
        operator: Head of the operator. Shape (7,).
        robot: Head of the robot. Shape (7,).
        turn: A = Rz(heading of the robot's head − heading of the operator's). Shape (4,).
        height_scale: Scale of heights.
        reach_scale: Scale of reaches.
    """

    operator: np.ndarray
    robot: np.ndarray
    turn: np.ndarray
    height_scale: float
    reach_scale: float


class Alignment:
    r"""Aligns the operator's head and heading with the robot's at engage, and follows from there.

    With A the rotation about the vertical that aligns the headings, ₀ the values at engage, ``o``
    the operator and ``r`` the robot:

    - head: :math:`p_{xy} = r_{0,xy} + s_{walk} A (o - o_0)_{xy}`,
      :math:`p_z = r_{0,z} + s_{height} (o - o_0)_z`,
      :math:`R = A R_o R_{o,0}^T A^T R_{r,0}`, so that engaging makes no step;
    - wrists: :math:`p = p_{head} + s_{reach} A (o_{wrist} - o_{head})`, :math:`R = A R_o`: hands
      keep their place from the head, and their frames are the same in person and robot.

    Rotating or moving the operator's world changes no goal. An untracked wrist keeps its place
    relative to the head, along its heading.

    Args:
        config: Scales, and the frames with a goal.
    """

    def __init__(self, config: AlignmentConfig | None = None) -> None:
        self.config = config or AlignmentConfig()
        self._anchor: _Anchor | None = None
        self._goals: dict[str, np.ndarray] = {}
        self._from_head: dict[str, np.ndarray] = {}

    @property
    def is_engaged(self) -> bool:
        """Whether the operator is engaged."""
        return self._anchor is not None

    @property
    def scales(self) -> dict[str, float]:
        """The scales in use by name.

        Raises:
            NotEngaged: Before `engage`.
        """
        anchor = self._check_engaged()
        values = (anchor.height_scale, anchor.reach_scale, self.config.walk_scale)
        return dict(zip(SCALES, values, strict=True))

    def engage(
        self,
        frame: OperatorFrame,
        robot_frames: Mapping[str, np.ndarray],
        robot_head_height: float,
        robot_reach: float | None = None,
    ) -> None:
        """Align the operator's head and heading with the robot's, as measured now.

        Args:
            frame: The operator's frame.
            robot_frames: Poses of the head and of every frame of the config, robot world. Shapes
                (7,).
            robot_head_height: Height of the robot's head above the ground [m].
            robot_reach: Horizontal distance from the robot's head to its wrists, arms stretched
                forward [m]; None if unknown.

        Raises:
            EngageRefused: If the head is not tracked, or is too close to the floor.
            UnknownName: If `robot_frames` lacks a frame.
        """
        if is_lost(frame):
            raise EngageRefused("cannot engage: the operator's head is not tracked")
        robot = {name: _get_pose(robot_frames, name) for name in {"head", *self.config.frames}}
        height_scale = self._measure_height_scale(frame, robot_head_height)
        heading = compute_heading(robot["head"][3:]) - compute_heading(frame.head[3:])
        self._anchor = _Anchor(
            operator=np.array(frame.head, dtype=float),
            robot=robot["head"],
            turn=quat_from_yaw(heading),
            height_scale=height_scale,
            reach_scale=self._find_reach_scale(robot_reach) or height_scale,
        )
        # The goal of a wrist not seen yet is the robot's present one.
        body = pose_inverse(level_pose(robot["head"]))
        self._from_head = {
            name: pose_multiply(body, robot[name]) for name in self.config.frames if name != "head"
        }
        self._goals = {}
        self.goal_poses(frame)

    def disengage(self) -> None:
        """Discard the alignment; the next `engage` makes a new one."""
        self._anchor = None
        self._goals, self._from_head = {}, {}

    def goal_poses(self, frame: OperatorFrame) -> dict[str, np.ndarray]:
        """Desired poses of the frames in the robot's world.

        While the head is not tracked the last goals are returned; see `is_lost`.

        Args:
            frame: The operator's frame.

        Returns:
            Pose of each frame of the config, x y z qw qx qy qz. Shapes (7,).

        Raises:
            NotEngaged: Before `engage`.
        """
        anchor = self._check_engaged()
        if not is_lost(frame):
            self._goals = self._compute_goals(anchor, frame)
        return {name: self._goals[name].copy() for name in self.config.frames}

    def _compute_goals(self, anchor: _Anchor, frame: OperatorFrame) -> dict[str, np.ndarray]:
        head = _compute_head(anchor, frame.head, self.config.walk_scale)
        goals = {"head": head}
        level = level_pose(head)
        for name in self.config.frames:
            if name == "head":
                continue
            if frame.tracked[FRAMES.index(name)]:
                pose = frame.pose(name)
                reach = anchor.reach_scale * (pose[:3] - frame.head[:3])
                goals[name] = make_pose(
                    head[:3] + quat_rotate(anchor.turn, reach),
                    quat_multiply(anchor.turn, pose[3:]),
                )
                self._from_head[name] = pose_multiply(pose_inverse(level), goals[name])
            else:
                goals[name] = pose_multiply(level, self._from_head[name])
        return goals

    def _measure_height_scale(self, frame: OperatorFrame, robot_head_height: float) -> float:
        if self.config.height_scale is not None:
            return self.config.height_scale
        height = float(frame.head[2])
        if height < MIN_OPERATOR_HEIGHT:
            raise EngageRefused(
                f"cannot engage: the operator's head is {height:.2f} m over the device's floor, "
                f"less than {MIN_OPERATOR_HEIGHT} m. Set the device's floor, or "
                "--teleop.alignment.height_scale."
            )
        if not robot_head_height > 0:
            raise BadValue(f"robot_head_height must be above 0 m, got {robot_head_height}")
        return robot_head_height / (self.config.eye_height or height)

    def _find_reach_scale(self, robot_reach: float | None) -> float | None:
        """Reach scale; None to use the height scale."""
        if self.config.reach_scale is not None or self.config.arm_reach is None:
            return self.config.reach_scale
        return None if robot_reach is None else robot_reach / self.config.arm_reach

    def _check_engaged(self) -> _Anchor:
        if self._anchor is None:
            raise NotEngaged
        return self._anchor


def _compute_head(anchor: _Anchor, head: np.ndarray, walk_scale: float) -> np.ndarray:
    scale = np.array([walk_scale, walk_scale, anchor.height_scale])
    travel = scale * quat_rotate(anchor.turn, head[:3] - anchor.operator[:3])
    # A (R_o R_o0^T) A^T, the operator's rotation since engage in the robot's world axes.
    since = quat_multiply(head[3:], quat_conjugate(anchor.operator[3:]))
    rotation = quat_multiply(quat_multiply(anchor.turn, since), quat_conjugate(anchor.turn))
    return make_pose(anchor.robot[:3] + travel, quat_multiply(rotation, anchor.robot[3:]))


def _get_pose(robot_frames: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    if name not in robot_frames:
        raise UnknownName("robot frame", name, robot_frames)
    pose = np.array(robot_frames[name], dtype=float)
    if pose.shape != (7,):
        raise BadShape(f"robot_frames[{name!r}]", (7,), pose.shape)
    return pose
