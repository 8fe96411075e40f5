"""AMO's adapter with networks made for the test, beside a plain reading of its deployment."""

from collections import deque

import mujoco
import numpy as np
import pytest
import torch

from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import PolicyFileError
from xop_lerobot.core.transforms import quat_from_yaw
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.morphology.morphology import make_morphology

FILES = ("amo_jit.pt", "adapter_jit.pt", "adapter_norm_stats.pt")
SEEN = [*range(19), *range(22, 26)]
"""Joints that it sees, among the robot's 29: no wrists."""
DEFAULT_POSTURE = np.array(
    [-0.1, 0, 0, 0.3, -0.2, 0] * 2 + [0.0] * 3 + [0.5, 0, 0.2, 0.3, 0.5, 0, -0.2, 0.3]
)
SIZES = (1043, 25 * 93, 12, 15)


class ToyPolicy(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.now = torch.nn.Linear(SIZES[0], 15)
        self.past = torch.nn.Linear(SIZES[1], 15)

    def forward(self, observation: torch.Tensor, history: torch.Tensor) -> torch.Tensor:
        return torch.tanh(self.now(observation) + self.past(history))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("amo")
    torch.manual_seed(0)
    torch.jit.script(ToyPolicy()).save(str(path / FILES[0]))
    torch.jit.script(torch.nn.Linear(SIZES[2], SIZES[3])).save(str(path / FILES[1]))
    rng = np.random.default_rng(0)
    names = {"input_mean": 12, "input_std": 12, "output_mean": 15, "output_std": 15}
    torch.save({name: rng.uniform(0.5, 1, size) for name, size in names.items()}, path / FILES[2])
    return path


class Deployment:
    """What the published deployment script does, one robot and one step at a time."""

    def __init__(self, folder):
        self.policy, self.adapter = (torch.jit.load(str(folder / name)) for name in FILES[:2])
        self.norm = torch.load(folder / FILES[2], weights_only=False)
        self.last = np.zeros(23)
        self.stands, self.gait = True, np.array([0.25, 0.25])
        self.short: deque[np.ndarray] = deque([np.zeros(93)] * 10, maxlen=10)
        self.long: deque[np.ndarray] = deque([np.zeros(93)] * 25, maxlen=25)

    def step(self, qpos, qvel, height, torso, vx, vy, heading, arms):
        w, x, y, z = qpos[3:7]
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = np.arcsin(2 * (w * y - z * x))
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        turn = 0.0 if self.stands else np.remainder(yaw - heading + np.pi, 2 * np.pi) - np.pi
        q, v = qpos[7:][SEEN], qvel[6:][SEEN]
        upper = q[15:]
        wanted = np.concatenate([[height], torso, upper])
        wanted = (wanted - self.norm["input_mean"]) / (self.norm["input_std"] + 1e-8)
        with torch.no_grad():
            output = self.adapter(torch.tensor(wanted[None]).float()).numpy()[0]
        output = output * self.norm["output_std"] + self.norm["output_mean"]
        frame = np.concatenate(
            [qvel[3:6] * 0.25, [roll, pitch], [np.sin(turn), np.cos(turn)], q - DEFAULT_POSTURE,
             v * 0.05, self.last, np.sin(self.gait * 2 * np.pi), output]
        )  # fmt: skip
        past = np.array(self.short).flatten()
        demand = np.zeros(17)
        demand[:8] = np.concatenate([arms[0:4], arms[7:11]])
        demand[8:10], demand[11:14], demand[14:] = (vx, vy), torso, height
        self.stands = abs(vx) < 0.1
        self.short.append(frame)
        self.long.append(frame)
        seen = np.concatenate([frame, demand, np.zeros(3), past])
        with torch.no_grad():
            raw = self.policy(
                torch.tensor(seen[None]).float(),
                torch.tensor(np.array(self.long).reshape(1, -1)).float(),
            ).numpy()[0]
        self.last = np.concatenate([raw, np.zeros(8)])
        self.gait = np.remainder(self.gait + 0.02 * 1.3, 1.0)
        near = np.abs(self.gait - 0.25) < 0.05
        if self.stands and near.any():
            self.gait = np.array([0.25, 0.25])
        if not self.stands and near.all():
            self.gait = np.array([0.25, 0.75])
        return DEFAULT_POSTURE[:15] + 0.25 * raw


def test_it_does_what_its_deployment_does(folder):
    policy, reference = make_policy("amo", str(folder)), Deployment(folder)
    rng = np.random.default_rng(1)
    memory, heading, yaw = policy.initial_memory(), 0.0, 0.0
    for index in range(60):
        yaw += 0.01
        qpos = np.concatenate([[0, 0, 0.75], quat_from_yaw(yaw), rng.normal(0, 0.2, 29)])
        qvel = rng.normal(0, 0.5, 35)
        walks = 15 <= index < 45
        command = np.array([0.7, 0.1, 0.2, 0.3, 0.4 * walks, 0.1, 0.5])
        arms = rng.normal(0, 0.3, 14)
        heading = yaw if reference.stands else heading + 0.5 * 0.02
        wanted = reference.step(qpos, qvel, 0.7, [0.1, 0.3, 0.2], command[4], 0.1, heading, arms)
        mode = Mode.MOBILE if walks else Mode.STATIONARY
        targets, memory = policy.act(
            qpos[None], qvel[None], command[None], arms[None], memory, mode
        )
        np.testing.assert_allclose(targets[0, :15], wanted, atol=1e-5)
        np.testing.assert_array_equal(targets[0, 15:], arms)


def test_a_batch_is_its_members_and_nothing_is_written_to(folder):
    policy, rng = make_policy("amo", str(folder)), np.random.default_rng(2)
    n = 3
    inputs = [
        np.concatenate([np.zeros((n, 3)), np.tile([1.0, 0, 0, 0], (n, 1)),
                        rng.normal(0, 0.2, (n, 29))], axis=1),
        rng.normal(0, 1, (n, 35)), rng.uniform(0.3, 0.7, (n, 7)), rng.normal(0, 1, (n, 14)),
        rng.normal(0, 0.1, (n, policy.memory_size)),
    ]  # fmt: skip
    kept = [each.copy() for each in inputs]
    whole = policy.act(*inputs, mode=Mode.MOBILE)
    for row in range(n):
        single = policy.act(*(each[row : row + 1] for each in inputs), mode=Mode.MOBILE)
        np.testing.assert_allclose(single.targets[0], whole.targets[row], atol=1e-5)
        np.testing.assert_allclose(single.memory[0], whole.memory[row], atol=1e-5)
    for before, now in zip(kept, inputs, strict=True):
        np.testing.assert_array_equal(before, now)


def test_it_brings_its_own_motors(folder):
    model = make_morphology("g1").build_spec("full").compile()
    make_policy("amo", str(folder)).adapt(model)
    knee, wrist = model.actuator("left_knee_joint"), model.actuator("left_wrist_yaw_joint")
    assert knee.gainprm[0] == 300 and list(knee.biasprm[1:3]) == [-300, -4]
    assert list(knee.forcerange) == [-139, 139]
    assert wrist.gainprm[0] == 4
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)


def test_files_that_are_missing_or_wrong(tmp_path, folder):
    with pytest.raises(PolicyFileError, match=r"amo_jit.pt' does not exist. Give AMO's amo_jit.pt"):
        make_policy("amo", str(tmp_path))
    for name in FILES:
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    with pytest.raises(PolicyFileError, match="AMO has 3 files; give their folder"):
        make_policy("amo", str(tmp_path / FILES[0]))
    torch.save({"input_mean": np.zeros(3)}, tmp_path / FILES[2])
    with pytest.raises(PolicyFileError, match="holds no arrays input_mean, input_std"):
        make_policy("amo", str(tmp_path))
    torch.save({f"{side}_{kind}": np.zeros(n) for side, n in (("input", 3), ("output", 15))
                for kind in ("mean", "std")}, tmp_path / FILES[2])  # fmt: skip
    with pytest.raises(PolicyFileError, match="the reference has 3 inputs, and its terms are 12"):
        make_policy("amo", str(tmp_path))
    (tmp_path / FILES[0]).write_bytes(b"nothing")
    with pytest.raises(PolicyFileError, match="amo_jit.pt' is no TorchScript network"):
        make_policy("amo", str(tmp_path))
