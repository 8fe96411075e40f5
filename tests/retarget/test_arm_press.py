"""Hands that press: the force is felt, offsets are not learned from it, what is held goes along."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from xop_lerobot.core.transforms import make_pose, pose_multiply, quat_from_rpy
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.retarget.arms.contact import (
    CARRYING_S,
    HOLDING_S,
    MAX_SQUEEZE,
    MAX_YIELD,
    ArmBias,
    ArmHold,
    ArmLoad,
    ArmYield,
)

DT = 0.04
NO_TURN = np.array([1.0, 0, 0, 0])
LEFT, RIGHT = np.array([0.3, 0.15, 0.8]), np.array([0.3, -0.15, 0.8])
GOALS = {"left_wrist": make_pose(LEFT, NO_TURN), "right_wrist": make_pose(RIGHT, NO_TURN)}
SQUEEZE = np.array([[0, -20.0, 0], [0, 20.0, 0]])


@pytest.mark.parametrize("robot", ["g1", "rby1"])
def test_the_force_of_each_hand_is_felt_in_the_torques_of_its_arm(robot):
    morphology = make_morphology(robot)
    model = morphology.build_spec("full").compile()
    data = mujoco.MjData(model)
    data.qpos[:] = morphology.standing_qpos()
    mujoco.mj_forward(model, data)
    forces = np.array([[3.0, -20.0, 4.0], [-2.0, 15.0, -6.0]])
    torque = data.qfrc_bias.copy()  # holds the weight
    for arm, force in zip(morphology.arms, forces, strict=True):
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, data, jacobian, None, model.site(morphology.frames[arm.frame]).id)
        torque += jacobian.T @ force
    effort = np.zeros(model.nu)
    for arm in morphology.arms:
        for joint in arm.joints:
            index = model.actuator_trnid[:, 0].tolist().index(model.joint(joint).id)
            effort[index] = torque[model.joint(joint).dofadr[0]]
    load = ArmLoad(morphology)
    for _ in range(100):
        load.update(data.qpos, effort, DT)
    np.testing.assert_allclose(load.force, forces, atol=0.5)
    load.reset()
    load.update(data.qpos, np.zeros(model.nu), DT)  # nothing is measured
    np.testing.assert_array_equal(load.force, 0)


def test_an_arm_that_presses_learns_nothing_and_the_other_goes_on():
    bias = ArmBias(np.tile([-1.0, 1.0], (4, 1)), rest_s=0.0)
    for _ in range(200):
        bias.update(np.full(4, 0.1), np.zeros(4), DT, np.array([1.0, 1.0, 0.0, 0.0]))
    np.testing.assert_allclose(bias.bias, [0.1, 0.1, 0, 0], atol=1e-4)


def test_what_is_held_sways_with_the_body():
    hold, heads = ArmHold(), []
    for tick in range(200):
        sway = 0.03 * np.sin(2 * np.pi * 0.8 * tick * DT)
        heads.append(make_pose(np.array([0, sway, 1.2]), quat_from_rpy(sway, 0, 0)))
    for force, most in ((SQUEEZE, 0.5), (0 * SQUEEZE, 1.01)):
        hold.reset()
        against = []
        for head in heads:
            hold.update(force, RIGHT - LEFT)
            goals = hold.smooth(GOALS, head, head, DT)
            against.append(goals["left_wrist"][1] - head[1])
        free = np.ptp([LEFT[1] - head[1] for head in heads[50:]])
        swing = np.ptp(against[50:])
        assert swing < most * free
        assert force.any() or swing > 0.99 * free


def test_held_hands_follow_a_lasting_change_and_are_let_go_without_a_step():
    hold, head = ArmHold(), make_pose(np.array([0, 0, 1.2]), NO_TURN)
    up = make_pose(np.array([0, 0, 0.1]), NO_TURN)
    higher = {name: pose_multiply(up, pose) for name, pose in GOALS.items()}
    hold.update(SQUEEZE, RIGHT - LEFT)
    hold.smooth(GOALS, head, head, DT)
    heights = []
    for tick in range(100):
        if tick == round(HOLDING_S / DT):
            hold.update(0 * SQUEEZE, RIGHT - LEFT)  # let go half way
        heights.append(hold.smooth(higher, head, head, DT)["left_wrist"][2])
    assert np.diff(heights, prepend=0.8).max() < 0.02
    assert heights[-1] == pytest.approx(0.9)


def test_hands_that_push_apart_hold_nothing():
    hold = ArmHold()
    hold.update(-SQUEEZE, RIGHT - LEFT)
    assert not hold.is_holding
    hold.update(SQUEEZE, RIGHT - LEFT)
    assert hold.is_holding
    hold.update(0.15 * SQUEEZE, RIGHT - LEFT)  # 3 N still do
    assert hold.is_holding
    hold.update(0.05 * SQUEEZE, RIGHT - LEFT)
    assert not hold.is_holding


def test_who_walks_with_something_has_it_sway_with_the_body_all_the_more():
    swings = {}
    for walking in (False, True):
        hold, against = ArmHold(), []
        hold.update(SQUEEZE, RIGHT - LEFT)
        for tick in range(400):
            sway = 0.03 * np.sin(2 * np.pi * 0.8 * tick * DT)
            head = make_pose(np.array([0, sway, 1.2]), NO_TURN)
            goals = hold.smooth(GOALS, head, head, DT, walking=walking)
            against.append(goals["left_wrist"][1] - head[1])
        swings[walking] = np.ptp(against[200:])
    # First-order filters above their corner frequency.
    assert swings[True] / swings[False] == pytest.approx(HOLDING_S / CARRYING_S, rel=0.1)


def test_what_is_smoothed_does_not_tremble_with_the_head_that_was_measured():
    hold, rng = ArmHold(), np.random.default_rng(0)
    steady = make_pose(np.array([0, 0, 1.2]), NO_TURN)
    hold.update(SQUEEZE, RIGHT - LEFT)
    head, heights = steady, []
    for _ in range(200):
        head = steady + [0, 0, rng.normal(0, 0.005), 0, 0, 0, 0]
        heights.append(hold.smooth(GOALS, head, steady, DT)["left_wrist"][2])
    assert np.std(np.diff(heights)) < 0.001
    hold.reset()  # free hands are where they shall be in the world
    np.testing.assert_array_equal(
        hold.smooth(GOALS, head, steady, DT)["left_wrist"], GOALS["left_wrist"]
    )


def test_hands_that_squeeze_too_hard_give_way_until_they_do_not():
    stiffness, inside, felt, hands = 1e4, 0.01, 0.0, ArmYield()  # 100 N if nothing gave way
    force = 0.0
    for _ in range(200):
        force = stiffness * (inside - hands.displacement)
        felt += -np.expm1(-DT / 0.3) * (force - felt)
        hands.update(felt, DT)
    assert force == pytest.approx(MAX_SQUEEZE, rel=0.02)
    left, right = hands.part(LEFT, RIGHT)
    np.testing.assert_allclose(left - LEFT, [0, hands.displacement, 0])
    np.testing.assert_allclose(right - RIGHT, [0, -hands.displacement, 0])
    for _ in range(100):  # something less thick is between them
        hands.update(20.0, DT)
    assert hands.displacement == 0
    hands.update(1e6, 10.0)
    assert hands.displacement == MAX_YIELD
