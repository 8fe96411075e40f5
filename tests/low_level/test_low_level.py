"""Low-level policies: files, purity, batches, and robots that stand, walk and drive with them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import requests

from benchmarks.low_level_comparison import make_simulation
from benchmarks.low_level_excitation import ExcitationConfig, make_excitation
from benchmarks.low_level_trial import BatchSimulation, run_trials
from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadShape, BadValue, PolicyFileError, UnknownName
from xop_lerobot.core.transforms import (
    compute_projected_gravity,
    quat_conjugate,
    quat_rotate,
    quat_to_rpy,
)
from xop_lerobot.low_level import policy_file
from xop_lerobot.low_level.base_drive import DiffDrive
from xop_lerobot.low_level.factory import POLICIES, make_policy
from xop_lerobot.low_level.joints import read_joints
from xop_lerobot.low_level.networks import LoadedNetwork, load_weights, save_weights
from xop_lerobot.low_level.policy import LowLevelPolicy, PolicyOutput
from xop_lerobot.low_level.tables import find_table, load_policy, read_table
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_model

SHARED = Path(os.environ.get("XOP_SHARED", Path(__file__).parents[2] / ".." / "shared"))
FALCON_FILE = read_table(find_table("falcon")).networks["whole_body"].file
WEIGHTS = find_table("default").parents[1] / "weights" / "g1_student.npz"
STAND = np.array([0.75, 0, 0, 0, 0, 0, 0])


def find_teacher() -> str:
    """Return FALCON's file, or skip."""
    candidates = (
        SHARED / "reference" / "falcon" / "falcon_g1_29dof.onnx",
        policy_file.cache_folder() / FALCON_FILE.name,
    )
    for file in candidates:
        if file.is_file():
            return str(file)
    pytest.skip("FALCON's network is neither in XOP_SHARED nor in the cache")


@pytest.fixture(params=["default", "falcon", "diff_drive"], scope="module")
def policy(request: pytest.FixtureRequest) -> LowLevelPolicy:
    """Every policy of the registry."""
    return make_policy(request.param, find_teacher() if request.param == "falcon" else None)


type Inputs = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def make_inputs(policy: LowLevelPolicy, n: int, seed: int = 0) -> Inputs:
    """Random states, commands and arms of the robot that `policy` fits."""
    rng = np.random.default_rng(seed)
    morphology = make_morphology("rby1" if policy.name == "diff_drive" else "g1")
    qpos = np.tile(morphology.standing_qpos(), (n, 1))
    qpos[:, 7:] += rng.normal(0, 0.1, (n, qpos.shape[1] - 7))
    qpos[:, 3:7] += rng.normal(0, 0.1, (n, 4))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    space = morphology.command_space
    command = rng.uniform(space.low, space.high, (n, len(space)))
    arms = morphology.rest_action().arms + rng.normal(0, 0.1, (n, len(morphology.arm_names)))
    qvel = rng.normal(0, 0.3, (n, build_model(morphology, "planning").nv))
    memory = rng.normal(0, 0.3, (n, policy.memory_size))
    return qpos, qvel, command, arms, memory


ROOT = Path(__file__).parents[2]


def test_unknown_policy_is_named_with_the_known_ones() -> None:
    """A wrong name lists what there is."""
    with pytest.raises(UnknownName) as error:
        make_policy("falkon")
    assert str(error.value) == (f"unknown low-level policy 'falkon'. Known: {', '.join(POLICIES)}")


def test_every_default_of_a_robot_is_registered() -> None:
    """What a morphology names can be made without a file."""
    for robot in ("g1", "rby1"):
        name = make_morphology(robot).policies[0]
        assert make_policy(name).name == name


def test_batch_equals_one_by_one(policy: LowLevelPolicy) -> None:
    """A batch is the same as its members alone, in both modes."""
    inputs = make_inputs(policy, 7)
    for mode in Mode:
        together = policy.act(*inputs, mode)
        for row in range(7):
            qpos, qvel, command, arms, memory = (array[row : row + 1] for array in inputs)
            alone = policy.act(qpos, qvel, command, arms, memory, mode)
            np.testing.assert_allclose(together.targets[row], alone.targets[0], atol=2e-5)
            np.testing.assert_allclose(together.memory[row], alone.memory[0], atol=2e-5)


def test_policy_is_pure(policy: LowLevelPolicy) -> None:
    """No hidden state: inputs stay, what was asked between does not matter, nothing is shared."""
    inputs = make_inputs(policy, 3)
    kept = [array.copy() for array in inputs]
    first = policy.act(*inputs, Mode.MOBILE)
    for array, copy in zip(inputs, kept, strict=True):
        np.testing.assert_array_equal(array, copy)
    policy.act(*make_inputs(policy, 3, seed=1), Mode.STATIONARY)
    again = policy.act(*inputs, Mode.MOBILE)
    np.testing.assert_array_equal(first.targets, again.targets)
    np.testing.assert_array_equal(first.memory, again.memory)
    for output in first:
        for array in inputs:
            assert not np.shares_memory(output, array)


def test_sizes(policy: LowLevelPolicy) -> None:
    """Targets fit the model's actuators and memory its announced size."""
    inputs = make_inputs(policy, 2)
    robot = make_morphology("rby1" if policy.name == "diff_drive" else "g1")
    output = policy.act(*inputs[:4], policy.initial_memory(2), Mode.STATIONARY)
    assert isinstance(output, PolicyOutput)
    assert output.targets.shape == (2, build_model(robot, "planning").nu)
    assert output.memory.shape == (2, policy.memory_size)
    with pytest.raises(BadShape, match=r"arms must have shape \(2, "):
        policy.act(*inputs[:3], np.zeros((2, 3)), inputs[4], Mode.STATIONARY)


def test_joints_are_those_of_the_model() -> None:
    """Order, limits, groups and patterns of the joints."""
    morphology, joints = make_morphology("g1"), read_joints("g1")
    model = build_model(morphology, "planning")
    assert joints.names == tuple(model.actuator(i).name for i in range(model.nu))
    np.testing.assert_array_equal(joints.low, model.actuator_ctrlrange[:, 0])
    np.testing.assert_array_equal(joints.high, model.actuator_ctrlrange[:, 1])
    assert [joints.names[joint] for joint in joints.arms] == list(morphology.arm_names)
    assert joints.select(["legs"]) == list(range(12))
    assert joints.select(["waist", "right_knee_joint"]) == [12, 13, 14, 9]
    assert joints.spread({"all": 1.0, "*_knee_joint": 2.0}, 0.0).sum() == 31
    with pytest.raises(BadValue, match=r"'\*_toe' fits no joint. Groups: all, legs, waist, arms; "):
        joints.select(["*_toe"])
    with pytest.raises(BadValue, match="left_knee_joint is named twice by legs, left_knee_joint"):
        joints.select(["legs", "left_knee_joint"])


def test_projected_gravity_is_the_rotated_one() -> None:
    """The closed form equals R(q)^T (0, 0, -1)."""
    quat = np.random.default_rng(0).normal(size=(20, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    plain = quat_rotate(quat_conjugate(quat), np.array([0, 0, -1.0]))
    np.testing.assert_allclose(compute_projected_gravity(quat), plain, atol=1e-12)


DEFAULT_LEGS = np.array([-0.1, 0, 0, 0.3, -0.2, 0] * 2)


def test_observation_of_the_student() -> None:
    """Each number of a frame is at its place, scaled; older frames come before it."""
    policy = load_policy("default")
    inputs = make_inputs(policy, 2)
    qpos, qvel, command, arms, memory = inputs
    now = policy.observe(*inputs, Mode.MOBILE)
    assert now.shape == (2, 575)
    np.testing.assert_allclose(now[:, :460], memory[:, 29:], rtol=1e-6)
    frame = now[:, 460:]
    np.testing.assert_allclose(frame[:, :29], memory[:, :29], rtol=1e-6)
    np.testing.assert_allclose(frame[:, 29:32], qvel[:, 3:6] / 4, rtol=1e-6)
    np.testing.assert_allclose(frame[:, 32:36], command[:, [6, 0, 4, 5]] * [1, 2, 1, 1], rtol=1e-6)
    assert (frame[:, 36] == 1).all()
    np.testing.assert_allclose(frame[:, 37:40], command[:, 1:4], rtol=1e-6)
    angles = frame[:, 40:69].copy()
    angles[:, :12] += DEFAULT_LEGS
    angles[:, 13:15] += command[:, 2:4]  # waist roll and pitch are relative to the command
    np.testing.assert_allclose(angles, qpos[:, 7:], atol=1e-6)
    np.testing.assert_allclose(frame[:, 69:98], qvel[:, 6:] / 20, rtol=1e-6)
    np.testing.assert_allclose(frame[:, 101:], arms, rtol=1e-6)
    assert (policy.observe(*inputs, Mode.STATIONARY)[:, 460 + 36] == 0).all()


class Says(LoadedNetwork):
    """A network that always says the same."""

    def __init__(self, value: float) -> None:
        self.num_inputs, self.num_outputs, self._value = 575, 29, value

    def __call__(
        self, observation: np.ndarray, hidden: np.ndarray, past: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        return np.full((len(observation), 29), self._value, np.float32), hidden


def test_memory_holds_the_last_output_and_four_frames_oldest_first() -> None:
    """After k steps the memory is the last output and the frames of the last four steps."""
    policy, frames = load_policy("default"), []
    memory = policy.initial_memory(1)
    for step in range(7):
        inputs = make_inputs(policy, 1, seed=step)[:4]
        frames.append(policy.observe(*inputs, memory, Mode.STATIONARY)[0, -115:])
        _, memory = policy.act(*inputs, memory, Mode.STATIONARY)
    np.testing.assert_allclose(memory[0, 29:], np.concatenate(frames[-4:]), atol=1e-6)


def test_waist_beyond_its_joints_is_not_seen_as_an_error() -> None:
    """The joints' angles are shown less what the joints can take of the command."""
    policy, joints = load_policy("default"), read_joints("g1")
    qpos, qvel, command, arms, memory = make_inputs(policy, 1)
    command[:, 2:4] = -0.3, 1.0
    frame = policy.observe(qpos, qvel, command, arms, memory, Mode.STATIONARY)[:, -115:]
    shown = qpos[:, 20:22] - [-0.3, joints.high[14]]
    np.testing.assert_allclose(frame[:, 53:55], shown, atol=1e-6)
    np.testing.assert_allclose(frame[:, 38:40], [[-0.3, 1.0]], atol=1e-6)


def test_targets_stay_within_the_limits_and_waist_tilt_is_direct() -> None:
    """A wild output is clipped; waist roll and pitch get the commanded angle."""
    policy, joints = load_policy("default", network=Says(80.0)), read_joints("g1")
    qpos, qvel, command, arms, memory = make_inputs(policy, 1)
    command[:] = [0.75, 0, 0.2, -0.3, 0, 0, 0]
    targets = policy.act(qpos, qvel, command, arms, memory, Mode.STATIONARY).targets
    np.testing.assert_array_equal(np.delete(targets, [13, 14]), np.delete(joints.high, [13, 14]))
    np.testing.assert_array_equal(targets[0, 13:15], [0.2, -0.3])


@pytest.mark.parametrize("name", ["default", "falcon"])
def test_g1_stands_and_walks(name: str) -> None:
    """G1 stands for 4 s where it is, and walks for 4 s about as fast as asked."""
    policy = make_policy(name, find_teacher() if name == "falcon" else None)
    simulation = make_simulation(2, threads=1)
    command = np.array([STAND, STAND + [0, 0, 0, 0, 0.5, 0, 0]])
    mode, memory = np.array([Mode.STATIONARY, Mode.MOBILE]), policy.initial_memory(2)
    arms = np.tile(make_morphology("g1").rest_action().arms, (2, 1))
    for _ in range(200):
        targets, memory = policy.act(simulation.qpos, simulation.qvel, command, arms, memory, mode)
        simulation.step(targets)
        assert not simulation.fallen().any()
    position = simulation.qpos[:, :3]
    assert np.linalg.norm(position[0, :2]) < 0.15
    assert abs(position[0, 2] - 0.75) < 0.03
    assert 1.2 < position[1, 0] < 2.4
    simulation.close()


def test_g1_bears_a_load() -> None:
    """2 kg in each hand, stretched ahead in 0.4 s: it stands, high and low, and stays."""
    morphology = make_morphology("g1")
    model = build_model(morphology, "planning")
    for side in ("left", "right"):
        hand = model.body(f"{side}_wrist_yaw_link").id
        model.body_inertia[hand] *= 1 + 2.0 / model.body_mass[hand]
        model.body_mass[hand] += 2.0
    mujoco.mj_setConst(model, mujoco.MjData(model))
    heights = np.array([0.75, 0.75, 0.65, 0.55, 0.45])
    n, policy = len(heights), make_policy("default")
    simulation = BatchSimulation([model] * n, morphology.standing_qpos(), threads=1)
    rest, memory = morphology.rest_action().arms, policy.initial_memory(n)
    ahead = rest.copy()
    for side in ("left", "right"):
        ahead[morphology.arm_names.index(f"{side}_shoulder_pitch_joint")] = -1.4
        ahead[morphology.arm_names.index(f"{side}_elbow_joint")] = 1.3
    command, start = np.tile(STAND, (n, 1)), simulation.qpos[:, :2].copy()
    for step in range(400):
        command[:, 0] = np.maximum(heights, 0.75 - 0.005 * step)
        share = np.clip((step - 100) / 20, 0, 1)
        arms = np.tile(rest + share * (ahead - rest), (n, 1))
        targets, memory = policy.act(
            simulation.qpos, simulation.qvel, command, arms, memory, Mode.STATIONARY
        )
        simulation.step(targets)
        assert not simulation.fallen().any()
    assert np.linalg.norm(simulation.qpos[:, :2] - start, axis=1).max() < 0.2
    simulation.close()


@pytest.mark.slow
def test_g1_stops_in_any_phase_of_its_gait() -> None:
    """From 1 m/s, with the arms held ahead as operators do: no fall, hardly a way back."""
    n, policy = 16, make_policy("default")
    space = make_morphology("g1").fit(policy).command_space
    simulation, memory = make_simulation(n, threads=1), policy.initial_memory(n)
    names, arms = make_morphology("g1").arm_names, make_morphology("g1").rest_action().arms
    for side in ("left", "right"):
        arms[names.index(f"{side}_shoulder_pitch_joint")] = -1.2
        arms[names.index(f"{side}_elbow_joint")] = 1.2
    stop = 70 + 2 * np.arange(n)  # one phase after the other, over 0.64 s
    command, mode = np.tile(STAND, (n, 1)), np.full(n, Mode.MOBILE)
    places = []
    for step in range(300):
        for i in range(n):
            wanted = STAND + np.array([0, 0, 0, 0, 0.0 if step >= stop[i] else 1.0, 0, 0])
            stops = space.stop_rate if step >= stop[i] else space.max_rate
            command[i] += np.clip(wanted - command[i], -stops * 0.02, stops * 0.02)
            if step >= stop[i] and command[i, 4] < 1e-9:
                mode[i] = Mode.STATIONARY
        targets, memory = policy.act(
            simulation.qpos, simulation.qvel, command, np.tile(arms, (n, 1)), memory, mode
        )
        simulation.step(targets)
        assert not simulation.fallen().any()
        places.append(simulation.qpos[:, 0].copy())
    back = np.max(places, axis=0) - places[-1]
    assert back.max() < 0.2
    simulation.close()


def test_g1_squats_and_leans() -> None:
    """The pelvis follows height and pitch, the waist its three angles, and the feet stay."""
    policy, simulation = make_policy("default"), make_simulation(4, threads=1)
    final = np.array(
        [
            [0.6, 0, 0, 0, 0, 0, 0],
            [0.45, 0, 0, 0, 0, 0, 0],
            [0.75, 0.6, 0.15, 0.3, 0, 0, 0],
            [0.7, 0, 0, 1.0, 0, 0, 0],
        ]
    )
    arms = np.tile(make_morphology("g1").rest_action().arms, (4, 1))
    memory = policy.initial_memory(4)
    for step in range(350):
        command = STAND + min(step / 75, 1) * (final - STAND)
        targets, memory = policy.act(
            simulation.qpos, simulation.qvel, command, arms, memory, Mode.STATIONARY
        )
        simulation.step(targets)
    assert not simulation.fallen().any()
    np.testing.assert_allclose(simulation.qpos[:, 2], final[:, 0], atol=0.03)
    np.testing.assert_allclose(simulation.qpos[2, 19:22], [0.6, 0.15, 0.3], atol=0.12)
    pitch = quat_to_rpy(simulation.qpos[:, 3:7])[:, 1]
    np.testing.assert_allclose(pitch[[0, 2, 3]], [0, 0, 0.5], atol=0.12)
    assert np.linalg.norm(simulation.qpos[:, :2], axis=1).max() < 0.2
    assert np.abs(simulation.qvel[:, :2]).max() < 0.02
    simulation.close()


def test_g1_stands_with_arms_anywhere() -> None:
    """Random arm postures, high and low: nobody falls or walks off."""
    n = 12
    joints = read_joints("g1")
    low, high = joints.low[joints.arms], joints.high[joints.arms]
    spread = np.random.default_rng(0).uniform(-0.8, 0.8, (n, 14))
    postures = (low + high) / 2 + spread * (high - low) / 2
    rest = make_morphology("g1").rest_action().arms
    policy, simulation = make_policy("default"), make_simulation(n, threads=1)
    memory = policy.initial_memory(n)
    command = np.tile(STAND, (n, 1))
    for step in range(300):
        command[:, 0] = np.maximum(np.where(np.arange(n) % 2, 0.6, 0.75), 0.75 - 0.005 * step)
        arms = rest + min(step / 75, 1) * (postures - rest)
        targets, memory = policy.act(
            simulation.qpos, simulation.qvel, command, arms, memory, Mode.STATIONARY
        )
        simulation.step(targets)
    assert not simulation.fallen().any()
    assert np.linalg.norm(simulation.qpos[:, :2], axis=1).max() < 0.15
    simulation.close()


def test_balance_stands_without_falcon() -> None:
    """The teacher's own balance: at its height, leaning, under forces, and dead still."""
    from scripts.low_level_teacher import Balance

    n, balance = 4, Balance()
    rest = make_morphology("g1").rest_action().arms
    height, lean = np.array([0.78, 0.5, 0.42, 0.7]), np.array([0.0, 0.0, 0.5, 0.3])
    force = np.zeros((n, 2, 3))
    force[3, :, 1] = 10.0
    simulation, soles = make_simulation(n, threads=1), []
    for step in range(250):
        now = np.maximum(height, 0.78 - 0.005 * step)
        share = min(step / 75, 1)
        state = simulation.qpos, simulation.qvel
        measured = balance.body.measure(*state)
        legs = balance.compute(*state, measured, now, share * lean, np.zeros((n, 2)), share * force)
        targets = np.tile(np.concatenate([np.zeros(15), rest]), (n, 1))
        targets[:, :12] = legs.targets
        simulation.step(targets, share * force)
        soles.append(measured.soles)
    assert not simulation.fallen().any()
    np.testing.assert_allclose(simulation.qpos[:, 2], height, atol=0.01)
    pitch = quat_to_rpy(simulation.qpos[:, 3:7])[:, 1]
    np.testing.assert_allclose(pitch[[0, 2, 3]], lean[[0, 2, 3]], atol=0.05)
    assert np.abs(soles[-1] - soles[0]).max() < 0.02
    assert np.abs(simulation.qvel[:3]).max() < 0.01  # unless pulled, dead still
    simulation.close()


def test_teacher_steps_when_pushed_and_stands_again() -> None:
    """A push out of the support is FALCON's; once the feet are still the balance acts again."""
    from scripts.low_level_teacher import ACTIONS, Teacher

    teacher, simulation = Teacher(find_teacher()), make_simulation(2, threads=1)
    rest = np.tile(make_morphology("g1").rest_action().arms, (2, 1))
    memory, share, shares = teacher.initial_memory(2), np.zeros(2), []
    command, mode = np.tile(STAND, (2, 1)), np.full(2, Mode.STATIONARY)
    for step in range(250):
        if step == 50:
            simulation.push(np.array([[0.8, 0.0], [0.0, 0.0]]))
        state = simulation.qpos, simulation.qvel
        taught = teacher.teach(
            state, state, command, rest, memory, mode, np.zeros((2, 2, 3)), share
        )
        memory, share = taught.memory, taught.share
        memory[:, ACTIONS] = taught.actions
        simulation.step(taught.targets)
        shares.append(share)
    assert not simulation.fallen().any()
    assert np.min(shares[50:], axis=0)[0] == 0
    assert np.min(shares[50:], axis=0)[1] == 1
    np.testing.assert_array_equal(share, 1)
    assert simulation.qpos[0, 0] > 0.15
    assert np.abs(simulation.qvel[:, :3]).max() < 0.01
    simulation.close()


def test_skip_is_folded_into_the_layers(tmp_path: Path) -> None:
    """A saved student does what the one in training did, and can be trained further."""
    import torch

    from scripts.distill_low_level import Network

    torch.manual_seed(0)
    observations = torch.randn(50, 575) * torch.rand(575)
    network = Network((16, 8), observations)
    torch.nn.init.normal_(network.skip.weight, 0, 0.05)
    hidden = np.zeros((50, 0), np.float32)
    expected, _ = network(observations.numpy(), hidden)
    save_weights(tmp_path / "student.npz", *network.layers())
    layers = load_weights(tmp_path / "student.npz")
    plain = observations.numpy()
    for weight, bias in zip(*layers, strict=True):
        plain = plain @ weight + bias
        if weight is not layers[0][-1]:
            plain = np.where(plain > 0, plain, np.expm1(np.minimum(plain, 0)))
    np.testing.assert_allclose(plain, expected, atol=1e-4)
    again = Network((16, 8), 2 * observations + 1)
    again.load(*layers)
    np.testing.assert_allclose(again(observations.numpy(), hidden)[0], expected, atol=1e-4)


def test_trials_count_falls_and_errors() -> None:
    """A policy that holds still falls when pushed hard; the student does not when it is not."""
    rng = np.random.default_rng(0)
    hard = ExcitationConfig(push=2.0, push_period=0.5)
    excitation = make_excitation(rng, 4, 200, hard)
    simulation = make_simulation(4, threads=1)
    assert run_trials(load_policy("default", network=Says(0.0)), simulation, excitation).falls == 4
    easy = make_excitation(rng, 4, 200, ExcitationConfig(push=0.0, arm_range=0.2))
    result = run_trials(make_policy("default"), simulation, easy)
    assert result.falls == 0
    assert result.height_rmse < 0.05
    assert result.planar_rmse < 0.4
    simulation.close()


def test_excitation_is_reproducible_and_within_its_ranges() -> None:
    """Same seed, same sequences; commands and arms within what was asked."""
    config = ExcitationConfig()
    first, again = (make_excitation(np.random.default_rng(3), 5, 300, config) for _ in range(2))
    np.testing.assert_array_equal(first.command, again.command)
    np.testing.assert_array_equal(first.push, again.push)
    assert first.command[..., 0].min() >= 0.5 and first.command[..., 0].max() <= 0.75
    assert np.abs(first.command[..., 1]).max() <= config.waist_yaw
    joints = read_joints("g1")
    assert (first.arms >= joints.low[15:]).all()
    assert (first.arms <= joints.high[15:]).all()
    assert np.abs(first.push).max() > 0


def test_shipped_weights_are_small() -> None:
    """At most 3 MB, float32."""
    assert WEIGHTS.stat().st_size <= 3_000_000
    with np.load(WEIGHTS) as arrays:
        assert {arrays[key].dtype for key in arrays.files} == {np.dtype("float32")}


def test_student_file_errors(tmp_path: Path) -> None:
    """A missing, malformed or misshapen file of weights is named."""
    missing = tmp_path / "none.npz"
    with pytest.raises(PolicyFileError) as error:
        make_policy("default", str(missing))
    assert str(error.value) == (
        f"policy file '{missing}' does not exist. Give the default policy's g1_student.npz, or the "
        "folder that holds it, with --robot.low_level.path=PATH, or no path"
    )
    text = tmp_path / "text.npz"
    text.write_text("not weights")
    with pytest.raises(PolicyFileError, match="is not an .npz of arrays"):
        make_policy("default", str(text))
    narrow = tmp_path / "narrow.npz"
    save_weights(narrow, [np.zeros((100, 29))], [np.zeros(29)])
    with pytest.raises(PolicyFileError) as error:
        make_policy("default", str(narrow))
    assert str(error.value) == (
        f"policy table '{find_table('default')}': network 'whole_body' with '{narrow}': the "
        "network has 100 inputs, and its terms are 575 numbers: term past 460, term actions 29, "
        "term angular_velocity 3, term commands 4, term walks 1, term commands 1, term commands 2, "
        "term joint_positions 29, term joint_velocities 29, term gravity 3, term joint_targets 14"
    )
    broken = tmp_path / "broken.npz"
    save_weights(broken, [np.zeros((575, 4)), np.zeros((5, 29))], [np.zeros(4), np.zeros(29)])
    with pytest.raises(PolicyFileError, match="each layer must take what the one before gives"):
        make_policy("default", str(broken))


def test_weights_round_trip(tmp_path: Path) -> None:
    """What is saved is loaded, in float32."""
    rng = np.random.default_rng(0)
    weights, biases = (
        [rng.normal(size=(575, 4)), rng.normal(size=(4, 29))],
        [np.ones(4), np.ones(29)],
    )
    save_weights(tmp_path / "w.npz", weights, biases)
    loaded, _ = load_weights(tmp_path / "w.npz")
    for saved, back in zip(weights, loaded, strict=True):
        np.testing.assert_array_equal(saved.astype(np.float32), back)


def write_onnx(file: Path, inputs: int) -> Path:
    """Write a one-layer network with a fixed batch of one."""
    import onnx

    from xop_lerobot.low_level.networks import build_mlp

    model = build_mlp([np.zeros((inputs, 29), np.float32)], [np.zeros(29, np.float32)])
    for tensor in (*model.graph.input, *model.graph.output):
        tensor.type.tensor_type.shape.dim[0].dim_value = 1
    onnx.save(model, str(file))
    return file


def test_missing_path_is_named(tmp_path: Path) -> None:
    """A path that leads nowhere is an error, no download."""
    missing = tmp_path / "falcon.onnx"
    with pytest.raises(PolicyFileError) as error:
        make_policy("falcon", str(missing))
    assert str(error.value) == (
        f"policy file '{missing}' does not exist. Give FALCON's falcon_g1_29dof.onnx, or the "
        "folder that holds it, with --robot.low_level.path=PATH, or no path"
    )


def test_offline_names_three_ways(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Absent and offline: the error says how to provide the file."""

    def refuse(*_: object, **__: object) -> None:
        raise requests.ConnectionError("no network")

    monkeypatch.setattr(policy_file, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(requests, "get", refuse)
    with pytest.raises(PolicyFileError) as error:
        make_policy("falcon")
    assert str(error.value) == (
        "FALCON's falcon_g1_29dof.onnx is not on this machine and could not be downloaded "
        "(ConnectionError). Three ways to provide it: (1) --robot.low_level.path=PATH with a copy "
        "of falcon_g1_29dof.onnx, or its folder; (2) put it into the cache as "
        f"'{tmp_path / FALCON_FILE.name}'; (3) be online once, it is downloaded from "
        f"{FALCON_FILE.url}. Or use --robot.low_level.name=default, which ships with the package."
    )


def test_what_cannot_be_downloaded_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A policy whose files are published nowhere that we may fetch from."""
    monkeypatch.setattr(policy_file, "cache_folder", lambda: tmp_path)
    with pytest.raises(PolicyFileError) as error:
        make_policy("amo")
    assert str(error.value) == (
        "AMO's amo_jit.pt is not on this machine, and it can't be downloaded. Two ways to provide "
        "it: (1) --robot.low_level.path=PATH with a copy of amo_jit.pt, or its folder; (2) put it "
        f"into the cache as '{tmp_path / 'amo' / 'amo_jit.pt'}'."
    )


def test_downloaded_file_is_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A download of another checksum is refused and not kept."""

    class Answer:
        headers: dict[str, str] = {"content-length": "5"}

        def raise_for_status(self) -> None: ...

        def close(self) -> None: ...

        def iter_content(self, chunk_size: int) -> list[bytes]:
            return [b"wrong"]

    monkeypatch.setattr(policy_file, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(requests, "get", lambda *_, **__: Answer())
    with pytest.raises(PolicyFileError, match=f"does not have SHA-256 {FALCON_FILE.sha256}"):
        make_policy("falcon")
    assert not (tmp_path / FALCON_FILE.name).exists()


def test_altered_cache_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cached file of another checksum is refused."""
    cached = write_onnx(tmp_path / FALCON_FILE.name, 575)
    monkeypatch.setattr(policy_file, "cache_folder", lambda: tmp_path)
    with pytest.raises(PolicyFileError) as error:
        make_policy("falcon")
    assert str(error.value) == (
        f"policy file '{cached}' has SHA-256 {policy_file.compute_sha256(cached)}, expected "
        f"{FALCON_FILE.sha256}. Delete it, and it will be downloaded again."
    )


def test_given_file_of_other_checksum_is_used_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """One may train one's own FALCON; a fixed batch of one is made free."""
    policy = make_policy("falcon", str(write_onnx(tmp_path / "own.onnx", 575)))
    assert "not that of the released FALCON" in caplog.text
    inputs = make_inputs(policy, 4)
    assert policy.act(*inputs, Mode.MOBILE).targets.shape == (4, 29)


def test_wrong_shape_or_format(tmp_path: Path) -> None:
    """A network of other inputs or outputs, or a file that is no network, is named."""
    wrong = write_onnx(tmp_path / "wrong.onnx", 47)
    with pytest.raises(PolicyFileError, match="the network has 47 inputs, and its terms are 575"):
        make_policy("falcon", str(wrong))
    text = tmp_path / "text.onnx"
    text.write_text("not a network")
    with pytest.raises(PolicyFileError, match="is not an ONNX model"):
        make_policy("falcon", str(text))
    with pytest.raises(PolicyFileError, match=r"must end in .npz, .onnx, .pt, got '.txt'"):
        make_policy("falcon", str(text.rename(tmp_path / "text.txt")))


@pytest.mark.slow
def test_distillation_runs_from_a_teacher_file(tmp_path: Path) -> None:
    """The script makes loadable weights."""
    out = tmp_path / "student.npz"
    small = "--robots 8 --steps 20 --updates 3 --final-updates 2 --batch 32 --rounds 1"
    script = [sys.executable, "-m", "scripts.distill_low_level"]
    command = [*script, "--teacher", find_teacher(), *small.split()]
    subprocess.run(
        [*command, "--out", str(out)], check=True, capture_output=True, timeout=300, cwd=ROOT
    )
    weights, _ = load_weights(out)
    assert [w.shape for w in weights] == [(575, 541), (541, 285), (285, 29)]


@pytest.mark.slow
def test_benchmark_of_policies_writes_a_table(tmp_path: Path) -> None:
    """Policies side by side; what the file of results holds is not run again."""
    page, results = tmp_path / "page.md", tmp_path / "results.json"
    page.write_text("a\n<!-- policies -->\nold\n<!-- end of policies -->\nb\n")
    script = [sys.executable, "-m", "benchmarks.run_policies"]
    command = [*script, "--trials", "2", "--seconds", "1", "--json", str(results)]
    command += ["--policies", "default", str(find_table("default")), "--docs", str(page)]
    for parts in ("sequences", "speed,sequences"):
        done = subprocess.run(
            [*command, "--parts", parts],
            check=True,
            capture_output=True,
            text=True,
            timeout=300,
            cwd=ROOT,
        )
    assert "sequences done" not in done.stderr
    facts = json.loads(results.read_text())
    assert facts["default"] == facts[str(find_table("default"))] | {
        "speed": facts["default"]["speed"]
    }
    table = page.read_text()
    assert "| | default | " in table
    assert "| the published ranges | 0 · " in table
    assert "| batch of 30 | " in table
    wrong = subprocess.run(
        [*command, "--parts", "spead"],
        check=False,
        capture_output=True,
        text=True,
        timeout=300,
        cwd=ROOT,
    )
    assert wrong.stderr == (
        "error: unknown part 'spead'. Known: arms, commands, mpc, sequences, speed\n"
    )


def test_wheel_speeds_by_hand() -> None:
    """1 m/s forward is 10 rad/s on both wheels, backwards about their axes; turning differs."""
    drive = make_morphology("rby1").drive
    assert drive is not None
    speeds = drive.compute_speeds(np.array([1.0, 0.0]), np.zeros(2), np.array([0.0, 1.0]))
    right, left = speeds.T
    assert list(drive.wheels) == ["right_wheel", "left_wheel"]
    np.testing.assert_allclose(right, [-10.0, -2.65])
    np.testing.assert_allclose(left, [-10.0, 2.65])


def test_rby1_drives_as_commanded() -> None:
    """On the planning model the base moves and turns at the commanded speeds; the body holds."""
    morphology = make_morphology("rby1")
    model = build_model(morphology, "planning")
    data, policy = mujoco.MjData(model), make_policy("diff_drive")
    data.qpos[:] = morphology.standing_qpos()
    rest = morphology.rest_action()
    command = rest.command.copy()
    space = morphology.command_space
    command[space.index("v")], command[space.index("yaw_rate")] = 0.4, 0.5
    for _ in range(100):
        targets, _ = policy.act(
            data.qpos[None], data.qvel[None], command[None], rest.arms[None],
            np.zeros((1, 0)), Mode.MOBILE,
        )  # fmt: skip
        data.ctrl[:] = targets[0]
        mujoco.mj_step(model, data, 4)
    body = quat_rotate(quat_conjugate(data.qpos[3:7]), data.qvel[:3])
    assert abs(data.qvel[5] - 0.5) < 0.05
    assert abs(body[0] - 0.4) < 0.05
    for name, target in zip(morphology.arm_names[:14], rest.arms, strict=False):
        assert abs(data.joint(name).qpos[0] - target) < 0.03


def test_diff_drive_maps_by_name_and_clips() -> None:
    """Torso, neck and arm targets reach the actuator of their name, within its range."""
    morphology, policy = make_morphology("rby1"), DiffDrive()
    model = build_model(morphology, "planning")
    qpos, qvel, command, arms, memory = make_inputs(policy, 1)
    for joint, target in (("torso_1", 9.0), ("head_0", -0.4), ("head_1", 0.3)):
        command[0, morphology.command_space.index(joint)] = target
    targets = policy.act(qpos, qvel, command, arms, memory, Mode.MOBILE).targets[0]
    named = {model.actuator(i).name: targets[i] for i in range(model.nu)}
    assert named["torso_1"] == model.actuator("torso_1").ctrlrange[1]
    assert (named["head_0"], named["head_1"]) == (-0.4, 0.3)
    for name, value in zip(morphology.arm_names, arms[0], strict=True):
        low, high = model.actuator(name).ctrlrange
        assert named[name] == np.clip(value, low, high)


def test_diff_drive_takes_no_file() -> None:
    """A path is an error."""
    with pytest.raises(PolicyFileError) as error:
        make_policy("diff_drive", "x.onnx")
    assert str(error.value) == "low-level policy 'diff_drive' has no file, got 'x.onnx'"
