"""What the cost terms are given: the same places from rollouts and from configurations."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadValue
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.retarget.model.linearisation import Readings
from xop_lerobot.retarget.rollout import PolicyRollout

POLICIES = {"g1": "default", "rby1": "diff_drive"}
robots = pytest.mark.parametrize("name", list(POLICIES))


def predict(name: str, model) -> np.ndarray:
    """Sensor data of one sample over two steps, from standing. Shape (1, 3, n)."""
    morphology, policy = make_morphology(name), make_policy(POLICIES[name])
    rollout = PolicyRollout(model, policy, 1)
    rest = morphology.rest_action()
    commands = np.tile(rest.command, (1, 2, 1))
    memory = policy.initial_memory(1)[0]
    qpos, qvel = morphology.standing_qpos(), np.zeros(model.nv)
    sensed = rollout.predict(qpos, qvel, memory, commands, rest.arms, Mode.STATIONARY).sensordata
    rollout.close()
    return sensed


@robots
def test_sensors_and_kinematics_agree_where_a_rollout_starts(name):
    morphology = make_morphology(name)
    model = build_model(morphology, "planning")
    readings = Readings(morphology, model, morphology.hull_points)
    read = readings.read(predict(name, model), morphology.frames)
    placed = readings.place(morphology.standing_qpos()[None], morphology.frames)
    assert set(read.poses) == set(placed.poses) == set(morphology.frames)
    assert set(placed.points) == set(morphology.hull_points)
    assert set(read.points) == {*morphology.hull_points, *morphology.contact_points}
    assert set(read.velocities) == set(morphology.contact_points)
    for frame in morphology.frames:
        assert read.poses[frame].shape == (1, 3, 7)
        np.testing.assert_allclose(read.poses[frame][:, 0, :3], placed.poses[frame][:, :3])
    for site in morphology.hull_points:
        np.testing.assert_allclose(read.points[site][:, 0], placed.points[site], atol=1e-12)


def test_a_robot_that_balances_itself_pays_for_no_centre_of_mass():
    morphology = make_morphology("g1")
    model = build_model(morphology, "planning")
    readings = Readings(morphology, model, {})
    assert readings.place(morphology.standing_qpos()[None], morphology.frames).com.size == 0


@robots
def test_poses_and_centre_of_mass_of_one_configuration(name):
    morphology = make_morphology(name)
    readings = Readings(morphology, build_model(morphology, "planning"), {})
    qpos = morphology.standing_qpos()
    poses = readings.compute_poses(qpos, morphology.frames)
    batch = readings.place(qpos[None], morphology.frames)
    for frame, pose in poses.items():
        np.testing.assert_array_equal(pose, batch.poses[frame][0])
    if morphology.support:
        data = mujoco.MjData(readings._model)
        data.qpos[:] = qpos
        mujoco.mj_kinematics(readings._model, data)
        mujoco.mj_comPos(readings._model, data)
        com = data.body(morphology.base_body).subtree_com
        np.testing.assert_allclose(readings.compute_com(qpos), com, atol=1e-12)
        np.testing.assert_array_equal(readings.compute_com(qpos), batch.com[0])


def test_a_model_without_sensors_is_refused_when_it_is_read():
    morphology = make_morphology("rby1")
    model = morphology.build_spec("planning").compile()
    readings = Readings(morphology, model, {})
    with pytest.raises(BadValue, match=r"^the planning model has no sensor 'position:head'\. "):
        readings.read(np.zeros((1, 2, 0)), morphology.frames)
