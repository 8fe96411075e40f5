r"""Train the G1 policy that ships with the package, by distillation.

    python -m scripts.distill_low_level --teacher g1_29dof.onnx --seed 0 \
        --out xop_lerobot/low_level/weights/g1_student.npz

DAgger (Ross et al., 2011): many robots run in the planning model, each driven by the teacher or by
the student. The teacher's share falls from one to zero, and the student is trained on the
teacher's action in every visited state. The teacher (`low_level_teacher.py`) is FALCON where the
robot steps, and a balance controller with the true state where it stands.
docs/how_it_works/low_level.md describes the runs of the shipped weights.
"""

from __future__ import annotations

import argparse
import logging
import time
from dataclasses import fields, replace
from pathlib import Path

import mujoco
import numpy as np
import torch
from torch import nn

from benchmarks.low_level_excitation import (
    VELOCITIES,
    Excitation,
    ExcitationConfig,
    make_excitation,
)
from benchmarks.low_level_trial import BatchSimulation
from scripts.low_level_teacher import ACTIONS, ARMS, GRAVITY, JOINTS, Teacher
from xop_lerobot.core.command import Mode
from xop_lerobot.core.command_line import make_output_readable
from xop_lerobot.core.errors import BadValue
from xop_lerobot.low_level.networks import LoadedNetwork, load_weights, save_weights
from xop_lerobot.low_level.policy import POLICY_DT, LowLevelPolicy
from xop_lerobot.low_level.tables import load_policy
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_model

logger = logging.getLogger("distill_low_level")

WIDE = ExcitationConfig(
    height=(0.40, 0.79),
    waist_yaw=1.1,
    waist_roll=0.5,
    waist_pitch=(-0.5, 1.0),
    vx=1.0,
    vy=0.6,
    yaw_rate=1.0,
    arm_range=0.95,
    arm_speed=3.0,
    push=0.6,
    push_period=4.0,
    hand_force=22.0,
)
"""Ranges of most training robots, wider than the command space."""

LOW = replace(WIDE, height=(0.40, 0.62), push=0.3)
"""Ranges of robots that stand low, with weaker pushes."""

USUAL = ExcitationConfig(
    height=(0.42, 0.78), waist_roll=0.2, waist_pitch=(-0.2, 0.6), push_period=4.0
)
"""Ranges similar to those of the comparison of policies."""

STANDING, MOVING = (LOW, WIDE), (WIDE, USUAL)
"""Ranges of four quarters of the robots: two that always stand, and two that sometimes walk."""

SWAY = (0.15, 0.1)
"""Maximum velocity commands, forward and left, for weight shifts of standing robots [m/s]."""

PAYLOAD, PAYLOAD_SHARE = 2.5, 0.4
"""Maximum mass in each hand [kg], and fraction of the robots that carry a payload."""

FORCE_LAG_S = 0.2
"""Time constant of the forces on the hands [s]."""

EPISODE_STEPS = 1000
BLOCK_STEPS = 50
"""Policy steps after which the driver of each robot, teacher or student, is drawn again."""

REFINE_AFTER = 3
"""Rounds of experience to collect before training of an earlier student is resumed."""

NUM_JOINTS = len(JOINTS.names)

OUTPUT_WEIGHTS = np.ones(NUM_JOINTS)
"""Weights of the joints in the loss."""
OUTPUT_WEIGHTS[13:15] = 0.1  # waist roll and pitch follow the command; only the memory uses these
OUTPUT_WEIGHTS[ARMS] = 0.3  # only a small offset is added to the arm targets


LIFT = 16.0
"""Bias that keeps the skip's outputs, which are within ±3, positive, where ELU is the identity."""


class Network(LoadedNetwork):
    """The student during training: a multilayer perceptron with standardised inputs and a skip.

    Much of the teacher is linear: a target is the present angle plus torque over stiffness. A
    linear path in parallel to the ELU layers learns that quickly.

    Args:
        hidden: Widths of the hidden layers.
        observations: Observations that define the standardisation. Shape (n, 575).
    """

    def __init__(self, hidden: tuple[int, ...], observations: torch.Tensor) -> None:
        self.mean = observations.mean(0)
        spread = observations.std(0)
        self.spread = torch.where(spread < 1e-4, torch.ones_like(spread), spread.clamp(min=0.02))
        sizes = (observations.shape[1], *hidden, len(JOINTS.names))
        self.num_inputs, self.num_outputs = sizes[0], sizes[-1]
        layers: list[nn.Module] = []
        for inputs, outputs in zip(sizes, sizes[1:], strict=False):
            layers += [nn.Linear(inputs, outputs), nn.ELU()]
        self.body = nn.Sequential(*layers[:-1])
        self.skip = nn.Linear(sizes[0], sizes[-1])
        nn.init.zeros_(self.skip.weight)
        nn.init.zeros_(self.skip.bias)

    def parameters(self) -> list[nn.Parameter]:
        """Return the trained parameters."""
        return [*self.body.parameters(), *self.skip.parameters()]

    def compute(self, observation: torch.Tensor) -> torch.Tensor:
        """Compute the actions for observations. Shapes (n, 575) -> (n, 29)."""
        inputs = self.standardise(observation)
        return self.body(inputs) + self.skip(inputs)

    def standardise(self, observation: torch.Tensor) -> torch.Tensor:
        """Shift and scale observations to about zero mean and unit standard deviation."""
        return (observation - self.mean) / self.spread

    def __call__(
        self, observation: np.ndarray, hidden: np.ndarray, past: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Run the network; see `LoadedNetwork`."""
        del past
        with torch.no_grad():
            return self.compute(torch.from_numpy(observation)).numpy(), hidden

    def load(self, weights: list[np.ndarray], biases: list[np.ndarray]) -> None:
        """Load the layers of a saved student; the inverse of `layers`."""
        mean, spread = self.mean.double().numpy(), self.spread.double().numpy()
        linear = [module for module in self.body if isinstance(module, nn.Linear)]
        first, offset = weights[0].astype(float) * spread[:, None], biases[0] + mean @ weights[0]
        weights, biases = [first, *weights[1:]], [offset, *biases[1:]]
        with torch.no_grad():
            if weights[0].shape[1] > linear[0].out_features:
                self.skip.weight.copy_(torch.from_numpy(first[:, -NUM_JOINTS:].T))
                self.skip.bias.copy_(torch.from_numpy(offset[-NUM_JOINTS:] - LIFT))
                biases[-1] = biases[-1] + LIFT
            for layer, weight, bias in zip(linear, weights, biases, strict=True):
                inputs, outputs = layer.in_features, layer.out_features
                layer.weight.copy_(torch.from_numpy(weight[:inputs, :outputs].T))
                layer.bias.copy_(torch.from_numpy(bias[:outputs]))

    def layers(self) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return matrices (inputs, outputs) and biases with standardisation and skip folded in.

        The skip becomes 29 more units in each hidden layer, offset by `LIFT` so that ELU passes
        them unchanged; so the deployed network is a plain multilayer perceptron.
        """
        linear = [module for module in self.body if isinstance(module, nn.Linear)]
        weights = [layer.weight.detach().double().T.numpy() for layer in linear]
        biases = [layer.bias.detach().double().numpy() for layer in linear]
        skip = self.skip.weight.detach().double().T.numpy()
        weights[0] = np.concatenate([weights[0], skip], axis=1)
        biases[0] = np.concatenate([biases[0], self.skip.bias.detach().double().numpy() + LIFT])
        for layer in range(1, len(weights)):
            last = layer == len(weights) - 1
            inputs, outputs = weights[layer].shape
            carried = np.zeros((inputs + NUM_JOINTS, outputs + NUM_JOINTS))
            carried[:inputs, :outputs] = weights[layer]
            carried[inputs:, -NUM_JOINTS:] = np.eye(NUM_JOINTS)
            if last:
                carried[:, :outputs] += carried[:, -NUM_JOINTS:]
            weights[layer] = carried[:, :outputs] if last else carried
            more = np.zeros(0 if last else NUM_JOINTS)
            biases[layer] = np.concatenate([biases[layer] - LIFT * last, more])
        weights[0] = weights[0] / self.spread.double().numpy()[:, None]
        biases[0] = biases[0] - self.mean.double().numpy() @ weights[0]
        return weights, biases


class Experience:
    """All observations so far and the teacher's action in each, in half precision.

    Args:
        capacity: Maximum number of samples.
        width: Entries of an observation.
    """

    def __init__(self, capacity: int, width: int) -> None:
        self.observations = torch.empty((capacity, width), dtype=torch.float16)
        self.actions = torch.empty((capacity, len(JOINTS.names)), dtype=torch.float16)
        self.size = 0

    def add(self, observations: np.ndarray, actions: np.ndarray) -> None:
        """Append a batch. Shapes (n, width), (n, 29)."""
        rows = slice(self.size, self.size + len(observations))
        self.observations[rows] = torch.from_numpy(observations)
        self.actions[rows] = torch.from_numpy(actions)
        self.size += len(observations)

    def draw(self, count: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw a random batch of observations and actions, float32."""
        rows = torch.randint(0, self.size, (count,), generator=generator)
        return self.observations[rows].float(), self.actions[rows].float()


class Collector:
    """Endlessly simulated robots that teacher and student drive by turns.

    Args:
        teacher: The teacher.
        robots: Number of robots.
        threads: Threads of the simulation.
        rng: Random generator of models, commands, noise and drivers.
    """

    def __init__(
        self, teacher: Teacher, robots: int, threads: int, rng: np.random.Generator
    ) -> None:
        self.teacher, self.rng, self.robots = teacher, rng, robots
        morphology = make_morphology("g1")
        models = [randomise(build_model(morphology, "planning"), rng) for _ in range(robots)]
        # Weights of the payloads, which the teacher knows, as forces on the hands [N].
        self.weight = np.zeros((robots, 2, 3))
        for model, weight in zip(models, self.weight, strict=True):
            weight[:, 2] = -GRAVITY * load_hands(model, rng)
        self.simulation = BatchSimulation(models, morphology.standing_qpos(), threads)
        self.student = load_policy("default")  # its table defines observation and memory
        self.memory = self.student.initial_memory(robots)
        self.taught_memory, self.share = teacher.initial_memory(robots), np.zeros(robots)
        # Arms in contact, with an object or with each other, miss their targets.
        self.hindered = rng.uniform(size=(robots, 1)) < 0.15
        self.noise = rng.uniform(0, 1, (robots, 1)) * (rng.uniform(size=(robots, 1)) < 0.6)
        self.excitation: Excitation | None = None
        self.step = 0
        self.falls = 0

    def collect(
        self, student: LowLevelPolicy | None, share: float, steps: int, experience: Experience
    ) -> None:
        """Run `steps` policy steps and add their observations and actions to `experience`.

        Args:
            student: Policy that drives besides the teacher; None for the shipped one.
            share: Probability that the teacher drives a robot in a block of `BLOCK_STEPS`.
            steps: Number of policy steps.
            experience: Receives the samples of all robots, whoever drives.
        """
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
            sensed, force = self._sense(), random.hand_force[self.step]
            command, arms = random.command[self.step], random.arms[self.step]
            mode = random.mode[self.step]
            taught = self.teacher.teach(
                (simulation.qpos, simulation.qvel), sensed, command, arms, self.taught_memory,
                mode, force + self.weight, self.share,
            )  # fmt: skip
            inputs = (*sensed, command, arms, self.memory, mode)
            experience.add(self.student.observe(*inputs), taught.actions)
            own, self.memory = (student or self.student).act(*inputs)
            targets = np.where(teaches[:, None], taught.targets, own)
            self.taught_memory, self.share = taught.memory, taught.share
            # Both memories contain the executed action, whoever drove.
            self.memory[teaches, ACTIONS] = taught.actions[teaches]
            self.taught_memory[:, ACTIONS] = self.memory[:, ACTIONS]
            # Hindered arms go to the targets of another robot instead of their own.
            elsewhere = np.roll(arms, 1, axis=0) - arms
            targets[:, ARMS] += np.where(self.hindered, elsewhere, 0.0)
            simulation.step(targets, force)
            down = simulation.fallen()
            simulation.reset(down)
            self.memory[down] = self.student.initial_memory(int(down.sum()))
            self.taught_memory[down] = self.teacher.initial_memory(int(down.sum()))
            self.share[down] = 0.0
            self.falls += int(down.sum())
            self.step += 1

    def _sense(self) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and velocities with sensor noise, scaled per robot by `noise`."""
        qpos, qvel = self.simulation.qpos.copy(), self.simulation.qvel.copy()
        normal = self.rng.standard_normal
        qpos[:, 7:] += 0.005 * self.noise * normal((self.robots, qpos.shape[1] - 7))
        qpos[:, 3:7] += 0.005 * self.noise * normal((self.robots, 4))
        qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
        qvel[:, 3:6] += 0.03 * self.noise * normal((self.robots, 3))
        qvel[:, 6:] += 0.1 * self.noise * normal((self.robots, qvel.shape[1] - 6))
        return qpos, qvel


def make_training_excitation(rng: np.random.Generator, robots: int) -> Excitation:
    """Draw one episode: a quarter of the robots in each of the ranges, half of them standing.

    Args:
        rng: Random generator.
        robots: Number of robots.
    """
    configs = (*STANDING, *MOVING)
    sizes = np.diff(np.arange(len(configs) + 1) * robots // len(configs))
    standing = sizes[: len(STANDING)].sum()
    parts = [
        make_excitation(rng, size, EPISODE_STEPS, config)
        for size, config in zip(sizes, configs, strict=True)
    ]
    names = [field.name for field in fields(Excitation)]
    drawn = Excitation(
        **{name: np.concatenate([getattr(part, name) for part in parts], axis=1) for name in names}
    )
    drawn.mode[:, :standing] = Mode.STATIONARY
    force = drawn.hand_force
    force[:, ::2, 1] = force[:, ::2, 0]  # half the robots carry with both hands
    # A first-order lag: no robot can lean against forces that jump.
    for step in range(1, EPISODE_STEPS):
        force[step] = force[step - 1] + (force[step] - force[step - 1]) * (POLICY_DT / FORCE_LAG_S)
    stands = drawn.mode == Mode.STATIONARY
    drawn.command[:, :standing, VELOCITIES] = 0.0
    # In stance, 40 % of the robots get small, slowly changing velocity commands: weight shifts.
    phase = rng.uniform(0, 2 * np.pi, (2, robots)) + np.arange(EPISODE_STEPS)[:, None, None] * (
        POLICY_DT * rng.uniform(0.2, 1.5, (2, robots))
    )
    size = rng.uniform(0, 1, (2, robots)) * (rng.uniform(size=robots) < 0.4)
    for axis, largest in enumerate(SWAY):
        sway = largest * size[axis] * np.sin(phase[:, axis])
        drawn.command[..., VELOCITIES.start + axis] += np.where(stands, sway, 0.0)
    return drawn


def load_hands(model: mujoco.MjModel, rng: np.random.Generator) -> np.ndarray:
    """Add random payloads to the hands of some robots, equal in half of the cases.

    Args:
        model: Model, changed in place.
        rng: Random generator.

    Returns:
        Masses added to the left and the right hand [kg]. Shape (2,).
    """
    carries, alike = rng.uniform(size=2) < (PAYLOAD_SHARE, 0.5)
    masses = carries * rng.uniform(0, PAYLOAD, 2)
    if alike:
        masses[1] = masses[0]
    for side, mass in zip(("left", "right"), masses, strict=True):
        hand = model.body(f"{side}_wrist_yaw_link").id
        model.body_inertia[hand] *= 1 + mass / model.body_mass[hand]
        model.body_mass[hand] += mass
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return masses


def randomise(model: mujoco.MjModel, rng: np.random.Generator) -> mujoco.MjModel:
    """Randomise friction, masses and gains of a model in place; returns it.

    A quarter of the models have dry friction in their joints.
    """
    model.dof_frictionloss[6:] = 0.2 if rng.uniform() < 0.25 else 0.0
    model.geom_friction[:, 0] = rng.uniform(0.5, 1.2)
    scale = rng.uniform(0.95, 1.05, (model.nbody, 1))
    model.body_mass *= scale[:, 0]
    model.body_inertia *= scale
    gain = rng.uniform(0.95, 1.05, model.nu)
    model.actuator_gainprm[:, 0] *= gain
    model.actuator_biasprm[:, 1] *= gain
    return model


def train(
    network: Network,
    experience: Experience,
    updates: int,
    rates: tuple[float, float],
    batch: int,
    generator: torch.Generator,
) -> float:
    """Train the network by Adam with a smooth L1 loss.

    Args:
        network: The network.
        experience: Samples.
        updates: Number of gradient steps.
        rates: Learning rates at the start and the end, exponentially decayed.
        batch: Samples per gradient step.
        generator: Random generator of the batches.

    Returns:
        Mean loss.
    """
    spread = experience.actions[: experience.size : 50].float().std(0).clamp(min=0.05)
    scale = torch.from_numpy(OUTPUT_WEIGHTS).float().sqrt() / spread
    optimizer = torch.optim.Adam(network.parameters(), lr=rates[0])
    decay = (rates[1] / rates[0]) ** (1 / max(updates, 1))
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, decay)
    total = 0.0
    for _ in range(updates):
        observations, actions = experience.draw(batch, generator)
        error = (network.compute(observations) - actions) * scale
        loss = nn.functional.smooth_l1_loss(error, torch.zeros_like(error), beta=0.1)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        total += loss.item()
    return total / max(updates, 1)


def distill(arguments: argparse.Namespace) -> Network:
    """Run DAgger and return the trained network.

    Raises:
        BadValue: If there are too few rounds to train at all.
    """
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
            continue  # on so few samples, training would forget more than it learns
        if network is None:
            network = Network(
                tuple(arguments.hidden), experience.observations[: experience.size].float()
            )
            if refines:
                network.load(*load_weights(arguments.init))
            driver = load_policy("default", network=network)
        rates = (3e-4, 1e-4) if refines else (1e-3, 3e-4)
        loss = train(network, experience, arguments.updates, rates, arguments.batch, generator)
        save_weights(arguments.out, *network.layers())  # so that an aborted run leaves a result
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
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        description="Distil FALCON's G1 policy into a smaller network.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--teacher", help="FALCON's ONNX file; None: cached or downloaded")
    parser.add_argument("--seed", type=int, default=0, help="random seed")
    parser.add_argument("--out", type=Path, required=True, help="weights of the student, .npz")
    parser.add_argument(
        "--hidden", type=int, nargs="+", default=[512, 256], help="widths of the hidden layers"
    )
    parser.add_argument("--init", type=Path, help="weights of a student to resume from, .npz")
    parser.add_argument("--rounds", type=int, default=24, help="rounds of DAgger")
    parser.add_argument("--robots", type=int, default=256, help="robots simulated in parallel")
    parser.add_argument("--steps", type=int, default=150, help="policy steps per round [20 ms]")
    parser.add_argument("--updates", type=int, default=300, help="gradient steps per round")
    parser.add_argument(
        "--final-updates", type=int, default=8000, help="gradient steps after the last round"
    )
    parser.add_argument("--batch", type=int, default=1024, help="samples per gradient step")
    parser.add_argument("--threads", type=int, default=2, help="threads")
    return parser.parse_args()


def main() -> None:
    """Train the student and save its weights."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    arguments = parse_arguments()
    start = time.monotonic()
    save_weights(arguments.out, *distill(arguments).layers())
    logger.info("wrote %s after %.0f s", arguments.out, time.monotonic() - start)


if __name__ == "__main__":
    make_output_readable()
    main()
