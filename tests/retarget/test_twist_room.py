"""How far the waist can turn before an arm is in the way."""

from __future__ import annotations

import mujoco
import pytest

from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.retarget.guidance.guidance import TwistRoom

TUCKED = {"arm_0": -0.05, "arm_1": 0.0, "arm_2": -0.2, "arm_3": -2.0}
"""Elbows at the body, forearms ahead, as for a box before the chest [rad]."""


@pytest.fixture(scope="module")
def rby1():
    return make_morphology("rby1")


@pytest.fixture
def model(rby1):
    return rby1.build_spec("full").compile()


@pytest.fixture
def room(rby1):
    return TwistRoom(rby1)


def tuck(rby1, model):
    qpos = rby1.standing_qpos()
    for side, sign in (("left", 1), ("right", -1)):
        for joint, angle in TUCKED.items():
            mirrored = angle * (sign if joint in ("arm_1", "arm_2") else 1)
            qpos[model.joint(f"{side}_{joint}").qposadr[0]] = mirrored
    return qpos


def touches(model, qpos, angle):
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    data.qpos[model.joint("torso_5").qposadr[0]] = angle
    mujoco.mj_forward(model, data)
    return bool((data.contact.dist < -0.01).any())


def test_arms_at_rest_leave_the_waist_its_range(rby1, model, room):
    assert room.compute(rby1.standing_qpos(), 0.0) == pytest.approx(model.joint("torso_5").range[1])


def test_tucked_elbows_do_not(rby1, model, room):
    qpos = tuck(rby1, model)
    free = room.compute(qpos, 0.0)
    assert 0.5 <= free < 1.5
    assert not touches(model, qpos, free)
    assert not touches(model, qpos, -free)
    assert touches(model, qpos, free + 0.35) or touches(model, qpos, -free - 0.35)


def test_where_the_base_is_and_how_the_waist_is_turned_do_not_matter(rby1, model, room):
    qpos = tuck(rby1, model)
    free = room.compute(qpos, 0.0)
    qpos[:2] = 3.0, -1.0
    qpos[model.joint("torso_5").qposadr[0]] = -0.7
    assert TwistRoom(rby1).compute(qpos, 0.0) == free


def test_an_arm_that_swings_past_is_not_in_the_way(rby1, model, room):
    rest, tucked = rby1.standing_qpos(), tuck(rby1, model)
    most = room.compute(rest, 0.0)
    assert room.compute(tucked, 0.5) == most
    assert room.compute(rest, 1.0) == most
    lasting = [room.compute(tucked, 1.0 + 0.1 * i) for i in range(1, 20)]
    assert lasting[0] == most
    assert lasting[-1] < 1.5


def test_an_elbow_that_is_pushed_aside_makes_no_room(rby1, model, room):
    tucked, pushed = tuck(rby1, model), rby1.standing_qpos()
    free = room.compute(tucked, 0.0)
    pushed[model.joint("torso_5").qposadr[0]] = free + 0.1
    assert room.compute(pushed, 1.0) == free
    pushed[model.joint("torso_5").qposadr[0]] = free - 0.3
    assert room.compute(pushed, 2.0) > free


def test_it_starts_anew(rby1, model, room):
    room.compute(rby1.standing_qpos(), 0.0)
    room.reset()
    assert room.compute(tuck(rby1, model), 0.1) < 1.5
