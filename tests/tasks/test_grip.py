"""What hands hold does not creep out of them, however soft its sides are."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.tasks import furniture
from xop_lerobot.tasks.box_pick_and_place import BOX, BOX_FRICTION, BOX_MASS, COMPLIANCE
from xop_lerobot.tasks.stage import Stage

SQUEEZE = 60.0
RADIUS, TURN = 0.6, 0.9


def carry_round(duration: float, *, grip: bool) -> float:
    """Squeeze the box between two plates that go round with it, and measure how far it slides.

    Returns:
        Way outwards over the last `duration` seconds [m].
    """
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.005
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 100
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    arm = spec.worldbody.add_body(name="arm", pos=(0, 0, 1))
    arm.add_joint(name="turn", type=mujoco.mjtJoint.mjJNT_HINGE, axis=(0, 0, 1))
    arm.add_geom(size=(0.05, 0, 0), mass=50, contype=0, conaffinity=0)
    spec.add_actuator(target="turn", trntype=mujoco.mjtTrn.mjTRN_JOINT).set_to_velocity(kv=2000)
    for side in (1, -1):
        plate = arm.add_body(name=f"plate{side}", pos=(RADIUS, 0.15 * side, 0))
        plate.add_joint(
            name=f"press{side}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=(0, 1, 0), damping=50
        )
        plate.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=(0.05, 0.02, 0.03), mass=1)
        plate.add_site(name=f"palm{side}")
        press = spec.add_actuator(target=f"press{side}", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        press.set_to_motor()
    box = spec.worldbody.add_body(name="box", pos=(RADIUS, 0, 1))
    box.add_freejoint()
    geom = box.add_geom(name="box", type=mujoco.mjtGeom.mjGEOM_BOX, size=BOX, mass=BOX_MASS)
    geom.condim, geom.priority, geom.friction, geom.solref = 4, 1, BOX_FRICTION, COMPLIANCE
    if grip:
        furniture.add_grip(spec, geom, ("palm1", "palm-1"), BOX_FRICTION, COMPLIANCE)
    model = spec.compile()
    data = mujoco.MjData(model)
    start = 0.0
    while data.time < 3.0 + duration:
        data.ctrl[:] = [min(TURN, 0.5 * data.time), -SQUEEZE, SQUEEZE]
        mujoco.mj_step(model, data)
        if data.time < 3.0:
            start = math.hypot(*data.body("box").xpos[:2])
    return math.hypot(*data.body("box").xpos[:2]) - start


def test_a_box_that_is_carried_round_stays_between_the_hands():
    # With 54 N of friction on either side against 0.3 N, nothing should slide.
    assert 0 < carry_round(4.0, grip=True) < 0.006


def test_without_a_grip_soft_sides_let_it_creep():
    # The reason why there is `add_grip`; when this fails, MuJoCo has no need of it any more.
    assert carry_round(4.0, grip=False) > 0.04


@pytest.mark.parametrize("robot", ["g1", "rby1"])
def test_both_hands_hold_the_box_so(robot):
    model = Stage(make_morphology(robot), "box_pick_and_place").plant.model
    box = model.geom("box").id
    pairs = np.column_stack([model.pair_geom1, model.pair_geom2])
    assert len(pairs) >= 4
    assert (pairs == box).any(axis=1).all()
    others = np.where(pairs[:, 0] == box, pairs[:, 1], pairs[:, 0])
    names = {model.body(model.geom_bodyid[geom]).name for geom in others}
    assert {"left", "right"} == {
        side for side in ("left", "right") if any(side in name for name in names)
    }
    np.testing.assert_allclose(model.pair_solreffriction, [[0.01, 1.0]] * len(pairs))
    np.testing.assert_allclose(model.pair_solref, [COMPLIANCE] * len(pairs))
