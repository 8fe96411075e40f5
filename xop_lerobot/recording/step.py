"""One control step of a recording: observe, decide, act, record."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from lerobot.utils.constants import ACTION, OBS_STR
from lerobot.utils.feature_utils import build_dataset_frame

if TYPE_CHECKING:
    from lerobot_robot_xop.xop_robot import XopRobot
    from lerobot_teleoperator_xop.xop import Xop
    from xop_lerobot.recording.dataset import XopDataset


def record_step(
    robot: XopRobot, teleop: Xop, dataset: XopDataset, task: str
) -> tuple[dict[str, Any], dict[str, float]]:
    """Run one control step and add its frame to the dataset.

    Args:
        robot: Connected robot.
        teleop: Connected teleoperator of the same session.
        dataset: Dataset to add to.
        task: Task description.

    Returns:
        The observation, and the action chosen from it.
    """
    features = dataset.features
    observation = robot.get_observation()
    action = teleop.get_action()
    robot.send_action(action)
    dataset.add_frame(
        {
            **build_dataset_frame(features, observation, prefix=OBS_STR),
            **build_dataset_frame(features, action, prefix=ACTION),
            "task": task,
        }
    )
    return observation, action
