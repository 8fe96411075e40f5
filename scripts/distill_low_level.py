r"""Distil FALCON's G1 policy into the student that ships with the package.

    python scripts/distill_low_level.py --teacher g1_29dof.onnx --seed 0 \
        --out xop_lerobot/low_level/weights/g1_student.npz

DAgger (Ross et al., 2011): many robots run in the planning model; each is driven by the teacher
or by the student, the teacher's share falls from one to zero, and the student is trained on
what the teacher would have done in every state that was met. The teacher drives legs and waist
as FALCON does; its arms bear their weight, computed from the model, since FALCON does so only in
the postures that it was trained with. Afterwards, and alone with ``--evaluate-only``, student and
FALCON are compared on the same random sequences.
"""

from __future__ import annotations

import argparse
import logging
import time
from dataclasses import fields
from pathlib import Path

import mujoco
import numpy as np
import torch
from torch import nn

from xop_lerobot.command import Mode
from xop_lerobot.command_line import make_output_readable
from xop_lerobot.errors import BadValue
from xop_lerobot.low_level.excitation import Excitation, ExcitationConfig, make_excitation
from xop_lerobot.low_level.joints import read_joints
from xop_lerobot.low_level.networks import LoadedNetwork, load_weights, save_weights
from xop_lerobot.low_level.policy import LowLevelPolicy, PolicyOutput
from xop_lerobot.low_level.tables import load_policy
from xop_lerobot.low_level.trial import BatchSimulation
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_model

logger = logging.getLogger("distill_low_level")

WIDE = ExcitationConfig(
    height=(0.48, 0.80),
    waist_yaw=1.1,
    waist_roll=0.5,
    waist_pitch=(-0.5, 0.5),
    vx=1.0,
    vy=0.6,
    yaw_rate=1.0,
    arm_range=0.95,
    arm_speed=3.0,
    push=0.6,
    push_period=4.0,
    hand_force=15.0,
)
"""Ranges of half of the training robots: wider than what a robot is asked for."""

USUAL = ExcitationConfig(waist_roll=0.2, waist_pitch=(-0.2, 0.3), push_period=4.0)
"""Ranges of the other half of the robots: about those of the comparison."""

EPISODE_STEPS = 1000
BLOCK_STEPS = 50
"""Steps for which one of teacher and student drives a robot before it is drawn again."""

REFINE_AFTER = 3
"""Rounds of experience before an earlier student is trained further."""

JOINTS = read_joints("g1")
ARMS = slice(JOINTS.arms[0], JOINTS.arms[-1] + 1)
ACTIONS = slice(0, len(JOINTS.names))
"""Last actions in the memory of student and FALCON."""
ACTION_SCALE = 0.25
"""Of both tables."""

OUTPUT_WEIGHTS = np.ones(len(JOINTS.names))
OUTPUT_WEIGHTS[13:15] = 0.1  # waist roll and pitch: only seen as a last action
OUTPUT_WEIGHTS[ARMS] = 0.3  # arms: a small residual


class Teacher:
    r"""FALCON, whose arms' part of the action bears the arms' weight.

    The servos of the arms are soft. Their targets are offset by the torque of gravity over their
    stiffness, :math:`\Delta q^* = \tau_g(q) / k_p`, from the planning model.

    Args:
        path: FALCON's ONNX file; None for the cached or downloaded one.
    """

    def __init__(self, path: str | None) -> None:
        self.policy = load_policy("falcon", path)
        self._model = build_model(make_morphology("g1"), "planning")
        self._data = mujoco.MjData(self._model)
        self._stiffness = self._model.actuator_gainprm[ARMS, 0]

    def act(
        self,
        qpos: np.ndarray,
        qvel: np.ndarray,
        command: np.ndarray,
        arms: np.ndarray,
        memory: np.ndarray,
        mode: Mode | np.ndarray,
    ) -> PolicyOutput:
        """Compute motor targets for the next 20 ms; see `LowLevelPolicy.act`."""
        targets, after = self.policy.act(qpos, qvel, command, arms, memory, mode)
        offsets = self._compute_offsets(qpos)
        after[:, ACTIONS][:, ARMS] = offsets / ACTION_SCALE
        low, high = JOINTS.low[ARMS], JOINTS.high[ARMS]
        targets[:, ARMS] = np.clip(arms + offsets, low, high)
        return PolicyOutput(targets, after)

    def _compute_offsets(self, qpos: np.ndarray) -> np.ndarray:
        """Offsets of the arms' targets [rad]. Shapes (n, 36) -> (n, 14)."""
        model, data, force = self._model, self._data, np.zeros(self._model.nv)
        offsets = np.empty((len(qpos), len(self._stiffness)))
        for row, configuration in zip(offsets, qpos, strict=True):
            data.qpos[:] = configuration
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_comVel(model, data)
            mujoco.mj_rne(model, data, 0, force)  # at rest: gravity alone
            row[:] = force[6:][ARMS] / self._stiffness
        return offsets


class Network(LoadedNetwork):
    """The student while it is trained: standardised inputs, ELU between the layers."""

    def __init__(self, hidden: tuple[int, ...], observations: torch.Tensor) -> None:
        self.mean = observations.mean(0)
        spread = observations.std(0)
        self.spread = torch.where(spread < 1e-4, torch.ones_like(spread), spread.clamp(min=0.02))  # noqa: PLR2004
        sizes = (observations.shape[1], *hidden, len(JOINTS.names))
        self.num_inputs, self.num_outputs = sizes[0], sizes[-1]
        layers: list[nn.Module] = []
        for inputs, outputs in zip(sizes, sizes[1:], strict=False):
            layers += [nn.Linear(inputs, outputs), nn.ELU()]
        self.body = nn.Sequential(*layers[:-1])

    def standardise(self, observation: torch.Tensor) -> torch.Tensor:
        """Shift and scale observations to about zero mean and unit spread."""
        return (observation - self.mean) / self.spread

    def __call__(
        self, observation: np.ndarray, hidden: np.ndarray, past: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Run the network; see `LoadedNetwork`."""
        del past
        with torch.no_grad():
            seen = self.standardise(torch.from_numpy(observation))
            return self.body(seen).numpy(), hidden

    def load(self, weights: list[np.ndarray], biases: list[np.ndarray]) -> None:
        """Take the layers of a saved student; the inverse of `layers`."""
        mean, spread = self.mean.double().numpy(), self.spread.double().numpy()
        weights, biases = [weights[0].astype(float), *weights[1:]], list(biases)
        biases[0] = biases[0] + mean @ weights[0]
        weights[0] = weights[0] * spread[:, None]
        linear = [module for module in self.body if isinstance(module, nn.Linear)]
        with torch.no_grad():
            for layer, weight, bias in zip(linear, weights, biases, strict=True):
                layer.weight.copy_(torch.from_numpy(weight.T))
                layer.bias.copy_(torch.from_numpy(bias))

    def layers(self) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return matrices (inputs, outputs) and offsets, the standardisation folded in."""
        linear = [module for module in self.body if isinstance(module, nn.Linear)]
        weights = [layer.weight.detach().double().T.clone() for layer in linear]
        biases = [layer.bias.detach().double().clone() for layer in linear]
        weights[0] /= self.spread.double()[:, None]
        biases[0] -= self.mean.double() @ weights[0]
        return [w.numpy() for w in weights], [b.numpy() for b in biases]


class Experience:
    """All observations met so far and the teacher's action in each, in half precision."""

    def __init__(self, capacity: int, width: int) -> None:
        self.observations = torch.empty((capacity, width), dtype=torch.float16)
        self.actions = torch.empty((capacity, len(JOINTS.names)), dtype=torch.float16)
        self.size = 0

    def add(self, observations: np.ndarray, actions: np.ndarray) -> None:
        """Append a batch."""
        rows = slice(self.size, self.size + len(observations))
        self.observations[rows] = torch.from_numpy(observations)
        self.actions[rows] = torch.from_numpy(actions)
        self.size += len(observations)

    def draw(self, count: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw a random batch, float32."""
        rows = torch.randint(0, self.size, (count,), generator=generator)
        return self.observations[rows].float(), self.actions[rows].float()


class Collector:
    """Robots that run without end, driven by a mixture of teacher and student."""

    def __init__(
        self, teacher: Teacher, robots: int, threads: int, rng: np.random.Generator
    ) -> None:
        self.teacher, self.rng, self.robots = teacher, rng, robots
        morphology = make_morphology("g1")
        models = [randomise(build_model(morphology, "planning"), rng) for _ in range(robots)]
        self.simulation = BatchSimulation(models, morphology.standing_qpos(), threads)
        self.student = load_policy("default")  # its table says what is remembered and seen
        self.memory = self.student.initial_memory(robots)
        self.noise = rng.uniform(0, 1, (robots, 1)) * (rng.uniform(size=(robots, 1)) < 0.6)  # noqa: PLR2004
        self.excitation: Excitation | None = None
        self.step = 0
        self.falls = 0

    def collect(
        self, student: LowLevelPolicy | None, share: float, steps: int, experience: Experience
    ) -> None:
        """Run `steps` steps with the teacher's `share` and add them to `experience`."""
        simulation = self.simulation
        teaches = np.ones(self.robots, bool)
        for step in range(steps):
            if self.excitation is None or self.step == EPISODE_STEPS:
                self.excitation = make_training_excitation(self.rng, self.robots)
                self.step = 0
            if step % BLOCK_STEPS == 0:
                teaches = self.rng.uniform(size=self.robots) < share
            random = self.excitation
            simulation.push(random.push[self.step])
            inputs = (
                *self._sense(),
                random.command[self.step],
                random.arms[self.step],
                self.memory,
                random.mode[self.step],
            )
            taught = self.teacher.act(*inputs)
            experience.add(self.student.observe(*inputs), taught.memory[:, ACTIONS])
            targets, self.memory = taught
            if student is not None and not teaches.all():
                own = student.act(*inputs)
                targets = np.where(teaches[:, None], taught.targets, own.targets)
                self.memory = np.where(teaches[:, None], taught.memory, own.memory)
            simulation.step(targets, random.hand_force[self.step])
            down = simulation.fallen()
            simulation.reset(down)
            self.memory[down] = self.student.initial_memory(int(down.sum()))
            self.falls += int(down.sum())
            self.step += 1

    def _sense(self) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and velocities with some noise."""
        qpos, qvel = self.simulation.qpos.copy(), self.simulation.qvel.copy()
        normal = self.rng.standard_normal
        qpos[:, 7:] += 0.005 * self.noise * normal((self.robots, qpos.shape[1] - 7))
        qpos[:, 3:7] += 0.005 * self.noise * normal((self.robots, 4))
        qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
        qvel[:, 3:6] += 0.03 * self.noise * normal((self.robots, 3))
        qvel[:, 6:] += 0.1 * self.noise * normal((self.robots, qvel.shape[1] - 6))
        return qpos, qvel


def make_training_excitation(rng: np.random.Generator, robots: int) -> Excitation:
    """Draw one episode: half of the robots in the wide ranges, the others in the usual ones."""
    sizes = (robots // 2, robots - robots // 2)
    parts = [
        make_excitation(rng, size, EPISODE_STEPS, config)
        for size, config in zip(sizes, (WIDE, USUAL), strict=True)
    ]
    names = [field.name for field in fields(Excitation)]
    return Excitation(
        **{name: np.concatenate([getattr(part, name) for part in parts], axis=1) for name in names}
    )


def randomise(model: mujoco.MjModel, rng: np.random.Generator) -> mujoco.MjModel:
    """Vary friction, masses and gains of a model in place."""
    model.geom_friction[:, 0] = rng.uniform(0.5, 1.2)
    scale = rng.uniform(0.95, 1.05, (model.nbody, 1))
    model.body_mass *= scale[:, 0]
    model.body_inertia *= scale
    gain = rng.uniform(0.95, 1.05, model.nu)
    model.actuator_gainprm[:, 0] *= gain
    model.actuator_biasprm[:, 1] *= gain
    return model


def train(  # noqa: PLR0913
    network: Network,
    experience: Experience,
    updates: int,
    rates: tuple[float, float],
    batch: int,
    generator: torch.Generator,
) -> float:
    """Fit the network; the learning rate falls from `rates[0]` to `rates[1]`. Returns the loss."""
    spread = experience.actions[: experience.size : 50].float().std(0).clamp(min=0.05)
    scale = torch.from_numpy(OUTPUT_WEIGHTS).float().sqrt() / spread
    optimizer = torch.optim.Adam(network.body.parameters(), lr=rates[0])
    decay = (rates[1] / rates[0]) ** (1 / max(updates, 1))
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, decay)
    total = 0.0
    for _ in range(updates):
        observations, actions = experience.draw(batch, generator)
        error = (network.body(network.standardise(observations)) - actions) * scale
        loss = nn.functional.smooth_l1_loss(error, torch.zeros_like(error), beta=0.5)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        total += loss.item()
    return total / max(updates, 1)


def distill(arguments: argparse.Namespace) -> Network:
    """Run DAgger and return the trained network."""
    rng = np.random.default_rng(arguments.seed)
    torch.manual_seed(arguments.seed)
    torch.set_num_threads(arguments.threads)
    generator = torch.Generator().manual_seed(arguments.seed)
    robots, steps = arguments.robots, arguments.steps
    collector = Collector(Teacher(arguments.teacher), robots, arguments.threads, rng)
    width = collector.student.num_inputs
    experience = Experience(arguments.rounds * robots * steps, width)
    start = time.monotonic()
    refines = arguments.init is not None
    driver = load_policy("default", str(arguments.init)) if refines else None
    network: Network | None = None
    for turn in range(arguments.rounds):
        share = 0.0 if refines else max(0.0, 1.0 - turn / max(1, 0.3 * arguments.rounds))
        collector.falls = 0
        collector.collect(driver, share, steps, experience)
        if refines and turn < REFINE_AFTER:
            continue  # too little experience yet: training would forget more than it learns
        if network is None:
            network = Network(
                tuple(arguments.hidden), experience.observations[: experience.size].float()
            )
            if refines:
                network.load(*load_weights(arguments.init))
            driver = load_policy("default", network=network)
        rates = (3e-4, 1e-4) if refines else (1e-3, 3e-4)
        loss = train(network, experience, arguments.updates, rates, arguments.batch, generator)
        save_weights(arguments.out, *network.layers())  # a long run leaves something if cut off
        logger.info(
            "round %d/%d: teacher share %.2f, falls %d, loss %.5f, %d samples, %.0f s",
            turn + 1, arguments.rounds, share, collector.falls, loss,
            experience.size, time.monotonic() - start,
        )  # fmt: skip
    collector.simulation.close()
    if network is None:
        least = REFINE_AFTER + 1 if refines else 1
        raise BadValue(f"--rounds must be at least {least}, got {arguments.rounds}")
    for part, rates in enumerate(((3e-4, 1e-4) if refines else (5e-4, 1e-4), (1e-4, 2e-5))):
        loss = train(
            network, experience, arguments.final_updates // 2, rates, arguments.batch, generator
        )
        logger.info("final part %d: loss %.5f, %.0f s", part + 1, loss, time.monotonic() - start)
    return network


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description="Distil FALCON's G1 policy into a smaller network.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--teacher", help="FALCON's ONNX file; None: cached or downloaded")
    parser.add_argument("--seed", type=int, default=0, help="seed of training")
    parser.add_argument("--out", type=Path, required=True, help="weights of the student, .npz")
    parser.add_argument("--hidden", type=int, nargs="+", default=[384, 192], help="layer widths")
    parser.add_argument("--init", type=Path, help="weights of a student to train further, .npz")
    parser.add_argument("--rounds", type=int, default=24, help="rounds of DAgger")
    parser.add_argument("--robots", type=int, default=256, help="robots at once")
    parser.add_argument("--steps", type=int, default=150, help="policy steps a round [20 ms]")
    parser.add_argument("--updates", type=int, default=300, help="gradient steps a round")
    parser.add_argument("--final-updates", type=int, default=8000, help="gradient steps at last")
    parser.add_argument("--batch", type=int, default=1024, help="samples a gradient step")
    parser.add_argument("--threads", type=int, default=2, help="threads")
    return parser.parse_args()


def main() -> None:
    """Train and save."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    arguments = parse_arguments()
    start = time.monotonic()
    save_weights(arguments.out, *distill(arguments).layers())
    logger.info("wrote %s after %.0f s", arguments.out, time.monotonic() - start)


if __name__ == "__main__":
    make_output_readable()
    main()
