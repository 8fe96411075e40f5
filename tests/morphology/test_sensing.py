"""What rollouts read off the planning model: MuJoCo's own sensors, read by name."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadValue
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.low_level.policy import POLICY_DT
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.morphology.sensing import Sensing
from xop_lerobot.retarget.rollout import PolicyRollout

POLICIES = {"g1": "default", "rby1": "diff_drive"}
robots = pytest.mark.parametrize("name", list(POLICIES))
K, H = 3, 4


class Rolled:
    """A rollout of a robot, and the same by hand: one `mj_step` after the other."""

    def __init__(self, name: str) -> None:
        self.morphology = make_morphology(name)
        self.model = build_model(self.morphology, "planning")
        self.policy = make_policy(POLICIES[name])
        space, rest = self.morphology.command_space, self.morphology.rest_action()
        rng = np.random.default_rng(0)
        noise = 0.3 * (space.high - space.low) / 2 * rng.normal(size=(K, H, len(space)))
        self.commands = np.clip(space.neutral + noise, space.low, space.high)
        self.arms = rest.arms
        self.qpos, self.qvel = self.morphology.standing_qpos(), np.zeros(self.model.nv)
        self.qvel[:6] = 0.1 * rng.normal(size=6)
        self.memory = self.policy.initial_memory(1)[0]
        rollout = PolicyRollout(self.model, self.policy, 1)
        self.sensed = rollout.predict(
            self.qpos, self.qvel, self.memory, self.commands, self.arms, Mode.MOBILE
        ).sensordata
        rollout.close()

    def step_by_hand(self) -> tuple[np.ndarray, np.ndarray]:
        """States one physics step before the end of each control step. Shapes (K, H, ...)."""
        model, data = self.model, mujoco.MjData(self.model)
        substeps = round(POLICY_DT / model.opt.timestep)
        qpos, qvel = np.tile(self.qpos, (K, 1)), np.tile(self.qvel, (K, 1))
        memory, arms = np.tile(self.memory, (K, 1)), np.tile(self.arms, (K, 1))
        before = np.empty((K, H, model.nq)), np.empty((K, H, model.nv))
        for k in range(H):
            targets, memory = self.policy.act(
                qpos, qvel, self.commands[:, k], arms, memory, Mode.MOBILE
            )
            for i in range(K):
                mujoco.mj_resetData(model, data)
                data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[i], qvel[i], targets[i]
                for _ in range(substeps):
                    before[0][i, k], before[1][i, k] = data.qpos, data.qvel
                    mujoco.mj_step(model, data)
                qpos[i], qvel[i] = data.qpos, data.qvel
        return before

    def place(self, qpos: np.ndarray, qvel: np.ndarray) -> mujoco.MjData:
        data = mujoco.MjData(self.model)
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(self.model, data)
        mujoco.mj_subtreeVel(self.model, data)
        return data


@pytest.fixture(scope="module")
def rolled() -> dict[str, Rolled]:
    return {name: Rolled(name) for name in POLICIES}


def check_readings(rolled: Rolled, sensed: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> None:
    """One state's readings against kinematics, velocities by `mj_objectVelocity`."""
    sensing, model = Sensing(rolled.model), rolled.model
    data = rolled.place(qpos, qvel)
    morphology = rolled.morphology
    for site in morphology.frames.values():
        pose, quat = sensing.read_pose(sensed, site), np.empty(4)
        mujoco.mju_mat2Quat(quat, data.site(site).xmat)
        np.testing.assert_allclose(pose[:3], data.site(site).xpos, atol=1e-9)
        assert abs(pose[3:] @ quat) == pytest.approx(1, abs=1e-12)
    for site in (*morphology.contact_points, *morphology.hull_points):
        got = sensing.read_position(sensed, site)
        np.testing.assert_allclose(got, data.site(site).xpos, atol=1e-9)
    for site in morphology.contact_points:
        both = np.empty(6)
        kind = mujoco.mjtObj.mjOBJ_SITE
        mujoco.mj_objectVelocity(model, data, kind, model.site(site).id, both, 0)
        np.testing.assert_allclose(sensing.read_velocity(sensed, site), both[3:], atol=1e-9)


@robots
def test_a_rollout_senses_one_physics_step_before_the_end_of_each_control_step(rolled, name):
    r = rolled[name]
    qpos, qvel = r.step_by_hand()
    for i, k in np.ndindex(K, H):
        check_readings(r, r.sensed[i, k + 1], qpos[i, k], qvel[i, k])
    assert np.ptp(r.sensed[:, -1], axis=0).max() > 1e-3  # the samples do differ


@robots
def test_the_first_reading_is_of_the_start(rolled, name):
    r = rolled[name]
    for i in range(K):
        check_readings(r, r.sensed[i, 0], r.qpos, r.qvel)


@robots
def test_leading_dimensions_are_any(rolled, name):
    r = rolled[name]
    sensing, site = Sensing(r.model), r.morphology.frames["head"]
    assert sensing.read_pose(r.sensed, site).shape == (K, H + 1, 7)
    assert sensing.read_position(r.sensed[0, 0], site).shape == (3,)


@robots
def test_sensors_do_not_touch_the_physics(rolled, name):
    r = rolled[name]
    ends = []
    for disabled in (0, int(mujoco.mjtDisableBit.mjDSBL_SENSOR)):
        model = build_model(r.morphology, "planning")
        model.opt.disableflags |= disabled
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = r.qpos, r.qvel
        mujoco.mj_step(model, data, 4)
        ends.append(np.concatenate([data.qpos, data.qvel]))
    np.testing.assert_array_equal(*ends)


def test_a_model_without_sensors_is_told_what_to_do():
    morphology = make_morphology("g1")
    sensing = Sensing(morphology.build_spec("planning").compile())
    with pytest.raises(BadValue) as caught:
        sensing.read_position(np.zeros(0), "head")
    assert str(caught.value) == (
        "the planning model has no sensor 'position:head'. Make it with "
        "build_model(morphology, 'planning'), or call add_sensing on your own spec"
    )
