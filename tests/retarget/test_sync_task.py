"""Residuals of the state synchronisation: derivatives against finite differences, equilibrium."""

from __future__ import annotations

import mink
import mujoco
import numpy as np
import pytest
import toy_robot

from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.morphology.contacts import Feet, Wheels
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.rby1m import MecanumWheels
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.retarget.sync.config import SyncConfig
from xop_lerobot.retarget.sync.contacts import compute_equilibrium, make_contacts
from xop_lerobot.retarget.sync.filters import (
    ContactVelocity,
    compute_disagreement,
    project_velocity,
)
from xop_lerobot.retarget.sync.task import SyncTask


class GlidingToy(toy_robot.Toy):
    """Wheels whose turning the model leaves out: their contact points are on the base."""

    contact_kind = Wheels()


MORPHOLOGIES = {
    "g1": lambda: make_morphology("g1"),
    "rby1": lambda: make_morphology("rby1"),
    "rby1m": lambda: make_morphology("rby1m"),
    "toy": toy_robot.Toy,
    "rolling toy": toy_robot.RollingToy,
    "gliding toy": GlidingToy,
}


@pytest.fixture(scope="module", params=MORPHOLOGIES)
def robot(request):
    morphology = MORPHOLOGIES[request.param]()
    return morphology, build_model(morphology, "planning")


def make_task(robot, kind=SyncTask):
    morphology, model = robot
    contacts = make_contacts(morphology, model)
    task = kind(model, contacts, morphology.contact_kind, SyncConfig())
    rng = np.random.default_rng(0)
    rows = morphology.contact_kind.rows
    task.set_measurement(disturb(model, morphology.standing_qpos(), rng, 0.3))
    stance = rng.normal(size=(len(contacts), 3))
    task.set_active(range(len(contacts)), [rng.uniform(0.1, 1, rows) for _ in contacts], stance)
    return task


def disturb(model, qpos, rng, size=0.2):
    moved = qpos.copy()
    mujoco.mj_integratePos(model, moved, rng.normal(size=model.nv) * size, 1.0)
    return moved


def check_jacobian(task, model, qpos, step=1e-6):
    """Largest difference of a task's Jacobian to central finite differences of its error."""
    configuration = mink.Configuration(model, qpos)
    jacobian = task.compute_jacobian(configuration)
    differences = np.empty_like(jacobian)
    for dof in range(model.nv):
        direction = np.zeros(model.nv)
        direction[dof] = step
        ahead = task.compute_error(mink.Configuration(model, configuration.integrate(direction, 1)))
        back = task.compute_error(mink.Configuration(model, configuration.integrate(direction, -1)))
        differences[:, dof] = (ahead - back) / (2 * step)
    return np.abs(jacobian - differences).max()


def test_every_jacobian_equals_finite_differences(robot):
    task, model = make_task(robot), robot[1]
    for seed in range(3):
        qpos = disturb(model, robot[0].standing_qpos(), np.random.default_rng(seed))
        assert check_jacobian(task, model, qpos) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("block", ["base", "joints", "contact"])
def test_a_wrong_jacobian_is_caught(robot, block):
    class WrongTask(SyncTask):
        def compute_jacobian(self, configuration):
            jacobian = super().compute_jacobian(configuration)
            row = {"base": 4, "joints": 7, "contact": self.model.nv}[block]
            jacobian[row] *= 1.001
            return jacobian

    qpos = disturb(robot[1], robot[0].standing_qpos(), np.random.default_rng(0))
    assert check_jacobian(make_task(robot, WrongTask), robot[1], qpos) > 1e-5


def test_the_weighted_residual_is_that_of_the_task(robot):
    task, model = make_task(robot), robot[1]
    configuration = mink.Configuration(model, robot[0].standing_qpos())
    jacobian, error, damping = task.compute_qp_residual(configuration)
    slow = mink.Task.compute_qp_residual(task, configuration)
    np.testing.assert_allclose(jacobian, slow[0], atol=1e-12)
    np.testing.assert_allclose(error, slow[1], atol=1e-12)
    assert damping == slow[2] == 0


def test_residuals_are_those_of_the_paper():
    """G1 tilted about its sole's centre: position, flatness and heading have known values."""
    robot = make_morphology("g1"), build_model(make_morphology("g1"), "planning")
    model = robot[1]
    qpos = compute_equilibrium(model, robot[0].standing_qpos())
    task = make_task(robot)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    places = task.compute_places(data)
    places[0, 0] -= 0.01
    places[1, 2] -= 0.2
    task.set_measurement(qpos)
    task.set_active((0, 1), [np.ones(7)] * 2, places)
    error = task.compute_error(mink.Configuration(model, qpos))
    expected = np.zeros(model.nv + 14)
    expected[model.nv] = 0.01
    expected[-1] = 0.2
    np.testing.assert_allclose(error, expected, atol=1e-5)


@pytest.mark.parametrize("name", ["g1", "rby1", "toy", "rolling toy"])
def test_the_ground_bears_the_weight_in_equilibrium(name):
    morphology = MORPHOLOGIES[name]()
    model = build_model(morphology, "planning")
    data = mujoco.MjData(model)
    data.qpos[:] = compute_equilibrium(model, morphology.standing_qpos())
    mujoco.mj_forward(model, data)
    first = int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)
    contact = data.efc_type[: data.nefc] >= first
    force = np.where(contact, data.efc_D * data.efc_aref, 0)
    wrench = np.zeros(model.nv)
    mujoco.mj_mulJacTVec(model, data, wrench, force)
    weight = model.body_mass.sum() * 9.81
    assert wrench[2] == pytest.approx(weight, rel=1e-3)
    depths = [-data.contact[i].dist for i in range(data.ncon)]
    assert 1e-5 < min(depths)
    assert max(depths) < 2e-3


def test_a_robot_over_the_ground_is_lowered_to_it():
    morphology = toy_robot.Toy()
    model = build_model(morphology, "planning")
    high = morphology.standing_qpos()
    high[2] += 0.01
    rest = compute_equilibrium(model, high)
    np.testing.assert_allclose(
        rest, compute_equilibrium(model, morphology.standing_qpos()), atol=1e-6
    )


def test_a_model_without_ground_is_left_as_it_is():
    morphology = toy_robot.Toy()
    model = morphology.build_spec("planning").compile()
    qpos = morphology.standing_qpos()
    np.testing.assert_array_equal(compute_equilibrium(model, qpos), qpos)


def test_points_of_a_foot_must_be_sites_of_one_body():
    class Scattered(toy_robot.Toy):
        contact_groups = (("foot_0", "head"),)

    class Unknown(toy_robot.Toy):
        contact_groups = (("foot_9",),)

    model = build_model(toy_robot.Toy(), "planning")
    with pytest.raises(BadValue, match=r"^contact points \['foot_0', 'head'\] must be on one body"):
        make_contacts(Scattered(), model)
    with pytest.raises(UnknownName, match=r"^unknown site 'foot_9'\. Known: foot_0, "):
        make_contacts(Unknown(), model)


# -- velocities --------------------------------------------------------------------------------


def test_contact_velocity_equals_finite_differences(robot):
    """Of the material point that touches the ground, as the robot moves for a microsecond."""
    morphology, model = robot
    contacts = make_contacts(morphology, model)
    velocity = ContactVelocity(model, contacts, morphology.contact_kind, SyncConfig())
    rng = np.random.default_rng(0)
    data = mujoco.MjData(model)
    qpos, qvel = disturb(model, morphology.standing_qpos(), rng, 0.05), rng.normal(size=model.nv)
    for index, contact in enumerate(contacts):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        jacobian = velocity.compute_jacobian(data, index)
        rotation = data.xmat[contact.body].reshape(3, 3)
        point = data.xpos[contact.body] + rotation @ contact.point
        axle = rotation @ contact.axis
        if contact.rolls:
            point[2] -= contact.radius
        local = rotation.T @ (point - data.xpos[contact.body])
        ends = []
        for sign in (1, -1):
            moved = qpos.copy()
            mujoco.mj_integratePos(model, moved, qvel, sign * 1e-6)
            data.qpos[:] = moved
            mujoco.mj_kinematics(model, data)
            ends.append(data.xpos[contact.body] + data.xmat[contact.body].reshape(3, 3) @ local)
        speed = (ends[0] - ends[1]) / 2e-6
        got = jacobian @ qvel
        if isinstance(morphology.contact_kind, MecanumWheels):
            np.testing.assert_allclose(got, [speed[2]], atol=1e-6)
        elif isinstance(morphology.contact_kind, Wheels) and not contact.rolls:
            np.testing.assert_allclose(got, [axle @ speed, speed[2]], atol=1e-6)
        else:
            np.testing.assert_allclose(got[:3], speed, atol=1e-6)
        if isinstance(morphology.contact_kind, Feet):  # the foot turns as a rigid body
            data.qpos[:] = qpos
            mujoco.mj_fwdPosition(model, data)
            data.qvel[:] = qvel
            mujoco.mj_fwdVelocity(model, data)
            turn = np.zeros(6)
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, contact.body, turn, 0)
            np.testing.assert_allclose(got[3:], turn[:3], atol=1e-9)


def test_the_projection_is_the_least_squares_solution():
    rng = np.random.default_rng(0)
    nv, m = 12, 5
    qvel, jacobian = rng.normal(size=nv), rng.normal(size=(m, nv))
    variance, constraint = rng.uniform(0.1, 1, nv), rng.uniform(0.1, 1, m)
    projected, left = project_velocity(qvel, variance, jacobian, constraint)
    stacked = np.concatenate(
        [np.diag(1 / np.sqrt(variance)), jacobian / np.sqrt(constraint)[:, None]]
    )
    target = np.concatenate([qvel / np.sqrt(variance), np.zeros(m)])
    np.testing.assert_allclose(projected, np.linalg.lstsq(stacked, target)[0], atol=1e-12)
    np.testing.assert_allclose(left, np.diag(np.linalg.inv(stacked.T @ stacked)), atol=1e-12)


def test_without_contacts_the_velocity_stays():
    qvel, variance = np.arange(4.0), np.ones(4)
    projected, left = project_velocity(qvel, variance, np.zeros((0, 4)), np.zeros(0))
    np.testing.assert_array_equal(projected, qvel)
    np.testing.assert_array_equal(left, variance)


def test_disagreement_is_one_on_average_for_a_contact_that_holds():
    rng = np.random.default_rng(0)
    nv, m = 12, 6
    jacobian, variance = rng.normal(size=(m, nv)), rng.uniform(0.1, 1, nv)
    constraint = np.full(m, 1e-6)
    # Velocities of a body that holds (J v = 0), seen under noise.
    null = np.linalg.svd(jacobian)[2][m:]
    samples = [
        compute_disagreement(
            null.T @ rng.normal(size=nv - m) + rng.normal(size=nv) * np.sqrt(variance),
            variance, jacobian, constraint,
        )
        for _ in range(2000)
    ]  # fmt: skip
    assert np.mean(samples) == pytest.approx(1, abs=0.05)


def test_wheels_roll_without_slipping():
    """Driving straight at 0.4 m/s: wheel speed times radius; sideways nothing."""
    morphology = make_morphology("rby1")
    model = build_model(morphology, "planning")
    contacts = make_contacts(morphology, model)
    velocity = ContactVelocity(model, contacts, Wheels(), config=SyncConfig())
    data = mujoco.MjData(model)
    data.qpos[:] = compute_equilibrium(model, morphology.standing_qpos())
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    for index, contact in enumerate(contacts):
        assert contact.rolls
        jacobian = velocity.compute_jacobian(data, index)
        qvel = np.zeros(model.nv)
        qvel[0] = 0.4
        wheel = model.jnt_dofadr[model.body_jntadr[contact.body]]
        qvel[wheel] = -0.4 / contact.radius  # the wheels turn about -Y
        np.testing.assert_allclose(jacobian @ qvel, 0, atol=1e-3)
        qvel[1] = 0.1
        assert (jacobian @ qvel)[1] == pytest.approx(0.1, abs=1e-3)
    level = velocity.compute_level_jacobian(data)
    np.testing.assert_allclose(level[:, 3:6], np.eye(3)[:2], atol=1e-3)
