"""A feed-forward network in ONNX Runtime: one thread, any batch size."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from xop_lerobot.errors import PolicyFileError

if TYPE_CHECKING:
    import onnx


class OnnxNetwork:
    """A network with one input (n, num_inputs) and one output (n, num_outputs), float32.

    The exported batch dimension may be fixed; it is relabelled, so that one call serves a
    batch. One thread computes: batches of a sampling planner are too small to split, and the
    physics wants the other cores. A session may be used by several threads at once.

    Args:
        model: The network.
        num_inputs: Width of its input.
        num_outputs: Width of its output.
        source: Where it comes from, for messages.

    Raises:
        PolicyFileError: If its inputs or outputs have other shapes.
    """

    def __init__(
        self, model: onnx.ModelProto, num_inputs: int, num_outputs: int, source: str
    ) -> None:
        import onnxruntime  # noqa: PLC0415

        graph = model.graph
        for kind, tensors, width in (
            ("input", graph.input, num_inputs),
            ("output", graph.output, num_outputs),
        ):
            shapes = [_shape(tensor) for tensor in tensors]
            if len(shapes) != 1 or len(shapes[0]) != 2 or shapes[0][1] != width:  # noqa: PLR2004
                raise PolicyFileError(
                    f"policy file '{source}': expected one {kind} of shape (batch, {width}), "
                    f"got {shapes}"
                )
            tensors[0].type.tensor_type.shape.dim[0].Clear()
            tensors[0].type.tensor_type.shape.dim[0].dim_param = "batch"
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.log_severity_level = 3
        self._session = onnxruntime.InferenceSession(
            model.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )
        self._input, self._outputs = graph.input[0].name, [graph.output[0].name]

    def __call__(self, batch: np.ndarray) -> np.ndarray:
        """Evaluate the network. Shape (n, num_inputs) -> (n, num_outputs), float32."""
        return np.asarray(self._session.run(self._outputs, {self._input: batch})[0])


def _shape(tensor: onnx.ValueInfoProto) -> tuple[int | str, ...]:
    dims = tensor.type.tensor_type.shape.dim
    return tuple(dim.dim_param or dim.dim_value for dim in dims)


def build_mlp(
    weights: list[np.ndarray], biases: list[np.ndarray], activation: str = "Elu"
) -> onnx.ModelProto:
    """Build a multilayer perceptron: `activation` between the layers, none after the last.

    Args:
        weights: Matrix of each layer. Shapes (inputs, outputs), float32.
        biases: Offset of each layer. Shapes (outputs,), float32.
        activation: Name of an ONNX operator.
    """
    from onnx import TensorProto, helper, numpy_helper  # noqa: PLC0415

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
        [_tensor_info("observation", TensorProto.FLOAT, weights[0].shape[0])],
        [_tensor_info("action", TensorProto.FLOAT, weights[-1].shape[1])],
        parameters,
    )
    opset = [helper.make_opsetid("", 17)]
    return helper.make_model(graph, opset_imports=opset, ir_version=8)


def _tensor_info(name: str, kind: int, width: int) -> onnx.ValueInfoProto:
    from onnx import helper  # noqa: PLC0415

    return helper.make_tensor_value_info(name, kind, ["batch", width])
