"""What the parts around the optimisation do, and that each can be left out (`MpcConfig.aids`)."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import UnknownName
from xop_lerobot.core.state import Goal
from xop_lerobot.low_level.factory import make_policy, resolve_policy
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.morphology.tuning import AIDS
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.plant.simulation import Simulation
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.mpc import MpcRetargeter
from xop_lerobot.retarget.plan import Plan
from xop_lerobot.retarget.references import Reference


class Bench:
    """A standing robot and its controller, with few samples."""

    def __init__(self, robot: str) -> None:
        self.morphology = make_morphology(robot)
        policy = make_policy(resolve_policy(self.morphology))
        simulation = Simulation(self.morphology, kind="planning")
        self.loop = PolicyLoop(self.morphology, simulation, policy)
        self.loop.reset(0, settle_s=0.2)
        self.retargeter = MpcRetargeter(
            self.morphology,
            policy,
            build_model(self.morphology, "planning"),
            RetargeterConfig(num_samples=8, horizon=4, threads=1),
        )

    def keep(self, *aids: str) -> None:
        """Use these aids alone."""
        configs = self.retargeter.configs
        self.retargeter.configure(
            {mode: dataclasses.replace(config, aids=aids) for mode, config in configs.items()}
        )
        self.retargeter.reset(self.loop.state)

    def make_goal(self, offset: tuple[float, float, float], mode: Mode) -> Goal:
        sites = self.morphology.frames
        poses = self.retargeter.problem.readings.compute_poses(self.loop.state.qpos, sites)
        pose = poses["head"].copy()
        pose[:3] += offset
        return Goal({"head": pose}, mode=mode)

    def plan(self, offset: tuple[float, float, float], mode: Mode) -> Plan:
        self.retargeter.reset(self.loop.state)
        return self.retargeter.plan(self.loop.state, self.make_goal(offset, mode))

    def refer(self, offset: tuple[float, float, float], mode: Mode) -> Reference:
        retargeter = self.retargeter
        now = retargeter._observe(self.loop.state, mode, retargeter.configs[mode])
        return retargeter.references.lead(
            now, self.make_goal(offset, mode), retargeter.configs[mode]
        )

    def close(self) -> None:
        self.retargeter.close()
        self.loop.close()


@pytest.fixture(params=["g1", "rby1"])
def bench(request):
    made = Bench(request.param)
    yield made
    made.close()


def others(aid: str) -> tuple[str, ...]:
    return tuple(each for each in AIDS if each != aid)


def test_without_sway_a_standing_robot_gets_no_velocity(bench):
    still = bench.morphology.command_space.mobile_only
    lean = ((0.08, 0.05, -0.02), Mode.STATIONARY)
    shifts = bench.plan(*lean).commands[:, still].any()
    assert shifts == bool(bench.morphology.command_space.sway.any())
    bench.keep(*others("sway"))
    assert not bench.plan(*lean).commands[:, still].any()
    assert bench.plan((0.5, 0, 0), Mode.MOBILE).commands[:, still].any()
    bench.keep(*AIDS)
    assert bench.plan(*lean).commands[:, still].any() == shifts


def test_without_postures_the_heads_goal_stays_where_it_is(bench):
    far = ((1.5, 0.0, 0.0), Mode.STATIONARY)
    asked = bench.make_goal(*far).poses["head"]
    reach = bench.retargeter.configs[Mode.STATIONARY].reach
    near = bench.refer(*far)
    assert near.served is not None
    bench.keep(*others("postures"))
    reference = bench.refer(*far)
    assert reference.served is None
    goal = reference.goals["head"][-1]
    np.testing.assert_allclose(goal[:3], asked[:3] - [1.5 - reach, 0, 0], atol=1e-9)
    np.testing.assert_array_equal(goal[3:], asked[3:])
    assert goal[0] > near.goals["head"][-1, 0] + 0.1


def test_without_the_route_wheels_have_no_path_and_no_heading():
    bench = Bench("rby1")
    aside = ((0.0, 0.3, 0.0), Mode.MOBILE)  # at its side: wheels have to turn first
    led = bench.refer(*aside)
    assert led.facing.any()
    assert np.ptp(led.goals["head"][:, 0]) + np.ptp(led.goals["head"][:, 1]) > 0.01
    bench.keep(*others("route"))
    straight = bench.refer(*aside)
    assert not straight.facing.any()
    np.testing.assert_allclose(
        straight.goals["head"], np.tile(bench.make_goal(*aside).poses["head"], (7, 1)), atol=1e-9
    )
    bench.close()


def test_a_misspelt_aid_is_told(bench):
    with pytest.raises(UnknownName, match=r"^unknown aid 'rout'. Known: drift, intervention, off"):
        bench.keep("rout")
