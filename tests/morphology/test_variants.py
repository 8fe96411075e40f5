"""RB-Y1's Version 2 in closed loop: the left hand drives torso and left arm, level if it must."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from xop_lerobot.core.command import Mode, RobotAction
from xop_lerobot.core.state import Goal
from xop_lerobot.core.transforms import (
    make_pose,
    quat_exp,
    quat_from_rpy,
    quat_multiply,
    rotation_error,
)
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.morphology.limits import limit_action
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.plant.simulation import Simulation
from xop_lerobot.retarget.changes import Change, apply_change, make_settings
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.costs.tracking import compute_upright
from xop_lerobot.retarget.factory import make_retargeter
from xop_lerobot.retarget.mpc import MpcRetargeter
from xop_lerobot.retarget.plan import Plan
from xop_lerobot.retarget.presets import build_configs

pytestmark = pytest.mark.slow

DT = 0.04


class Bench:
    """RB-Y1 in simulation, driven by goals of one frame."""

    def __init__(self, variant: str = "v2", constraints: str = "") -> None:
        self.morphology = make_morphology("rby1")
        self.config = RetargeterConfig(threads=1, variant=variant, constraints=constraints)
        self.settings = make_settings(self.morphology, self.config)
        self.loop = PolicyLoop(
            self.morphology, Simulation(self.morphology), make_policy("diff_drive")
        )
        self.loop.reset(0)
        retargeter = make_retargeter(
            self.config,
            self.morphology,
            make_policy("diff_drive"),
            build_model(self.morphology, "planning"),
        )
        assert isinstance(retargeter, MpcRetargeter)
        self.retargeter = retargeter
        self.retargeter.reset(self.loop.state)

    def pose(self, frame: str) -> np.ndarray:
        sites = {frame: self.morphology.frames[frame]}
        return self.retargeter.problem.readings.compute_poses(self.loop.state.true_qpos, sites)[
            frame
        ]

    def change(self, **values) -> None:
        self.settings = apply_change(self.morphology, self.settings, Change(**values))
        self.retargeter.configure(
            build_configs(self.morphology, self.config, self.settings),
            self.settings.targets,
            self.settings.body,
            self.settings.constraints,
        )

    def tick(self, poses: dict[str, np.ndarray], mode: Mode = Mode.STATIONARY) -> Plan:
        state, joints = self.loop.state, self.retargeter.decision.joints
        plan = self.retargeter.plan(state, Goal(poses, mode=mode))
        arms = state.arms.copy()
        for name, angles in plan.arms.items():
            i = joints.index(name)
            arms[i] = np.clip(angles[0], arms[i] - 3 * DT, arms[i] + 3 * DT)
        previous = RobotAction(state.command, state.mode, state.arms)
        wanted = RobotAction(plan.command, mode, arms)
        self.loop.execute(limit_action(self.morphology, wanted, previous, DT), DT)
        return plan

    def close(self) -> None:
        self.retargeter.close()
        self.loop.close()


@pytest.fixture
def bench():
    benches: list[Bench] = []

    def make(*args, **kwargs) -> Bench:
        benches.append(Bench(*args, **kwargs))
        return benches[-1]

    yield make
    for each in benches:
        each.close()


Make = Callable[..., Bench]


def move(pose: np.ndarray, offset: tuple[float, ...], rpy: tuple[float, ...]) -> np.ndarray:
    return make_pose(pose[:3] + offset, quat_multiply(quat_from_rpy(*rpy), pose[3:]))


@pytest.mark.parametrize(
    "offset, rpy",
    [((0.25, -0.1, 0.15), (0.0, 0.2, 0.3)), ((0.05, 0.15, -0.25), (0.3, 0.0, -0.2))],
)
def test_the_left_hand_is_where_it_shall_be_within_one_and_a_half_seconds(bench, offset, rpy):
    b: Bench = bench()
    right, goal = b.loop.state.arms[7:14].copy(), move(b.pose("left_wrist"), offset, rpy)
    plans = [b.tick({"left_wrist": goal}) for _ in range(round(1.5 / DT))]
    hand = b.pose("left_wrist")
    assert np.linalg.norm(hand[:3] - goal[:3]) < 0.02
    assert np.linalg.norm(rotation_error(goal[3:], hand[3:])) < np.radians(3)
    assert not b.loop.state.fallen
    assert set(plans[-1].arms) == {f"left_arm_{i}" for i in range(7)}
    np.testing.assert_array_equal(b.loop.state.arms[7:14], right)  # not its to move
    assert (plans[-1].commands[:, :2] == 0).all()  # nor the base


def test_a_hand_that_is_to_stay_level_stays_level_while_it_is_carried(bench):
    """The operator's hand tilts by 0.3 rad on the way; the robot's shall not by 0.06."""
    b: Bench = bench(constraints="upright")
    start = b.pose("left_wrist")
    level = make_pose(start[:3], np.array([1.0, 0, 0, 0]))
    for _ in range(40):
        b.tick({"left_wrist": level})
    tilts, errors = [], []
    for i in range(60):
        t = i * DT
        offset = 0.1 * np.array([np.sin(2 * t), np.sin(3 * t), 1 - np.cos(2 * t)])
        tilted = quat_exp(0.3 * np.array([np.sin(2.5 * t), np.sin(2 * t), 0.0]))
        b.tick({"left_wrist": make_pose(level[:3] + offset, tilted)})
        hand = b.pose("left_wrist")
        tilts.append(np.sqrt(compute_upright(hand)))
        errors.append(np.linalg.norm(hand[:3] - level[:3] - offset))
    assert max(tilts) < 0.06
    assert np.mean(errors) < 0.05  # 0.1 s behind, without the goal's velocity
    b.change(constraints={"upright": False})
    turned = make_pose(level[:3], quat_exp(np.array([0.3, 0, 0])))
    for _ in range(25):
        b.tick({"left_wrist": turned})
    assert np.sqrt(compute_upright(b.pose("left_wrist"))) == pytest.approx(0.3, abs=0.05)


def test_the_variant_changes_in_the_middle_without_a_step(bench):
    b: Bench = bench("v1")
    goals = {name: b.pose(name) for name in ("head", "left_wrist")}
    goals["head"] = move(goals["head"], (0.05, 0, -0.1), (0, 0.1, 0))
    goals["left_wrist"] = move(goals["left_wrist"], (0.1, 0.05, 0.1), (0, 0, 0.2))
    space, arms = b.morphology.command_space, b.loop.state.arms
    for i in range(75):
        if i == 25:
            b.change(variant="v2")
        if i == 50:
            b.change(variant="v1")
        before = b.loop.state.command
        plan = b.tick(goals)
        after = b.loop.state
        assert (np.abs(after.command - before) <= space.max_rate * DT + 1e-6).all()
        assert np.abs(after.arms - arms)[:14].max() <= 3 * DT + 1e-6
        arms = after.arms
        assert bool(plan.arms) == (25 <= i < 50)
        if i == 49:
            hand = b.pose("left_wrist")
            assert np.linalg.norm(hand[:3] - goals["left_wrist"][:3]) < 0.02
    assert np.linalg.norm(b.pose("head")[:3] - goals["head"][:3]) < 0.03
    assert not b.loop.state.fallen
