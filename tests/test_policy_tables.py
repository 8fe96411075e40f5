"""Policies that are tables, beside plain readings of their published layouts, step by step."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import plain_policies as plain
import pytest
import toy_networks

from xop_lerobot.command import Mode
from xop_lerobot.low_level.tables import load_policy
from xop_lerobot.morphology.morphology import make_morphology

SHARED = Path(os.environ.get("XOP_SHARED", Path(__file__).parents[1] / ".." / "shared"))
STAND, WALK = Mode.STATIONARY, Mode.MOBILE


def open_network(file: Path) -> Callable[..., Any]:
    """A network as the plain policies call it: one robot at a time."""
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    names = [each.name for each in session.get_inputs()]

    def call(*values: np.ndarray) -> Any:
        outputs = session.run(None, dict(zip(names, values, strict=True)))
        return outputs[0] if len(outputs) == 1 else outputs

    return call


def make_states(steps: int, seed: int) -> list[tuple[np.ndarray, ...]]:
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
