"""A policy runs with pictures of the size that it was trained with, or is refused."""

from __future__ import annotations

from importlib.metadata import version
from threading import Event
from types import SimpleNamespace
from typing import Any

import pytest
from foreign_robot import ForeignRobotConfig
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
from lerobot.scripts import lerobot_rollout
from toy_robot import XopToyConfig

from lerobot_robot_xop import XopRobotConfig
from xop_lerobot.core.errors import BadValue
from xop_lerobot.recording import lerobot_patches
from xop_lerobot.recording.rollout_pictures import watch_rollouts

EVENT = Event()
TEXT = "policy was trained with images of 128 x 96 of camera 'head', and the robot's are 320 x 240"


@pytest.fixture
def built(monkeypatch) -> list:
    """The calls that LeRobot's own function gets."""
    calls: list = []
    stock = lambda cfg, event: calls.append((cfg, event))  # noqa: E731  replaced as a name
    monkeypatch.setattr(lerobot_rollout, "build_rollout_context", stock)
    return calls


def make_inputs(*cameras: str) -> dict[str, PolicyFeature]:
    picture = PolicyFeature(type=FeatureType.VISUAL, shape=(3, 96, 128))
    state = PolicyFeature(type=FeatureType.STATE, shape=(19,))
    return {"observation.state": state, **{f"observation.images.{c}": picture for c in cameras}}


def roll_out(
    robot, *cameras: str, policy: type[ACTConfig | SmolVLAConfig] = ACTConfig, rename_map=None
) -> None:
    """What `lerobot-rollout` begins with."""
    config = policy(input_features=make_inputs(*cameras), device="cpu")
    cfg: Any = SimpleNamespace(robot=robot, policy=config, rename_map=rename_map or {})
    lerobot_rollout.build_rollout_context(cfg, EVENT)


def test_another_size_is_refused(built):
    robot = XopToyConfig(session="x")
    with pytest.raises(BadValue) as refusal:
        roll_out(robot, "head")
    assert str(refusal.value) == f"the {TEXT}. Use --robot.width=128 --robot.height=96"
    assert not built


def test_one_camera_of_several_is_enough(built):
    robot = XopToyConfig(session="x", cameras="back,head")
    with pytest.raises(BadValue, match="camera 'head'"):
        roll_out(robot, "head")


def test_renamed_cameras_are_compared(built):
    names = {"observation.images.head": "observation.images.top"}
    with pytest.raises(BadValue, match="of camera 'head'"):
        roll_out(XopToyConfig(session="x"), "top", rename_map=names)


def test_what_fits_is_passed_through(built):
    for robot, cameras in (
        (XopToyConfig(session="x", width=128, height=96), ["head"]),
        (XopToyConfig(session="x"), []),  # it does not look
        (XopToyConfig(session="x", cameras="back"), ["head"]),  # LeRobot compares the names
        (ForeignRobotConfig(), ["head"]),
    ):
        roll_out(robot, *cameras)
        assert built[-1][0].robot is robot
    assert [event for _, event in built] == [EVENT] * 4


def test_a_policy_that_resizes_is_only_told_of(built, caplog):
    roll_out(XopToyConfig(session="x"), "head", policy=SmolVLAConfig)
    assert built
    assert f"The {TEXT}; it resizes them itself." in caplog.messages


def test_it_is_wrapped_once(built):
    XopToyConfig(session="x")
    first = lerobot_rollout.build_rollout_context
    XopToyConfig(session="y")
    assert lerobot_rollout.build_rollout_context is first


def test_it_is_put_back(built):
    stock = lerobot_rollout.build_rollout_context
    patched = watch_rollouts(XopRobotConfig)
    assert lerobot_rollout.build_rollout_context is not stock
    patched.undo()
    assert lerobot_rollout.build_rollout_context is stock


def test_a_lerobot_that_has_changed_is_said(monkeypatch, caplog):
    monkeypatch.delattr(lerobot_rollout, "build_rollout_context")
    monkeypatch.setattr(lerobot_patches, "_said", set())
    watch_rollouts(XopRobotConfig)
    assert caplog.messages == [
        f"LeRobot {version('lerobot')} does not fit the patch 'set-up of lerobot-rollout', made "
        "for 0.6.1: lerobot.scripts.lerobot_rollout.build_rollout_context() is expected, and "
        "lerobot.scripts.lerobot_rollout has no build_rollout_context. Nobody compares the size of "
        "a policy's images with the robot's: compare --robot.width and --robot.height yourself."
    ]
