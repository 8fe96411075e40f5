"""The offset observer: where a robot rests beside its command, and nothing while it moves."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from xop_lerobot.core.command import Mode, RobotAction
from xop_lerobot.core.state import Goal
from xop_lerobot.core.transforms import quat_from_rpy, quat_multiply, rotation_error
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.morphology.morphology import Morphology, make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.plant.simulation import Simulation
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.model.command_model import CommandModel
from xop_lerobot.retarget.model.observers import OffsetObserver
from xop_lerobot.retarget.mpc import MpcRetargeter

DT = 0.04


class Parts:
    """A robot whose heights and joints are wherever a test puts them."""

    def __init__(self) -> None:
        self.morphology: Morphology = make_morphology("g1")
        self.model = CommandModel(
            self.morphology.build_spec("planning").compile(),
            self.morphology.command_space,
            self.morphology.effects,
        )
        self.space = self.morphology.command_space
        self.velocities = self.model.is_velocity()
        self.scale = (self.space.high - self.space.low) / 2
        self.observer = OffsetObserver(self.model)
        self.time = 0.0

    def place(self, values: np.ndarray) -> np.ndarray:
        """Standing, with height and joints at `values`."""
        qpos = self.morphology.standing_qpos()
        follows = ~self.velocities
        qpos[self.model._address[follows]] = values[follows]
        return qpos

    def update(self, values: np.ndarray, command: np.ndarray, learns: bool = True) -> None:
        self.observer.update(self.time, self.place(values), command, learns=learns)
        self.time += DT


@pytest.fixture
def parts() -> Parts:
    return Parts()


BESIDE = np.array([-0.012, 0.03, -0.02, 0.05, 0, 0, 0])
"""An offset of height and waist, none of the velocities."""


def test_a_constant_offset_is_found_with_its_time_constant(parts):
    command = parts.space.neutral
    parts.observer.reset(command)
    shares = []
    for _ in range(101):
        shares.append(parts.observer.offset[:4] / BESIDE[:4])
        parts.update(command + BESIDE, command)
    expected = 1 - np.exp(-DT * np.maximum(np.arange(101) - 1, 0) / 0.6)
    np.testing.assert_allclose(shares, np.tile(expected[:, None], 4), atol=1e-9)
    np.testing.assert_array_equal(parts.observer.offset[4:], 0)


def test_it_follows_an_offset_that_changes(parts):
    command = parts.space.neutral
    for beside in (BESIDE, -BESIDE):
        for _ in range(100):
            parts.update(command + beside, command)
        np.testing.assert_allclose(parts.observer.offset, beside, atol=1e-3)


def test_in_motion_nothing_is_learnt(parts):
    """A robot that follows with exactly its lag has no offset, however it is moved."""
    rng = np.random.default_rng(0)
    command = parts.space.neutral.copy()
    parts.observer.reset(command)
    lagged = command.copy()
    for tick in range(200):
        if tick % 10 == 0:
            command = parts.space.neutral + 0.3 * parts.scale * rng.uniform(-1, 1, 7)
        lagged = parts.model.settle(lagged, command, DT)
        parts.update(np.where(parts.velocities, 0, lagged), command)
        parts.observer.settled = np.where(parts.velocities, parts.observer.settled, lagged)
    np.testing.assert_allclose(parts.observer.offset, 0, atol=1e-3)


def test_while_the_lagged_command_is_on_its_way_nothing_is_learnt(parts):
    """Half the scale away after a step: what is seen then is not where it rests."""
    far = parts.space.neutral.copy()
    far[1] += 0.8
    parts.observer.reset(parts.space.neutral)
    parts.update(parts.space.neutral, far)
    for _ in range(9):  # 0.36 s: 17 % of the way is left
        parts.update(parts.space.neutral, far)
    assert parts.observer.offset[1] == 0
    assert abs(far[1] - parts.observer.settled[1]) > 0.03 * parts.scale[1]


def test_each_entry_learns_on_its_own(parts):
    """The height rests and is learnt of while the waist turns."""
    parts.observer.reset(parts.space.neutral)
    for tick in range(60):
        command = parts.space.neutral.copy()
        command[1] = 0.8 * (-1) ** (tick // 5)
        parts.update(parts.space.neutral + [-0.01, 0.3, 0, 0, 0, 0, 0], command)
    assert parts.observer.offset[0] == pytest.approx(-0.01, rel=0.05)
    assert parts.observer.offset[1] == 0


def test_told_not_to_learn_it_forgets_but_follows_the_command(parts):
    """The lagged command is where a sway starts from, with offsets or without."""
    command = parts.space.neutral.copy()
    for _ in range(50):
        parts.update(command + BESIDE, command)
    assert parts.observer.offset.any()
    command[4] = 0.1
    for _ in range(100):
        parts.update(parts.space.neutral + BESIDE, command, learns=False)
    np.testing.assert_array_equal(parts.observer.offset, 0)
    np.testing.assert_allclose(parts.observer.settled, command, atol=1e-3)


def test_an_offset_is_bounded(parts):
    for sign in (1, -1):
        for _ in range(200):
            parts.update(
                parts.space.neutral + sign * np.where(parts.velocities, 0, 5.0), parts.space.neutral
            )
        expected = np.where(parts.velocities, 0, sign * 0.2 * parts.scale)
        np.testing.assert_allclose(parts.observer.offset, expected)


def test_what_is_not_finite_changes_nothing(parts):
    for _ in range(30):
        parts.update(parts.space.neutral + BESIDE, parts.space.neutral)
    before = parts.observer.offset.copy()
    values = np.full(7, np.nan)
    parts.update(values, parts.space.neutral)
    np.testing.assert_array_equal(parts.observer.offset, before)
    values = parts.space.neutral + BESIDE
    values[1] = np.inf
    parts.update(values, parts.space.neutral)
    assert np.isfinite(parts.observer.offset).all()
    assert parts.observer.offset[1] == before[1]
    assert parts.observer.offset[0] != before[0]


@pytest.mark.parametrize("step", [0.0, -1.0])
def test_time_that_stands_or_goes_back_changes_nothing(parts, step):
    for _ in range(10):
        parts.update(parts.space.neutral + BESIDE, parts.space.neutral)
    before = parts.observer.offset.copy()
    parts.time += step - DT
    parts.update(parts.space.neutral - BESIDE, parts.space.neutral)
    np.testing.assert_array_equal(parts.observer.offset, before)


def test_reset_forgets(parts):
    for _ in range(30):
        parts.update(parts.space.neutral + BESIDE, parts.space.neutral)
    command = parts.space.neutral + 0.1 * parts.scale
    parts.observer.reset(command)
    np.testing.assert_array_equal(parts.observer.offset, 0)
    np.testing.assert_array_equal(parts.observer.settled, command)
    parts.update(parts.space.neutral, command)  # the first tick only starts the clock
    np.testing.assert_array_equal(parts.observer.offset, 0)


# -- closed loop -----------------------------------------------------------------------------


def lean(observe: bool) -> tuple[float, float]:
    """Distance [m] and angle [rad] of G1's head to a goal, mean from 2 to 3 s after."""
    morphology, policy = make_morphology("g1"), make_policy("default")
    loop = PolicyLoop(morphology, Simulation(morphology, kind="planning"), policy)
    loop.reset(0, settle_s=0.4)
    retargeter = MpcRetargeter(
        morphology, policy, build_model(morphology, "planning"), RetargeterConfig(threads=1)
    )
    retargeter.configure(
        {
            mode: dataclasses.replace(config, aids=config.aids if observe else ())
            for mode, config in retargeter.configs.items()
        }
    )
    retargeter.reset(loop.state)
    sites = {"head": morphology.frames["head"]}

    def place() -> np.ndarray:
        return retargeter.problem.readings.compute_poses(loop.state.true_qpos, sites)["head"]

    goal = place()
    goal[:3] += [0.05, 0, -0.02]
    goal[3:] = quat_multiply(goal[3:], quat_from_rpy(0, 0.2, 0))
    misses = []
    for _ in range(75):
        plan = retargeter.plan(loop.state, Goal({"head": goal}, mode=Mode.STATIONARY))
        loop.execute(RobotAction(plan.command, Mode.STATIONARY, loop.action.arms), DT)
        turn = rotation_error(goal[3:], place()[3:])
        misses.append([*(place()[:3] - goal[:3]), *turn])
    retargeter.close()
    loop.close()
    mean = np.mean(misses[50:], axis=0)
    return float(np.linalg.norm(mean[:3])), float(np.linalg.norm(mean[3:]))


@pytest.mark.slow
def test_with_it_a_robot_has_no_steady_offset():
    without, with_it = lean(observe=False), lean(observe=True)
    assert with_it[0] < min(0.005, 0.5 * without[0])
    assert with_it[1] < min(0.01, 0.5 * without[1])


def test_a_servo_at_its_limit_may_be_far_from_its_command():
    """How much is counted on is a choice: a fifth of half the range, or all that is there."""
    rby1 = make_morphology("rby1")
    space, planning = rby1.command_space, build_model(rby1, "planning")
    model = CommandModel(planning, space, rby1.effects, rby1.pivot)
    index = space.index("torso_3")
    sagging = rby1.standing_qpos()
    sagging[planning.joint("torso_3").qposadr[0]] = space.neutral[index] - 0.6
    offsets = []
    for observer in (OffsetObserver(model), OffsetObserver(model, largest=1.0)):
        observer.reset(space.neutral)
        for tick in range(200):
            observer.update(DT * tick, sagging, space.neutral)
        offsets.append(observer.offset[index])
    half_range = (space.high - space.low)[index] / 2
    assert offsets[0] == pytest.approx(-0.2 * half_range)
    assert offsets[1] == pytest.approx(-0.6, abs=0.01)
