"""State synchronisation: residuals, optimum, limits, memory, failures, on three robots."""

from __future__ import annotations

import numpy as np
import pytest
import toy_robot  # noqa: F401 registers the toy

from xop_lerobot.command import Mode
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.retarget.state_sync import StateSync
from xop_lerobot.retarget.sync_config import SyncConfig, SyncStatus

ROBOTS = ("g1", "rby1", "toy")


@pytest.fixture(scope="module", params=ROBOTS)
def robot(request):
    morphology = make_morphology(request.param)
    return morphology, build_model(morphology, "planning")


@pytest.mark.parametrize("mode", list(Mode))
def test_synchronises_every_robot_in_every_mode(robot, mode):
    morphology, model = robot
    sync = StateSync(morphology, model, SyncConfig())
    synced = sync.synchronise(0.0, morphology.standing_qpos(), np.zeros(model.nv), mode)
    assert synced.status in (SyncStatus.OK, SyncStatus.BOUNDED)
    assert synced.qpos.shape == (model.nq,)
    assert synced.qvel.shape == (model.nv,)
    assert not synced.qpos.flags.writeable
    assert synced.residual < 1e-3
