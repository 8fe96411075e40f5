"""From collected episodes to a policy that drives the robot, with LeRobot's own commands.

What a policy takes in and gives out is exactly the state, the pictures and the action, whatever
other columns a dataset has. docs/use/training.md is the same on a larger scale.
"""

from __future__ import annotations

import importlib
import json
import signal
import subprocess
import sys
from pathlib import Path

import draccus
import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.feature_utils import dataset_to_policy_features
from lerobot_rows import get_row
from reached import collect_reach

from lerobot_robot_xop import XopG1Config, XopRby1Config
from lerobot_robot_xop.xop_robot import XopG1, XopRby1
from xop_lerobot.recording.columns import OWN_PREFIXES, Columns
from xop_lerobot.recording.facts import read_facts
from xop_lerobot.recording.record import build_features
from xop_lerobot.session import get_session

pytestmark = pytest.mark.slow

REPO = Path(__file__).parents[2]
CONFIG = REPO / "configs" / "train_act_rby1_reach.yaml"
WIDTH, HEIGHT = 32, 24
INPUTS = {"observation.state", "observation.images.head"}


def run(monkeypatch, command: str, *flags: str) -> None:
    """Run one of LeRobot's commands in this process, and leave no signal handler behind."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    monkeypatch.setattr(sys, "argv", [command, *flags])
    try:
        importlib.import_module(f"lerobot.scripts.{command.replace('-', '_')}").main()
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


@pytest.mark.parametrize(
    ("device", "config", "state", "action"),
    [(XopG1, XopG1Config, 67, 22), (XopRby1, XopRby1Config, 61, 27)],
)
@pytest.mark.parametrize("cameras", [["head"], ["head", "scene"]])
def test_a_policy_is_made_for_state_pictures_and_action_alone(
    request, device, config, state, action, cameras
):
    """Of all columns that a dataset of ours has, LeRobot takes these and no other."""
    robot = device(config(session=request.node.name, cameras=cameras, width=64, height=48))
    own = Columns(get_session(request.node.name).robot).features
    assert {key.split(".")[0] + "." for key in own} == set(OWN_PREFIXES)
    features = {**build_features(robot, use_videos=True), **own}
    taken = dataset_to_policy_features(features)
    pictures = {f"observation.images.{camera}": (3, 48, 64) for camera in cameras}
    assert {key: feature.shape for key, feature in taken.items()} == {
        "observation.state": (state,),
        **pictures,
        "action": (action,),
    }
    # And the state is the body's own: no operator, no goal, nothing of the task.
    names = features["observation.state"]["names"]
    assert all(name.endswith((".pos", ".vel")) for name in names)
    own_names = {name for name in names if name.startswith("base.")}
    assert len(own_names) == 9
    joints = {name.removesuffix(".pos").removesuffix(".vel") for name in set(names) - own_names}
    model = robot.morphology.build_spec("full").compile()
    assert joints <= {model.joint(i).name.removesuffix("_joint") for i in range(model.njnt)} | {
        model.joint(i).name for i in range(model.njnt)
    }


def test_the_configuration_that_is_shipped():
    config = draccus.parse(TrainPipelineConfig, config_path=CONFIG, args=[])
    assert isinstance(config.policy, ACTConfig)
    assert (config.policy.type, config.policy.device) == ("act", "cpu")
    assert not config.policy.push_to_hub
    # Features are the dataset's: none is named by hand.
    assert not config.policy.input_features
    assert not config.policy.output_features
    assert config.policy.pretrained_backbone_weights is None


@pytest.fixture(scope="module")
def collected(tmp_path_factory) -> Path:
    """An episode of a person who reaches two points, with tiny pictures and no planner."""
    return collect_reach(tmp_path_factory.mktemp("collected"), width=WIDTH, height=HEIGHT)


@pytest.fixture(scope="module")
def policy(collected, tmp_path_factory) -> Path:
    """The shipped configuration, made tiny, after three steps of `lerobot-train`."""
    pytest.importorskip("accelerate", reason="lerobot-train needs accelerate")
    out = tmp_path_factory.mktemp("train") / "out"
    changes = {
        "dataset.root": collected, "dataset.eval_split": 0, "eval_steps": 0, "steps": 3,
        "batch_size": 2, "output_dir": out, "policy.dim_model": 32, "policy.n_heads": 2,
        "policy.dim_feedforward": 32, "policy.n_encoder_layers": 1,
    }  # fmt: skip
    flags = [f"--{key}={value}" for key, value in changes.items()]
    with pytest.MonkeyPatch.context() as patch:
        run(patch, "lerobot-train", f"--config_path={CONFIG}", *flags)
    return out / "checkpoints" / "last" / "pretrained_model"


def test_a_trained_policy_has_these_inputs_and_outputs(policy):
    config = PreTrainedConfig.from_pretrained(policy)
    assert config.input_features is not None
    assert config.output_features is not None
    shapes = {key: tuple(feature.shape) for key, feature in config.input_features.items()}
    assert shapes == {
        "observation.state": (61,),
        "observation.images.head": (3, HEIGHT, WIDTH),
    }
    assert {key: tuple(each.shape) for key, each in config.output_features.items()} == {
        "action": (27,)
    }


def test_nothing_but_its_inputs_changes_what_it_does(policy, collected):
    """Every other column of a row may hold anything, and a changed input is noticed."""
    config = PreTrainedConfig.from_pretrained(policy)
    config.device = "cpu"
    act = ACTPolicy.from_pretrained(policy, config=config)
    prepare, _ = make_pre_post_processors(policy_cfg=config, pretrained_path=str(policy))
    row = get_row(LeRobotDataset("local/data", root=collected), 20)

    def predict(row: dict) -> torch.Tensor:
        act.reset()
        return act.predict_action_chunk(prepare(dict(row)))

    before = predict(row)
    others = [key for key, value in row.items() if isinstance(value, torch.Tensor)]
    others = [key for key in others if key not in INPUTS]
    assert {key.split(".")[0] for key in others} >= {"operator", "goal", "retargeter", "robot"}
    changed = {key: torch.ones_like(row[key]) for key in others if key != "task_index"}
    assert torch.equal(predict({**row, **changed}), before)
    for key in INPUTS:
        assert not torch.equal(predict({**row, key: row[key] * 0.5 + 0.1}), before), key


def test_it_drives_the_robot_and_is_evaluated(policy, tmp_path, monkeypatch):
    """`lerobot-rollout` twice with the same seed, then the script that compares them."""
    for name in ("one", "two"):
        run(
            monkeypatch,
            "lerobot-rollout",
            "--strategy.type=episodic",
            "--strategy.smooth_handover=false",
            f"--policy.path={policy}",
            "--device=cpu",
            "--robot.type=xop_rby1",
            "--robot.task=dual_point_reach",
            "--robot.seed=1000",
            f"--robot.width={WIDTH}",
            f"--robot.height={HEIGHT}",
            "--robot.sim.noise=mild",
            "--teleop.type=xop",
            "--teleop.device.type=simulated",
            "--teleop.retargeter.type=direct",
            "--fps=25",
            "--dataset.repo_id=local/rollout_one",
            f"--dataset.root={tmp_path / name}",
            "--dataset.fps=25",
            "--dataset.num_episodes=2",
            "--dataset.episode_time_s=1",
            "--dataset.reset_time_s=0",
            "--dataset.single_task=reach",
            "--dataset.video=false",
            "--dataset.push_to_hub=false",
            "--dataset.no_stamp=true",
            "--play_sounds=false",
            "--return_to_initial_position=false",
        )
        assert [facts["length"] for facts in read_facts(tmp_path / name)] == [25, 25]
    one, two = (
        np.stack(LeRobotDataset("local/r", root=tmp_path / name).hf_dataset["action"])
        for name in ("one", "two")
    )
    # In lock-step the same policy does the same with the same seeds.
    assert np.array_equal(one, two)

    command = [sys.executable, "-m", "benchmarks.run_evaluate_policy", "--at", "1", "--json"]
    command += [tmp_path / "out.json", "--rollouts", f"one={tmp_path / 'one'}"]
    command += [f"two={tmp_path / 'two'}", "--margin", "0.01"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=REPO)
    assert done.returncode == 1, done.stderr  # it cannot be nearer than itself
    assert "one is nearer than two by 0.000 m (0.000 to 0.000), in 0 of 2 episodes" in done.stdout
    found = json.loads((tmp_path / "out.json").read_text())
    assert list(found["policies"]) == ["one", "two", "stand still"]
    assert found["margins"]["two"]["mean"] == 0
    assert found["policies"]["stand still"]["error"] > 0.08
