"""Inference of low-level policy networks, batched on one thread: ONNX, TorchScript and MLPs."""

from __future__ import annotations

import pickle
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile

import numpy as np

from xop_lerobot.core.errors import PolicyFileError

if TYPE_CHECKING:
    import onnx


class LoadedNetwork(ABC):
    """A network that turns observations into outputs.

    Attributes:
        num_inputs: Width of the observation; None if the file does not state it.
        num_outputs: Width of the outputs; None if the file does not state it.
        num_hidden: Size of the recurrent state; 0 for none.
    """

    num_inputs: int | None = None
    num_outputs: int | None = None
    num_hidden: int = 0

    @abstractmethod
    def __call__(
        self, observation: np.ndarray, hidden: np.ndarray, past: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate the network.

        Args:
            observation: float32. Shape (n, num_inputs).
            hidden: Recurrent state. Shape (n, num_hidden).
            past: Second input of a network that has one, float32. Shape (n, p).

        Returns:
            Outputs, shape (n, num_outputs), and the recurrent state after, (n, num_hidden).
        """


def load_network(file: Path) -> LoadedNetwork:
    """Load the network of a file, by its file name extension.

    Raises:
        PolicyFileError: If the extension is unknown or the file malformed.
    """
    loaders = {".onnx": _load_onnx, ".npz": _load_layers, ".pt": TorchNetwork}
    if file.suffix not in loaders:
        raise PolicyFileError(
            f"policy file '{file}' must end in {', '.join(sorted(loaders))}, got '{file.suffix}'"
        )
    return loaders[file.suffix](file)


class OnnxNetwork(LoadedNetwork):
    """A network in ONNX Runtime: one input and one output, then any number of recurrent states.

    A fixed exported batch dimension is made symbolic, so that one call serves a batch. Recurrent
    states are further inputs, each with an output of its shape, in the same order; their batch
    axis is 1 if they have three axes, else 0. It runs on one thread: the batches of a sampling
    planner are too small to split, and the physics needs the other cores. A session is
    thread-safe.

    Args:
        model: The network.
        source: Its file, for messages.

    Raises:
        PolicyFileError: If its inputs or outputs have other shapes.
    """

    def __init__(self, model: onnx.ModelProto, source: str) -> None:
        import onnxruntime  # noqa: PLC0415

        inputs, outputs = list(model.graph.input), list(model.graph.output)
        shapes = [[_shape(tensor) for tensor in tensors] for tensors in (inputs, outputs)]
        states = [shape for shape in shapes[0][1:] if shape in shapes[1][1:]]
        if (
            not all(len(each) >= 1 and len(each[0]) == 2 for each in shapes)
            or len(states) != len(inputs) - 1
            or any(len(shape) not in (2, 3) for shape in states)
        ):
            raise PolicyFileError(
                f"policy file '{source}': expected one input and one output of shape (batch, "
                f"width), and recurrent states with an output each, got inputs {shapes[0]} and "
                f"outputs {shapes[1]}"
            )
        for tensor in (*inputs, *outputs):
            dims = tensor.type.tensor_type.shape.dim
            batch = dims[1 if len(dims) == 3 else 0]
            batch.Clear()
            batch.dim_param = "batch"
        self.num_inputs, self.num_outputs = int(shapes[0][0][1]), int(shapes[1][0][1])
        self._states = [
            (tensor.name, shape) for tensor, shape in zip(inputs[1:], states, strict=True)
        ]
        self.num_hidden = sum(_count(shape) for _, shape in self._states)
        del model.graph.value_info[:]  # inferred shapes with the old batch dimension
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.log_severity_level = 3  # errors only
        self._session = onnxruntime.InferenceSession(
            model.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )
        self._input = inputs[0].name
        self._outputs = [outputs[0].name, *self._pair_states(inputs[1:], outputs[1:])]

    @staticmethod
    def _pair_states(
        inputs: Sequence[onnx.ValueInfoProto], outputs: Sequence[onnx.ValueInfoProto]
    ) -> list[str]:
        """Names of the state outputs, in the order of the state inputs; matched by shape."""
        left = list(outputs)
        pairs = []
        for tensor in inputs:
            match = next(each for each in left if _shape(each) == _shape(tensor))
            left.remove(match)
            pairs.append(match.name)
        return pairs

    def __call__(
        self, observation: np.ndarray, hidden: np.ndarray, past: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate the network; see `LoadedNetwork`."""
        del past
        feed, start = {self._input: observation}, 0
        for name, shape in self._states:
            stop = start + _count(shape)
            feed[name] = _to_state(hidden[:, start:stop], shape)
            start = stop
        actions, *states = self._session.run(self._outputs, feed)
        if not states:
            return np.asarray(actions), hidden
        return np.asarray(actions), np.concatenate(
            [_from_state(np.asarray(state)) for state in states], axis=1
        )


class TorchNetwork(LoadedNetwork):
    """A TorchScript network, evaluated row by row, since many are exported for a batch of one.

    Args:
        file: Its file.

    Raises:
        PolicyFileError: If it is not TorchScript.
    """

    def __init__(self, file: Path) -> None:
        import torch  # noqa: PLC0415

        try:
            self._network = torch.jit.load(str(file), map_location="cpu").eval()
        except (RuntimeError, ValueError) as error:
            raise PolicyFileError(f"policy file '{file}' is no TorchScript network") from error

    def __call__(
        self, observation: np.ndarray, hidden: np.ndarray, past: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate the network; see `LoadedNetwork`."""
        import torch  # noqa: PLC0415

        inputs = [observation] if past is None else [observation, past]
        tensors = [torch.from_numpy(np.ascontiguousarray(each, np.float32)) for each in inputs]
        with torch.no_grad():
            rows = [
                self._network(*(tensor[row : row + 1] for tensor in tensors)).reshape(-1)
                for row in range(len(observation))
            ]
        return torch.stack(rows).numpy(), hidden


class ReferenceNetwork:
    r"""A network with normalisation, :math:`y = \mu_y + \sigma_y f((x - \mu_x)/\sigma_x)`.

    Args:
        network: f.
        file: File with the arrays of `STATISTICS`; only arrays are unpickled. None for a network
            without normalisation.

    Attributes:
        num_inputs: Width of x.
        num_outputs: Width of y.

    Raises:
        PolicyFileError: If the file lacks an array, or the width of the output is unknown.
    """

    STATISTICS = ("input_mean", "input_std", "output_mean", "output_std")

    def __init__(self, network: LoadedNetwork, file: Path | None) -> None:
        self._network = network
        self._statistics = None if file is None else _load_statistics(file, self.STATISTICS)
        inputs, outputs = network.num_inputs, network.num_outputs
        if self._statistics is not None:
            mean, std, out_mean, out_std = self._statistics
            inputs, outputs = mean.size, out_mean.size
            if (std.size, out_std.size) != (inputs, outputs):
                sizes = tuple(each.size for each in self._statistics)
                raise PolicyFileError(
                    f"policy file '{file}': means and deviations differ in size: {sizes}"
                )
        if outputs is None:
            raise PolicyFileError("a TorchScript reference needs a file of statistics")
        self.num_inputs, self.num_outputs = inputs, outputs

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Evaluate the network. Shape (n, num_inputs) -> (n, num_outputs)."""
        nothing = np.zeros((len(values), 0))
        if self._statistics is None:
            return self._network(values.astype(np.float32), nothing)[0]
        mean, std, out_mean, out_std = self._statistics
        scaled = ((values - mean) / (std + 1e-8)).astype(np.float32)
        return self._network(scaled, nothing)[0] * out_std + out_mean


def _load_onnx(file: Path) -> LoadedNetwork:
    import onnx  # noqa: PLC0415
    from google.protobuf.message import DecodeError  # noqa: PLC0415

    try:
        model = onnx.load(str(file))
    except DecodeError as error:
        raise PolicyFileError(f"policy file '{file}' is not an ONNX model") from error
    return OnnxNetwork(model, str(file))


def _load_layers(file: Path) -> LoadedNetwork:
    return OnnxNetwork(build_mlp(*load_weights(file)), str(file))


def _shape(tensor: onnx.ValueInfoProto) -> tuple[int | str, ...]:
    dims = tensor.type.tensor_type.shape.dim
    return tuple(dim.dim_param or dim.dim_value for dim in dims)


def _count(shape: tuple[int | str, ...]) -> int:
    """Size of one robot's state, of shape (layers, batch, size) or (batch, size)."""
    layers = int(shape[0]) if len(shape) == 3 else 1
    return layers * int(shape[-1])


def _to_state(hidden: np.ndarray, shape: tuple[int | str, ...]) -> np.ndarray:
    """Reshape states for the network. Shape (n, layers * size) -> (layers, n, size)."""
    state = hidden.astype(np.float32)
    if len(shape) == 2:
        return state
    size = int(shape[-1])
    return np.ascontiguousarray(state.reshape(len(state), -1, size).transpose(1, 0, 2))


def _from_state(state: np.ndarray) -> np.ndarray:
    """Inverse of `_to_state`."""
    if state.ndim == 2:
        return state
    return state.transpose(1, 0, 2).reshape(state.shape[1], -1)


def build_mlp(
    weights: Sequence[np.ndarray], biases: Sequence[np.ndarray], activation: str = "Elu"
) -> onnx.ModelProto:
    """Build a multilayer perceptron as an ONNX model.

    Args:
        weights: Weight matrix of each layer. Shapes (inputs, outputs), float32.
        biases: Bias of each layer. Shapes (outputs,), float32.
        activation: ONNX operator between layers.
    """
    from onnx import TensorProto, helper, numpy_helper  # noqa: PLC0415

    def describe(name: str, width: int) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", width])

    nodes, parameters, value = [], [], "observation"
    for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        last = layer == len(weights) - 1
        for name, array in ((f"w{layer}", weight), (f"b{layer}", bias)):
            parameters.append(numpy_helper.from_array(array, name))
        linear = "action" if last else f"x{layer}"
        nodes.append(helper.make_node("Gemm", [value, f"w{layer}", f"b{layer}"], [linear]))
        value = linear
        if not last:
            value = f"y{layer}"
            nodes.append(helper.make_node(activation, [linear], [value]))
    graph = helper.make_graph(
        nodes,
        "mlp",
        [describe("observation", weights[0].shape[0])],
        [describe("action", weights[-1].shape[1])],
        parameters,
    )
    opset = [helper.make_opsetid("", 17)]
    return helper.make_model(graph, opset_imports=opset, ir_version=8)


def load_weights(file: Path) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Read the layers of a multilayer perceptron.

    Returns:
        Weight matrices (inputs, outputs) and biases (outputs,), float32.

    Raises:
        PolicyFileError: If the file is missing, malformed, or its layers do not chain.
    """
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
    shapes = [weight.shape for weight in weights]
    chained = all(len(shape) == 2 for shape in shapes) and all(
        before[1] == after[0] for before, after in zip(shapes, shapes[1:], strict=False)
    )
    if not chained or [bias.shape for bias in biases] != [shape[1:] for shape in shapes]:
        raise PolicyFileError(
            f"policy file '{file}': each layer must take what the one before gives, got matrices "
            f"{shapes}"
        )
    return weights, biases


def save_weights(file: Path, weights: Sequence[np.ndarray], biases: Sequence[np.ndarray]) -> None:
    """Write the layers of a multilayer perceptron as float32, as `load_weights` reads them."""
    layers = {}
    for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        layers[f"w{layer}"] = np.asarray(weight, np.float32)
        layers[f"b{layer}"] = np.asarray(bias, np.float32)
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez(file, **layers)


def _load_statistics(file: Path, names: Sequence[str]) -> tuple[np.ndarray, ...]:
    """Load the arrays `names` of a PyTorch file, flattened. Only arrays are unpickled."""
    import torch  # noqa: PLC0415

    allowed: list[Any] = [
        np._core.multiarray._reconstruct,  # pyright: ignore[reportAttributeAccessIssue]
        np._core.multiarray.scalar,  # pyright: ignore[reportAttributeAccessIssue]
        np.ndarray,
        np.dtype,
        *(type(np.dtype(kind)) for kind in (np.float32, np.float64)),
    ]
    # Files written with NumPy 1 refer to these functions in `numpy.core`.
    aliases: list[Any] = [
        (function, f"numpy.core.multiarray.{function.__name__}") for function in allowed[:2]
    ]
    try:
        with torch.serialization.safe_globals([*allowed, *aliases]):
            found = torch.load(str(file), map_location="cpu", weights_only=True)
        return tuple(np.asarray(found[name], float).reshape(-1) for name in names)
    except (pickle.UnpicklingError, RuntimeError, KeyError, TypeError, ValueError) as error:
        raise PolicyFileError(f"policy file '{file}' holds no arrays {', '.join(names)}") from error
