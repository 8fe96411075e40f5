"""Networks made up for tests: random weights in the shape of published policies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from xop_lerobot.low_level.networks import build_mlp


def write_mlp(file: Path, num_inputs: int, num_outputs: int, seed: int = 0) -> Path:
    """Write a network of two layers, exported for one robot."""
    rng = np.random.default_rng(seed)
    sizes = (num_inputs, 16, num_outputs)
    weights = [
        rng.normal(0, before**-0.5, (before, after)).astype(np.float32)
        for before, after in zip(sizes, sizes[1:], strict=False)
    ]
    model = build_mlp(weights, [rng.normal(0, 0.3, n).astype(np.float32) for n in sizes[1:]])
    for tensor in (*model.graph.input, *model.graph.output):
        tensor.type.tensor_type.shape.dim[0].dim_value = 1
    file.parent.mkdir(parents=True, exist_ok=True)
    onnx.save(model, str(file))
    return file


def write_recurrent(
    file: Path, num_inputs: int, num_outputs: int, hidden: int = 256, seed: int = 0
) -> Path:
    """Write h' = tanh(W o + U h), a = V h', with a state of shape (1, 1, hidden)."""
    rng = np.random.default_rng(seed)
    sizes = {"W": (num_inputs, hidden), "U": (hidden, hidden), "V": (hidden, num_outputs)}
    parameters = [
        numpy_helper.from_array(rng.normal(0, size[0] ** -0.5, size).astype(np.float32), name)
        for name, size in sizes.items()
    ]
    axis = numpy_helper.from_array(np.array([0]), "axis")
    nodes = [
        helper.make_node("Squeeze", ["h_in", "axis"], ["h"]),
        helper.make_node("MatMul", ["obs", "W"], ["wo"]),
        helper.make_node("MatMul", ["h", "U"], ["uh"]),
        helper.make_node("Add", ["wo", "uh"], ["sum"]),
        helper.make_node("Tanh", ["sum"], ["new"]),
        helper.make_node("Unsqueeze", ["new", "axis"], ["h_out"]),
        helper.make_node("MatMul", ["new", "V"], ["action"]),
    ]

    def describe(name: str, *shape: int) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)

    graph = helper.make_graph(
        nodes,
        "recurrent",
        [describe("obs", 1, num_inputs), describe("h_in", 1, 1, hidden)],
        [describe("action", 1, num_outputs), describe("h_out", 1, 1, hidden)],
        [*parameters, axis],
    )
    opset = [helper.make_opsetid("", 17)]
    file.parent.mkdir(parents=True, exist_ok=True)
    onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=8), str(file))
    return file
