"""The newcomer's path of docs/start/first_steps.md, run command by command."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from lerobot.datasets import LeRobotDataset

from tests.docs.test_readme import PAGES, ROOT, read_commands

PAGE = ROOT / "docs" / "start" / "first_steps.md"
MODULES = {
    "xop-collect": "xop_lerobot.collect.cli",
    "xop-curate": "xop_lerobot.curate.cli",
    "lerobot-train": "lerobot.scripts.lerobot_train",
    "lerobot-rollout": "lerobot.scripts.lerobot_rollout",
}


@pytest.mark.slow
def test_a_newcomer_gets_to_a_policy_that_drives(tmp_path: Path) -> None:
    pytest.importorskip("accelerate", reason="lerobot-train needs accelerate")
    folders = [str(ROOT / name) for name in (".", "robots", "teleoperators")]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(folders),
        "HF_LEROBOT_HOME": str(tmp_path / "home"),
    }
    (tmp_path / "configs").symlink_to(ROOT / "configs")
    for command in read_commands(PAGE):
        if command[0] == "make":
            continue
        done = subprocess.run(
            [sys.executable, "-m", MODULES[command[0]], *command[1:]],
            cwd=tmp_path, env=environment, capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, f"{shlex.join(command)}\n{done.stderr[-2000:]}"
    good = LeRobotDataset("local/first_good", root=tmp_path / "outputs" / "first_good")
    assert 1 <= good.num_episodes <= 4
    driven = LeRobotDataset("local/rollout_first", root=tmp_path / "outputs" / "rollout_first")
    assert (driven.num_episodes, driven.num_frames) == (1, 150)
    assert (tmp_path / "outputs" / "first.html").stat().st_size > 10_000


def test_the_index_lists_every_page() -> None:
    index = (ROOT / "docs" / "index.md").read_text()
    pages = [page for page in PAGES if page.parent != ROOT and page.name != "index.md"]
    listed = (f"({page.parent.name}/{page.name}" for page in pages)
    assert [link for link in listed if link not in index] == []
