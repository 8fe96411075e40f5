"""The policy that ships with the package: a smaller network distilled from FALCON (see NOTICE).

`scripts/distill_low_level.py` makes its weights; `docs/low_level.md` compares it with FALCON.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from xop_lerobot.errors import PolicyFileError
from xop_lerobot.low_level.falcon_observation import (
    NUM_JOINTS,
    OBSERVATION_SIZE,
    FalconLikePolicy,
)
from xop_lerobot.low_level.networks import OnnxNetwork, build_mlp
from xop_lerobot.low_level.policy import POLICIES

WEIGHTS_FILE = Path(__file__).parent / "weights" / "g1_student.npz"


class Student(FalconLikePolicy):
    r"""Multilayer perceptron :math:`a = W_L \sigma(\dots W_0 o + b_0 \dots) + b_L`, σ = ELU.

    The standardisation of the inputs is folded into the first layer.

    Args:
        path: Weights, `.npz` with float32 arrays ``w0, b0, w1, b1, …``, matrices as
            (inputs, outputs); None for the ones that ship with the package.

    Raises:
        PolicyFileError: If the file is missing, malformed or of the wrong shape.
    """

    name = "default"

    def __init__(self, path: str | None = None) -> None:
        file = WEIGHTS_FILE if path is None else Path(path).expanduser()
        weights, biases = load_weights(file)
        model = build_mlp(weights, biases)
        self._network = OnnxNetwork(model, OBSERVATION_SIZE, NUM_JOINTS, str(file))

    def infer(self, observation: np.ndarray) -> np.ndarray:
        """Run the network; see `FalconLikePolicy.infer`."""
        return self._network(observation)


POLICIES.add("default", Student)


def load_weights(file: Path) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Read the layers of a student.

    Returns:
        Matrices (inputs, outputs) and offsets (outputs,), float32.

    Raises:
        PolicyFileError: If the file is missing, malformed, or its layers do not chain from
            575 observations to 29 actions.
    """
    if not file.is_file():
        raise PolicyFileError(f"policy file '{file}' does not exist")
    try:
        with np.load(file, allow_pickle=False) as arrays:
            layers = {key: arrays[key].astype(np.float32) for key in arrays.files}
    except (BadZipFile, ValueError, OSError, AttributeError) as error:
        raise PolicyFileError(f"policy file '{file}' is not an .npz of arrays") from error
    count = len(layers) // 2
    names = {f"{kind}{layer}" for layer in range(count) for kind in "wb"}
    if not layers or set(layers) != names:
        raise PolicyFileError(
            f"policy file '{file}' must hold w0, b0, w1, b1, …, got {sorted(layers)}"
        )
    weights = [layers[f"w{layer}"] for layer in range(count)]
    biases = [layers[f"b{layer}"] for layer in range(count)]
    _check_chain(file, weights, biases)
    return weights, biases


def save_weights(file: Path, weights: Sequence[np.ndarray], biases: Sequence[np.ndarray]) -> None:
    """Write the layers of a student as float32, as `load_weights` reads them."""
    layers = {}
    for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        layers[f"w{layer}"] = np.asarray(weight, np.float32)
        layers[f"b{layer}"] = np.asarray(bias, np.float32)
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez(file, **layers)


def _check_chain(file: Path, weights: Sequence[np.ndarray], biases: Sequence[np.ndarray]) -> None:
    shapes = [weight.shape for weight in weights]
    width = OBSERVATION_SIZE
    for weight, bias in zip(weights, biases, strict=True):
        if weight.ndim != 2 or weight.shape[0] != width or bias.shape != weight.shape[1:]:  # noqa: PLR2004
            break
        width = weight.shape[1]
    else:
        if width == NUM_JOINTS:
            return
    raise PolicyFileError(
        f"policy file '{file}': layers must lead from {OBSERVATION_SIZE} observations to "
        f"{NUM_JOINTS} actions, got matrices {shapes}"
    )
