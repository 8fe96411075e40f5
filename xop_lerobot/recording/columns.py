"""Additional columns of an episode: operator, goal, retargeter, robot, time and outcome.

No key starts with `observation` or `action`, so no policy is trained on them by accident. Every
column is one-dimensional, and none contains NaN, which would break statistics: unknown values are
0, with a flag (`operator.engaged`, `operator.tracked`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.state import FRAMES
from xop_lerobot.morphology.body import Body
from xop_lerobot.retarget.costs import COSTS
from xop_lerobot.session import RobotInfo, Tick

POSE_NAMES = ("x", "y", "z", "qw", "qx", "qy", "qz")
COST_NAMES = (*(cost.name for cost in COSTS), "total")
"""Entries of `retargeter.cost`; terms that the retargeter lacks are 0."""
HEALTH_NAMES = (
    "solve_time", "plan_age", "effective_samples", "status", "sync_residual", "sync_status",
    "intervention", "risk",
)  # fmt: skip
"""Entries of `retargeter.health`, explained in docs/use/recording.md."""
OWN_PREFIXES = ("operator.", "goal.", "retargeter.", "robot.", "time.", "next.")
"""Key prefixes of these columns."""


def is_own_column(key: str) -> bool:
    """Whether `key` is one of this module's columns."""
    return key.startswith(OWN_PREFIXES)


class Columns:
    """Additional columns of one robot.

    Args:
        info: The robot.

    Attributes:
        features: LeRobot feature of each column: dtype, shape and names.
    """

    def __init__(self, info: RobotInfo) -> None:
        morphology = info.morphology
        self._frames = tuple(morphology.frames)
        self._has_truth = info.has_truth
        self._body = Body(morphology)
        effort = self._body.actuator_names
        self.features: dict[str, dict] = {
            **{f"operator.{frame}": _feature("float32", POSE_NAMES) for frame in FRAMES},
            "operator.pinch": _feature("float32", ("left", "right")),
            "operator.tracked": _feature("bool", FRAMES),
            "operator.engaged": _feature("bool", ("engaged",)),
            **{f"goal.{frame}": _feature("float32", POSE_NAMES) for frame in self._frames},
            "retargeter.command": _feature("float32", morphology.command_space.names),
            "retargeter.cost": _feature("float32", COST_NAMES),
            "retargeter.health": _feature("float32", HEALTH_NAMES),
            "robot.base_pose": _feature("float32", POSE_NAMES),
            "robot.base_estimate": _feature("float32", POSE_NAMES),
            **{f"robot.{frame}": _feature("float32", POSE_NAMES) for frame in self._frames},
            "robot.effort": _feature("float32", effort),
            "time.sim": _feature("float64", ("s",)),
            # Integer nanoseconds: LeRobot loads every float as float32, whose resolution for
            # seconds since 1970 is two minutes.
            "time.wall": _feature("int64", ("ns",)),
            "next.success": _feature("bool", ("success",)),
            "next.done": _feature("bool", ("done",)),
        }

    def build_row(self, tick: Tick) -> dict[str, np.ndarray]:
        """Build the columns of one frame.

        Args:
            tick: Tick of the frame; without a decision the robot was driven by something else.

        Returns:
            An array per feature, with its dtype and shape.
        """
        state, frame, outcome = tick.state, tick.frame, tick.outcome
        goals = tick.goal.poses if tick.goal else {}
        done = tick.finished or (outcome is not None and outcome.done)
        values: dict[str, object] = {
            "operator.engaged": tick.engaged,
            "retargeter.cost": _pick(COST_NAMES, tick.cost),
            "retargeter.health": _pick(HEALTH_NAMES, tick.health),
            "robot.base_estimate": self._body.get_base(
                state.qpos if tick.estimate is None else tick.estimate
            ),
            "robot.effort": state.effort,
            "time.sim": state.time,
            "time.wall": round(state.wall_time * 1e9),
            "next.success": outcome is not None and outcome.success,
            "next.done": done,
        }
        if frame is not None:
            values |= {f"operator.{name}": frame.pose(name) for name in FRAMES}
            values |= {"operator.pinch": frame.pinch, "operator.tracked": frame.tracked}
        if tick.command is not None:
            values["retargeter.command"] = tick.command
        values |= {f"goal.{name}": pose for name, pose in goals.items()}
        poses = self._body.compute_poses(self._find_position(tick))
        values |= {f"robot.{name}": pose for name, pose in poses.items()}
        return {key: _cast(values.get(key), spec) for key, spec in self.features.items()}

    def _find_position(self, tick: Tick) -> np.ndarray:
        """Best known position: true, else synchronised, else measured. Shape (nq,)."""
        if self._has_truth or tick.estimate is None:
            return tick.state.true_qpos
        return tick.estimate


def has_all_columns(features: Mapping[str, Mapping], columns: Columns, root: Path) -> bool:
    """Whether a dataset has all of these columns.

    Raises:
        BadValue: If it has them with other entries, written by another version of this project.
    """
    if not all(key in features for key in columns.features):
        return False
    for key, spec in columns.features.items():
        if list(features[key]["names"] or ()) != spec["names"]:
            raise BadValue(
                f"'{root}' was recorded by another version: its column '{key}' has the entries "
                f"{', '.join(features[key]['names'] or ())}, and not {', '.join(spec['names'])}. "
                "Begin a new dataset"
            )
    return True


def _feature(dtype: str, names: Iterable[str]) -> dict:
    names = list(names)
    return {"dtype": dtype, "shape": (len(names),), "names": names}


def _pick(names: tuple[str, ...], values: Mapping[str, float]) -> list[float]:
    return [float(values.get(name, 0.0)) for name in names]


def _cast(value: object, feature: dict) -> np.ndarray:
    if value is None:
        return np.zeros(feature["shape"], feature["dtype"])
    column = np.reshape(np.asarray(value), feature["shape"])
    if column.dtype.kind == "f":
        column = np.nan_to_num(column, nan=0.0, posinf=0.0, neginf=0.0)
    return column.astype(feature["dtype"])
