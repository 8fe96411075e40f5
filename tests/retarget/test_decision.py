"""The decision vector: the command's entries, then the arm joints, and which of them are free."""

from __future__ import annotations

import numpy as np
import pytest

from xop_lerobot.core.errors import UnknownName
from xop_lerobot.morphology.effect import Acts
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.retarget.arms.ik import ARM_MAX_RATE
from xop_lerobot.retarget.decision import ARM_LAG_S, DecisionSpace

ROBOTS = {"g1": 7 + 14, "rby1": 10 + 14}
robots = pytest.mark.parametrize("name", list(ROBOTS))


@pytest.fixture(scope="module")
def spaces() -> dict[str, DecisionSpace]:
    robots = {name: make_morphology(name) for name in ROBOTS}
    return {name: DecisionSpace(r, build_model(r, "planning")) for name, r in robots.items()}


@robots
def test_the_command_comes_first_then_all_arm_joints(spaces, name):
    decision, morphology = spaces[name], make_morphology(name)
    joints = tuple(joint for arm in morphology.arms for joint in arm.joints)
    assert len(decision.space) == ROBOTS[name]
    assert decision.space.names == (*morphology.command_space.names, *joints)
    assert decision.num_commands == len(morphology.command_space)
    assert decision.space.dims[: decision.num_commands] == morphology.command_space.dims


@robots
def test_arm_joints_have_the_models_ranges_and_follow_with_a_lag(spaces, name):
    decision, morphology = spaces[name], make_morphology(name)
    model, count = build_model(morphology, "planning"), decision.num_commands
    for i, joint in enumerate(decision.joints, start=count):
        dim, effect = decision.space.dims[i], decision.effects[i]
        np.testing.assert_array_equal([dim.low, dim.high], model.joint(joint).range)
        assert dim.neutral == morphology.arm_rest.get(joint, 0.0)
        assert (dim.unit, dim.key, dim.max_rate) == ("rad", f"{joint}.pos", ARM_MAX_RATE)
        assert (effect.acts, effect.joint, effect.lag_s) == (Acts.JOINT, joint, ARM_LAG_S)
    assert decision.effects[:count] == morphology.effects


@robots
def test_the_posture_goes_straight_and_neck_and_arms_at_their_own_rates(spaces, name):
    """An arm or a neck that has far to go slows no torso."""
    decision, rng = spaces[name], np.random.default_rng(0)
    space, count = decision.space, decision.num_commands
    missing = rng.uniform(-1, 1, len(space))
    alone = np.array([dim.alone for dim in space.dims])
    posture = np.flatnonzero(~(space.mobile_only | alone))
    limit = 0.04 * space.max_rate
    step = np.clip(missing, -limit, limit)
    near, far = missing.copy(), missing.copy()
    far[alone] *= 100
    straight = space.straighten(step, near)
    assert alone[count:].all()
    np.testing.assert_array_equal(straight[alone], step[alone])
    np.testing.assert_array_equal(straight[~alone], space.straighten(step, far)[~alone])
    shares = straight[posture] / missing[posture]
    np.testing.assert_allclose(shares, np.min(np.abs(step / missing)[posture]))
    np.testing.assert_array_equal(straight[space.mobile_only], step[space.mobile_only])


@robots
def test_an_empty_body_is_the_whole_command(spaces, name):
    mask = spaces[name].make_mask(())
    count = spaces[name].num_commands
    assert mask[:count].all()
    assert not mask[count:].any()


def test_a_body_is_what_it_names(spaces):
    decision = spaces["rby1"]
    body = make_morphology("rby1").variants["v2"].body
    assert len(body) == 13
    named = [decision.space.names[i] for i in np.flatnonzero(decision.make_mask(body))]
    assert tuple(named) == body


def test_an_unknown_entry_lists_the_known_ones(spaces):
    with pytest.raises(UnknownName) as caught:
        spaces["rby1"].make_mask(("torso_0", "torso_9"))
    assert str(caught.value).startswith("unknown command 'torso_9'. Known: head_0, head_1, left")
    assert str(caught.value).endswith("torso_5, v, yaw_rate")


@robots
def test_grippers_are_left_out(spaces, name):
    decision, morphology = spaces[name], make_morphology(name)
    rest = morphology.rest_action()
    joined = decision.join(rest.command, rest.arms)
    assert joined.shape == (ROBOTS[name],)
    np.testing.assert_array_equal(joined, decision.space.neutral)
    assert len(rest.arms) - len(decision.joints) == sum(bool(a.gripper) for a in morphology.arms)
