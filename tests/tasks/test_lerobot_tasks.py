"""LeRobot's own recording of a robot with a task: outcome columns, scene and seeds."""

from __future__ import annotations

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset

from tests.recording.test_lerobot_cli import ROBOT, TELEOP, record_flags, run
from xop_lerobot.recording.facts import read_facts
from xop_lerobot.tasks import dual_point_touch

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("command", ["lerobot-record", "xop-record"])
def test_outcome_is_recorded(tmp_path, monkeypatch, command):
    """With points that are near enough wherever they are, held for 0.2 s, success comes."""
    monkeypatch.setattr(dual_point_touch, "TOLERANCE", 10.0)
    monkeypatch.setattr(dual_point_touch, "HOLD_S", 0.2)
    monkeypatch.setattr("xop_lerobot.tasks.stage.AFTER_SUCCESS_S", 0.1)
    root = tmp_path / "data"
    flags = (*ROBOT, *TELEOP, *record_flags(root, episode_time_s=0.6), "--play_sounds=false")
    run(monkeypatch, command, *flags, "--robot.task=dual_point_touch", "--robot.cameras=[task]")
    dataset = LeRobotDataset("local/toy", root=root)
    rows = dataset.hf_dataset.with_format("numpy")
    success, done = (np.ravel(rows[f"next.{name}"]).astype(bool) for name in ("success", "done"))
    episode = np.ravel(rows["episode_index"])
    # A row tells of after its action: the fifth ends at 0.2 s, the eighth more than 0.1 s later.
    rows_each = 15 if command == "lerobot-record" else 5  # which ends on success
    for index in range(2):
        own = episode == index
        assert own.sum() == rows_each
        assert success[own].tolist() == [False] * 4 + [True] * (rows_each - 4)
        assert done[own].tolist() == ([False] * 7 + [True] * 8)[:rows_each]
    assert "observation.images.task" in dataset.features
    assert [facts["success"] for facts in read_facts(root)] == [True, True]
    assert [facts["scene"] for facts in read_facts(root)] == ["empty", "empty"]
