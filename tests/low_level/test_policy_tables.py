"""Policies that are tables, beside plain readings of their published layouts, step by step."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import plain_policies as plain
import pytest
import toy_networks

from lerobot_robot_xop import XopG1, XopG1Config
from lerobot_robot_xop.config_xop import LowLevelConfig
from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import PolicyFileError
from xop_lerobot.low_level import tables
from xop_lerobot.low_level.factory import make_policy, resolve_policy
from xop_lerobot.low_level.joints import read_joints
from xop_lerobot.low_level.network_policy import MotorSet, NetworkPolicy, convert_targets
from xop_lerobot.low_level.tables import list_tables, load_policy
from xop_lerobot.morphology.morphology import make_morphology

SHARED = Path(os.environ.get("XOP_SHARED", Path(__file__).parents[2] / ".." / "shared"))
STAND, WALK = Mode.STATIONARY, Mode.MOBILE


def open_network(file: Path) -> Callable[..., Any]:
    """A network as the plain policies call it: one robot at a time."""
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    names = [each.name for each in session.get_inputs()]

    def call(*values: np.ndarray) -> Any:
        outputs = session.run(None, dict(zip(names, values, strict=True)))
        return outputs[0] if len(outputs) == 1 else outputs

    return call


State = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Position, velocity, command and arms of a robot, or of several as a batch."""


def make_states(steps: int, seed: int) -> list[State]:
    """Random states, commands and arm targets, walking fast enough to count as walking."""
    rng = np.random.default_rng(seed)
    standing = make_morphology("g1").standing_qpos()
    states = []
    for _ in range(steps):
        qpos = standing.copy()
        qpos[3:7] += rng.normal(0, 0.1, 4)
        qpos[3:7] /= np.linalg.norm(qpos[3:7])
        qpos[7:] += rng.normal(0, 0.2, 29)
        velocity = rng.uniform(0.2, 0.5, 3) * rng.choice([-1, 1], 3)
        command = np.concatenate([[rng.uniform(0.5, 0.74)], rng.uniform(0, 0.4, 3), velocity])
        states.append((qpos, rng.normal(0, 0.5, 35), command, rng.normal(0, 0.3, 14)))
    return states


LAYOUTS: dict[str, tuple[str, list[tuple[str, int, int]], Callable[..., Any], tuple[Mode, ...]]] = {
    "openwbt stands": ("openwbt", [("squat.onnx", 78, 12)], plain.PlainOpenWbtSquat, (STAND,)),
    "openwbt walks": ("openwbt", [("loco.onnx", 47, 12)], plain.PlainOpenWbtLoco, (WALK,)),
    "asap": ("asap", [("model_6600.onnx", 500, 12)], plain.PlainAsap, (STAND, WALK)),
    "homie": ("homie", [("deploy.onnx", 456, 12)], plain.PlainHomie, (STAND, WALK)),
    "holosoma": (
        "holosoma",
        [("fastsac_g1_29dof.onnx", 100, 29)],
        lambda network, clip: plain.PlainHolosoma(network, take_arms=True, clip=clip),
        (STAND, WALK),
    ),
    "groot_wbc": (
        "groot_wbc",
        [
            ("GR00T-WholeBodyControl-Balance.onnx", 516, 15),
            ("GR00T-WholeBodyControl-Walk.onnx", 516, 15),
        ],
        plain.PlainGrootWbc,
        (STAND, WALK),
    ),
}
"""By name: policy; its files with their inputs and outputs; the plain one; modes in turn."""


def write_networks(folder: Path, name: str) -> None:
    """Write made-up networks for all files of a policy."""
    others = {"openwbt": [("squat.onnx", 78, 12), ("loco.onnx", 47, 12)]}
    policy, files, _, _ = LAYOUTS[name]
    for seed, (file, inputs, outputs) in enumerate(others.get(policy, files)):
        write = toy_networks.write_recurrent if policy == "openwbt" else toy_networks.write_mlp
        write(folder / file, inputs, outputs, seed=seed)


def compare(name: str, folder: Path) -> None:
    """Run a table and the plain policy on the same states, 20 steps a mode, twice."""
    policy_name, files, make_plain, modes = LAYOUTS[name]
    policy = load_policy(policy_name, str(folder))
    reference = make_plain(*(open_network(folder / file) for file, _, _ in files), clip=True)
    memory = policy.initial_memory()
    for step, (qpos, qvel, command, arms) in enumerate(make_states(80, seed=1)):
        mode = modes[step // 20 % len(modes)]
        wanted = reference.step(qpos, qvel, command, arms, mode).targets
        targets, memory = policy.act(
            qpos[None], qvel[None], command[None], arms[None], memory, mode
        )
        np.testing.assert_allclose(targets[0], wanted, atol=1e-5, err_msg=f"step {step}")


@pytest.mark.parametrize("name", LAYOUTS)
def test_tables_do_what_the_published_layouts_do(name: str, tmp_path: Path) -> None:
    """With made-up weights, targets are those of the plain reading at every step."""
    write_networks(tmp_path, name)
    compare(name, tmp_path)


@pytest.mark.parametrize("name", ["openwbt stands", "openwbt walks", "asap", "homie"])
def test_tables_do_so_with_the_real_weights(name: str) -> None:
    """With the released weights, too."""
    folder = SHARED / "reference" / LAYOUTS[name][0]
    if not folder.is_dir():
        pytest.skip(f"the released weights of {LAYOUTS[name][0]} are not in XOP_SHARED")
    compare(name, folder)


TABLES = ("asap", "combined", "default", "falcon", "groot_wbc", "holosoma", "homie", "openwbt")
"""Tables whose files are ONNX or ship with the package; AMO's has a test of its own."""


@pytest.fixture(scope="module")
def made_up(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with made-up weights for every table."""
    folder = tmp_path_factory.mktemp("weights")
    for name in LAYOUTS:
        write_networks(folder, name)
    toy_networks.write_mlp(folder / "falcon_g1_29dof.onnx", 575, 29)
    return folder


def load_made_up(name: str, folder: Path) -> NetworkPolicy:
    """A policy with made-up weights; the one that ships has its own."""
    return load_policy(name, None if name == "default" else str(folder))


def stack(states: list[State]) -> State:
    """States of several robots as a batch."""
    qpos, qvel, command, arms = (np.stack(each) for each in zip(*states, strict=True))
    return qpos, qvel, command, arms


def test_every_table_that_ships_is_tested() -> None:
    """A new table is listed here too."""
    assert set(list_tables()) == {*TABLES, "amo"}


@pytest.mark.parametrize("name", TABLES)
def test_batches_modes_and_purity(name: str, made_up: Path) -> None:
    """A batch, with a mode each, does what its members do alone; inputs stay as they are."""
    policy, n = load_made_up(name, made_up), 4
    modes = np.array([STAND, WALK, STAND, WALK])
    together, alone = policy.initial_memory(n), [policy.initial_memory() for _ in range(n)]
    for step in range(6):
        states = make_states(n, seed=step)
        batch = stack(states)
        kept = [each.copy() for each in (*batch, together)]
        targets, after = policy.act(*batch, together, modes)
        for before, now in zip(kept, (*batch, together), strict=True):
            np.testing.assert_array_equal(before, now)
        assert not np.shares_memory(after, together)
        together = after
        for row in range(n):
            own, alone[row] = policy.act(*stack([states[row]]), alone[row], Mode(modes[row]))
            np.testing.assert_allclose(own[0], targets[row], atol=1e-5)
            np.testing.assert_allclose(alone[row][0], together[row], atol=1e-4)
        if step == 3:
            modes = modes[::-1].copy()


@pytest.mark.parametrize("name", ["openwbt", "combined"])
def test_a_hand_over_never_steps_the_targets(name: str, made_up: Path) -> None:
    """The first targets of the other network are the last ones of the first; then they go over."""
    policy = load_made_up(name, made_up)
    state = stack(make_states(1, seed=0))
    memory, history = policy.initial_memory(), []
    for step in range(60):
        targets, memory = policy.act(*state, memory, Mode(step // 20 % 2))
        history.append(targets[0])
    steps = np.abs(np.diff(history, axis=0)).max(axis=1)
    for change in (20, 40):
        assert steps[change - 1] < 1e-9
        assert steps[change : change + 10].max() > 0


def test_who_rests_goes_on_from_what_was_executed(made_up: Path) -> None:
    """FALCON remembers outputs that would have given what OpenWBT executed, and its frames."""
    policy, falcon = load_made_up("combined", made_up), load_made_up("falcon", made_up)
    memory, own = policy.initial_memory(), falcon.initial_memory()
    executed: list[np.ndarray] = []
    for seed in range(5):
        state = stack(make_states(1, seed=seed))
        _, own = falcon.act(*state, own, STAND)
        targets, memory = policy.act(*state, memory, STAND)
        executed.append(targets[0])
    theirs = memory[0, -falcon.memory_size :]
    legs = np.array([-0.1, 0, 0, 0.3, -0.2, 0] * 2) + 0.25 * theirs[:12]
    np.testing.assert_allclose(
        np.clip(legs, read_joints("g1").low[:12], read_joints("g1").high[:12]), executed[-1][:12]
    )
    frames, wanted = (each.reshape(4, 115)[:, 29:] for each in (theirs[29:], own[0, 29:]))
    np.testing.assert_allclose(frames, wanted)  # all but the outputs, which differ


def test_parts_bring_their_limits(made_up: Path) -> None:
    """Two policies as one have the arm limits of both, and in each mode the commands of one."""
    policy = load_made_up("combined", made_up)
    assert policy.arm_limits["left_shoulder_pitch_joint"] == (-3.0892, 1.5)
    assert policy.ranges[STAND]["height"] == (0.39, 0.75)
    assert policy.ranges[WALK]["height"] == (0.53, 0.78)
    assert load_made_up("homie", made_up).dead_zones == {"vx": 0.25, "vy": 0.2, "yaw_rate": 0.7}


def test_converted_targets_give_the_same_torque() -> None:
    """Other servos, the same torque at this angle and velocity."""
    rng = np.random.default_rng(0)
    of, to = (
        MotorSet(rng.uniform(20, 200, 29), rng.uniform(0.1, 5, 29), np.full(29, np.inf))
        for _ in range(2)
    )
    targets, q, v = rng.normal(0, 1, (3, 4, 29))
    other = convert_targets(targets, q, v, of, to)
    np.testing.assert_allclose(
        to.stiffness * (other - q) - to.damping * v, of.stiffness * (targets - q) - of.damping * v
    )


OWN = """
title = "a policy of my own"
robot = "g1"
license = "MIT"
source = "my laboratory"
stationary = "legs"
mobile = "legs"
arm_limits = { "*_elbow_joint" = [0.0, 1.5] }

[motors.stiffness]
"*_knee_joint" = 150.0

[networks.legs]
file = { name = "mine.onnx" }
default = { "*_knee_joint" = 0.3 }
sees = [
    { term = "commands", names = ["vx"], scale = 2.0 },
    { term = "gravity" },
    { term = "joint_positions", joints = ["legs"] },
    { term = "actions" },
]
action = { joints = ["legs"], scale = 0.5 }
"""


def write_own(folder: Path, text: str = OWN) -> Path:
    """Write a newcomer's policy: one file, beside the weights."""
    toy_networks.write_mlp(folder / "mine.onnx", 28, 12)
    table = folder / "mine.toml"
    table.write_text(text)
    return table


def test_a_newcomer_adds_a_policy_by_one_file(tmp_path: Path) -> None:
    """A table beside its weights is a policy, of the robot, the motors and the limits it names."""
    table = write_own(tmp_path)
    robot = XopG1(XopG1Config(low_level=LowLevelConfig(name=str(table)), cameras=[]))
    robot.connect()
    robot.get_observation()
    robot.disconnect()
    policy = make_policy(str(table))
    assert policy.name == "mine"
    assert policy.arm_limits == dict.fromkeys(("left_elbow_joint", "right_elbow_joint"), (0.0, 1.5))
    model = make_morphology("g1").build_spec("planning").compile()
    policy.adapt(model)
    assert model.actuator("left_knee_joint").gainprm[0] == 150
    assert model.actuator("left_hip_yaw_joint").gainprm[0] == 100
    state = stack(make_states(1, seed=0))
    legs = policy.act(*state, policy.initial_memory(), WALK).targets[0, :12]
    qpos, _, command, _ = (each[0] for each in state)
    x, y, z, w = qpos[[4, 5, 6, 3]]
    gravity = [2 * (w * y - x * z), -2 * (w * x + y * z), 2 * (x * x + y * y) - 1]
    default = np.array([0, 0, 0, 0.3, 0, 0] * 2)
    seen = np.concatenate([[2 * command[4]], gravity, qpos[7:19] - default, np.zeros(12)])
    raw = open_network(tmp_path / "mine.onnx")(seen[None].astype(np.float32))[0]
    low, high = read_joints("g1").low[:12], read_joints("g1").high[:12]
    np.testing.assert_allclose(legs, np.clip(default + 0.5 * raw, low, high), atol=1e-5)


MISTAKES = {
    'term = "gravity"': (
        'term = "gravitation"',
        "Invalid value 'gravitation' - at `$.networks[...].sees[1].term`. Known terms: actions, "
        "angular_velocity, commands, constant, cos, gravity, heading_error, joint_positions, "
        "joint_targets, joint_velocities, linear_velocity, past, reference, roll_pitch, sin, walks",
    ),
    "scale = 0.5": (
        "scal = 0.5",
        "Object contains unknown field `scal` - at `$.networks[...].action`",
    ),
    'license = "MIT"': ("", "Object missing required field `license`"),
    'joints = ["legs"] },\n    { term = "act': (
        'joints = ["leg*"] },\n    { term = "act',
        "network 'legs' with '{folder}/mine.onnx': 'leg*' fits no joint. Groups: all, legs, waist, "
        "arms; joints: left_hip_pitch_joint, ",
    ),
    'names = ["vx"]': (
        'names = ["v"]',
        "network 'legs' with '{folder}/mine.onnx': 'v' is no entry of the command. Known: height, "
        "waist_yaw, waist_roll, waist_pitch, vx, vy, yaw_rate",
    ),
    '    { term = "gravity" },\n': (
        "",
        "network 'legs' with '{folder}/mine.onnx': the network has 28 inputs, and its terms are 25 "
        "numbers: term commands 1, term joint_positions 12, term actions 12",
    ),
    'action = { joints = ["legs"]': (
        'action = { joints = ["waist"]',
        "network 'legs' with '{folder}/mine.onnx': the network has 12 outputs, and action.joints "
        "are 3 joints",
    ),
    '"*_elbow_joint" = [0.0, 1.5]': (
        '"*_knee_joint" = [0.0, 1.5]',
        "arm_limits names left_knee_joint, which is no joint of arms",
    ),
}


@pytest.mark.parametrize("right", MISTAKES)
def test_mistakes_in_a_table_are_named(right: str, tmp_path: Path) -> None:
    """What is wrong, where, and what there is."""
    wrong, message = MISTAKES[right]
    assert right in OWN
    table = write_own(tmp_path, OWN.replace(right, wrong))
    with pytest.raises(PolicyFileError) as error:
        make_policy(str(table))
    expected = f"policy table '{table}': {message.replace('{folder}', str(tmp_path))}"
    assert str(error.value).startswith(expected)


def test_a_policy_of_another_robot_is_refused(tmp_path: Path) -> None:
    """A G1's policy does not drive an RB-Y1."""
    table = write_own(tmp_path)
    with pytest.raises(PolicyFileError) as error:
        resolve_policy(make_morphology("rby1"), str(table))
    assert str(error.value) == f"policy table '{table}' is for robot 'g1', not 'rby1'"
    with pytest.raises(PolicyFileError, match="nowhere.toml' does not exist"):
        make_policy(str(tmp_path / "nowhere.toml"))


def describe_file(file: Path, **metadata: str) -> Path:
    """Write metadata into an ONNX file."""
    model = onnx.load(str(file))
    for key, value in metadata.items():
        model.metadata_props.append(onnx.StringStringEntryProto(key=key, value=value))
    onnx.save(model, str(file))
    return file


def test_a_file_that_describes_itself_needs_no_table(tmp_path: Path) -> None:
    """mjlab's metadata: terms with their scales and histories, gains, defaults, action scales."""
    names = read_joints("g1").names
    file = describe_file(
        toy_networks.write_mlp(tmp_path / "velocity.onnx", 3 + 3 * 2 + 29 * 3 + 29 + 29 + 3, 29),
        joint_names=",".join(names),
        joint_stiffness=",".join("40.179" for _ in names),
        joint_damping=",".join("2.558" for _ in names),
        default_joint_pos=",".join("0.1" for _ in names),
        observation_names="base_ang_vel,projected_gravity,joint_pos,joint_vel,actions,command",
        observation_terms_scale="0.2,1.0,1.0,0.05,1.0,2.0;2.0;0.25",
        observation_terms_history_length="0,2,3,0,0,0",
        observation_terms_clip=",".join("-inf;inf" for _ in range(6)),
        action_scale="0.4",
    )
    policy = make_policy(str(file))
    model = make_morphology("g1").build_spec("planning").compile()
    policy.adapt(model)
    np.testing.assert_allclose(model.actuator_gainprm[:, 0], 40.179)
    network = open_network(file)
    memory, gravities, angles, actions = policy.initial_memory(), [], [], np.zeros(29)
    low, high = read_joints("g1").low, read_joints("g1").high
    for state in make_states(8, seed=3):
        qpos, qvel, command, arms = state
        gravities.append(plain.compute_gravity(qpos))
        angles.append(qpos[7:] - 0.1)
        gravities = ([gravities[0]] * 2 + gravities)[-2:]  # the first frame fills the past
        angles = ([angles[0]] * 3 + angles)[-3:]
        seen = np.concatenate(
            [0.2 * qvel[3:6], *gravities, *angles, 0.05 * qvel[6:], actions,
             command[4:7] * [2, 2, 0.25]]
        )  # fmt: skip
        actions = network(seen[None].astype(np.float32))[0].astype(float)
        targets, memory = policy.act(*stack([state]), memory, WALK)
        wanted = np.concatenate([0.1 + 0.4 * actions[:15], arms])
        np.testing.assert_allclose(targets[0], np.clip(wanted, low, high), atol=1e-5)


def test_holosomas_file_brings_its_gains(tmp_path: Path) -> None:
    """holosoma's metadata says joints and gains; the layout is that of its table."""
    names = read_joints("g1").names
    file = describe_file(
        toy_networks.write_mlp(tmp_path / "mine.onnx", 100, 29),
        dof_names=json.dumps(names),
        kp=json.dumps([33.0] * 29),
        kd=json.dumps([1.5] * 29),
    )
    policy = make_policy(str(file))
    assert isinstance(policy, NetworkPolicy)
    np.testing.assert_array_equal(policy.motors.stiffness, np.full(29, 33.0))
    reference = plain.PlainHolosoma(open_network(file), take_arms=True, clip=True)
    state = make_states(1, seed=0)[0]
    targets, _ = policy.act(*stack([state]), policy.initial_memory(), STAND)
    np.testing.assert_allclose(targets[0], reference.step(*state, STAND).targets, atol=1e-5)


def test_files_that_describe_themselves_badly_are_named(tmp_path: Path) -> None:
    """No metadata, unknown terms, clips, joints of no robot."""
    bare = toy_networks.write_mlp(tmp_path / "bare.onnx", 3, 29)
    with pytest.raises(PolicyFileError, match=r"bare.onnx' does not describe itself: it holds nei"):
        make_policy(str(bare))
    common = {
        "joint_stiffness": "1", "joint_damping": "1", "default_joint_pos": "0", "action_scale": "1",
        "joint_names": ",".join(read_joints("g1").names), "observation_names": "projected_gravity",
    }  # fmt: skip
    wrong = {
        "'observation_names' has 'height_scan'. Known: actions, base_ang_vel, base_lin_vel, "
        "command, joint_pos, joint_vel, projected_gravity": {"observation_names": "height_scan"},
        "'observation_terms_clip' of projected_gravity is -5;5, expected -inf;inf": {
            "observation_terms_clip": "-5;5"
        },
        "names joints that no robot has: hip": {"joint_names": "hip"},
        "'joint_damping' has 2 numbers for 29 joints": {"joint_damping": "1,2"},
    }
    for number, (message, change) in enumerate(wrong.items()):
        file = toy_networks.write_mlp(tmp_path / f"{number}.onnx", 3, 29)
        describe_file(file, **common | change)
        with pytest.raises(PolicyFileError) as error:
            make_policy(str(file))
        assert str(error.value) == f"policy file '{file}': metadata {message}"


def test_licences_are_told_once(
    made_up: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At first use; loudly where use is restricted."""
    monkeypatch.setattr(tables, "_logged", set())
    caplog.set_level("INFO")
    for _ in range(2):
        load_policy("homie", str(made_up))
        load_policy("asap", str(made_up))
    told = [(record.levelname, record.message) for record in caplog.records]
    told = [each for each in told if "SHA-256" not in each[1]]
    assert told == [
        ("INFO", "HOMIE: licence CC-BY-NC-4.0, github.com/InternRobotics/OpenHomie"),
        (
            "WARNING",
            "HOMIE: NON-COMMERCIAL USE ONLY (CC BY-NC 4.0): its weights may not be used for "
            "commercial ends, nor may what is made from them",
        ),
        ("INFO", "ASAP: licence MIT, github.com/LeCAR-Lab/ASAP"),
    ]
