"""Whatever robot it is, the planner plans for it: those that ship, one on feet, one on wheels."""

from __future__ import annotations

import numpy as np
import pytest
import toy_robot  # registers the toys

from xop_lerobot.core.command import Mode, RobotAction
from xop_lerobot.core.state import Goal
from xop_lerobot.low_level.factory import make_policy, resolve_policy
from xop_lerobot.morphology.morphology import MORPHOLOGIES, Morphology, make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.plant.simulation import Simulation
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.factory import make_retargeter
from xop_lerobot.retarget.obstacles import make_obstacles
from xop_lerobot.retarget.sync.config import SyncStatus
from xop_lerobot.retarget.sync.state_sync import StateSync

ROBOTS = (*MORPHOLOGIES.built_in, "toy", "rolling_toy")
DT = 0.04
TICKS = 25


def approach(morphology: Morphology, mode: Mode, ticks: int = TICKS) -> float:
    """Plan for a goal 5 cm down and, on the move, 10 cm ahead.

    Returns:
        Distance that is left, over that at first [1].
    """
    policy = make_policy(resolve_policy(morphology))
    morphology = morphology.fit(policy)
    model = build_model(morphology, "planning")
    plant = Simulation(morphology)
    loop = PolicyLoop(morphology, plant, policy)
    loop.reset(seed=0, settle_s=0.4)
    config = RetargeterConfig(num_samples=8, horizon=6, threads=1)
    obstacles = make_obstacles(plant.model)
    retargeter = make_retargeter(config, morphology, policy, model, obstacles)
    retargeter.reset(loop.state)
    sync = StateSync(morphology, model)
    space, site = morphology.command_space, morphology.frames["head"]
    pose = plant.get_site_pose(site)
    pose[:3] += (0.1 if mode is Mode.MOBILE else 0.0, 0, -0.05)
    goal, before = Goal({"head": pose}, mode=mode), compute_distance(plant, site, pose)
    low, high = space.bounds(mode)
    for _ in range(ticks):
        state = loop.state
        synced = sync.synchronise(state.time, state.qpos, state.qvel, mode)
        assert synced.status is not SyncStatus.MEASUREMENT
        plan = retargeter.plan(state, goal)
        assert ((plan.command >= low - 1e-9) & (plan.command <= high + 1e-9)).all()
        loop.execute(RobotAction(plan.command, mode, loop.action.arms), DT)
    retargeter.close()
    assert not loop.state.fallen
    return compute_distance(plant, site, pose) / before


def compute_distance(plant: Simulation, site: str, pose: np.ndarray) -> float:
    return float(np.linalg.norm(plant.get_site_pose(site)[:3] - pose[:3]))


@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize("robot", ROBOTS)
def test_a_goal_is_approached(robot: str, mode: Mode) -> None:
    assert approach(make_morphology(robot), mode) < 0.92


class UnsteadyToy(toy_robot.RollingToy):
    """Its centre of mass is never over where it counts as safe."""

    support = ((0.3, -0.1), (0.3, 0.1), (0.29, 0.0))


def test_a_robot_that_no_posture_holds_is_planned_for() -> None:
    assert np.isfinite(approach(UnsteadyToy(), Mode.STATIONARY))
