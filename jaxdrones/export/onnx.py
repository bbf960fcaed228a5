"""Policies as ONNX models with a dynamic batch."""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxdrones.errors import UserError, needs
from jaxdrones.export import layers
from jaxdrones.export.layers import Graph, Layer, Tensor
from jaxdrones.export.text import Description
from jaxdrones.learning.layers import FADE, SMALL_SQUARE

_OPSET, _IR_VERSION = 17, 8  # of 2022, which every runtime of today reads
_ACTIVATIONS = {"tanh": "Tanh", "relu": "Relu", "elu": "Elu"}


class _Nodes:
    """Nodes and initializers of a model, built layer by layer."""

    def __init__(self, onnx: Any):
        self.onnx = onnx
        self.nodes: list[Any] = []
        self.initializers: list[Any] = []

    def constant(self, name: str, value: Any) -> str:
        if all(name != x.name for x in self.initializers):
            self.initializers.append(self.onnx.numpy_helper.from_array(np.asarray(value), name))
        return name

    def node(self, kind: str, inputs: Sequence[str], output: str, **attributes: Any) -> str:
        self.nodes.append(self.onnx.helper.make_node(kind, inputs, [output], name=output, **attributes))
        return output

    def add(self, layer: Layer) -> None:
        """Nodes of one layer; images have the axes (batch, height, width, channels)."""
        y, inputs = layer.output.name, [x.name for x in layer.inputs]
        constants = {
            name: self.constant(f"{y}_{name}", x)
            for name, x in layer.constants.items()
            if not isinstance(layer, layers.Convolution)
        }
        match layer:
            case layers.Normalize():
                shifted = self.node("Sub", [*inputs, constants["mean"]], f"{y}_shifted")
                scaled = self.node("Mul", [shifted, constants["scale"]], f"{y}_scaled")
                low = self.constant(f"{y}_low", np.float32(-layer.clip))
                self.node("Clip", [scaled, low, self.constant(f"{y}_high", np.float32(layer.clip))], y)
            case layers.Dense() if len(layer.output.shape) > 1:
                product = self.node("MatMul", [*inputs, constants["kernel"]], f"{y}_product")
                self.node("Add", [product, constants["bias"]], y)
            case layers.Dense():
                self.node("Gemm", [*inputs, *constants.values()], y)
            case layers.Convolution():
                self.convolution(layer)
            case layers.Activation(function="silu"):
                self.node("Mul", [*inputs, self.node("Sigmoid", inputs, f"{y}_sigmoid")], y)
            case layers.Activation():
                self.node(_ACTIVATIONS[layer.function], inputs, y)
            case layers.Gates():
                self.gates(inputs, y)
            case layers.Nearness():
                scale = self.constant(f"{y}_scale", np.float32(layer.depth_scale))
                ahead = self.node("Max", [*inputs, self.constant("zero", np.float32(0))], f"{y}_ahead")
                near = self.node("Div", [scale, self.node("Add", [ahead, scale], f"{y}_sum")], f"{y}_near")
                self.node("Unsqueeze", [near, self.constant("last_axis", np.array([-1]))], y)
            case layers.Color():
                floats = self.node("Cast", inputs, f"{y}_float", to=self.onnx.TensorProto.FLOAT)
                rgb = self.slice(floats, f"{y}_rgb", 0, 3)
                self.node("Div", [rgb, self.constant(f"{y}_largest", np.float32(255))], y)
            case layers.Slice():
                part = self.slice(inputs[0], f"{y}_part", layer.start, layer.start + layer.output.size)
                self.node("Reshape", [part, self.constant(f"{y}_shape", np.array([-1, *layer.output.shape]))], y)
            case layers.AddToRows():
                one_row = self.node("Unsqueeze", [inputs[1], self.constant("second_axis", np.array([1]))], f"{y}_row")
                self.node("Add", [inputs[0], one_row], y)
            case layers.SumOfRows():
                self.sum_of_rows(layer)
            case layers.Concatenate():
                self.node("Concat", inputs, y, axis=-1)
            case layers.Flatten():
                self.node("Reshape", [*inputs, self.constant(f"{y}_shape", np.array([-1, layer.output.size]))], y)
            case _:
                raise AssertionError(layer)

    def slice(self, x: str, output: str, start: int, end: int) -> str:
        """Entries along the last axis."""
        ends = [self.constant(f"{output}_{name}", np.array([i])) for name, i in (("start", start), ("end", end))]
        return self.node("Slice", [x, *ends, self.constant("last_axis", np.array([-1]))], output)

    def sum_of_rows(self, layer: layers.SumOfRows) -> None:
        y, (features, rows) = layer.output.name, (x.name for x in layer.inputs)
        scalars = {"fade": FADE, "inverse": 1 / layer.reach, "small": SMALL_SQUARE, "low": 0, "high": 1}
        names = {name: self.constant(f"{y}_{name}", np.float32(x)) for name, x in scalars.items()}
        vector = self.slice(rows, f"{y}_vector", 0, 3)
        square = [self.node("Mul", [vector, vector], f"{y}_square"), self.constant("last_axis", np.array([-1]))]
        total = self.node("Add", [self.node("ReduceSum", square, f"{y}_sum"), names["small"]], f"{y}_total")
        away = self.node("Mul", [self.node("Sqrt", [total], f"{y}_away"), names["inverse"]], f"{y}_share")
        near = self.node("Sub", [self.constant("one", np.float32(1)), away], f"{y}_near")
        faded = self.node("Mul", [near, names["fade"]], f"{y}_faded")
        weight = self.node("Clip", [faded, names["low"], names["high"]], f"{y}_weight")
        weighted = self.node("Mul", [weight, features], f"{y}_weighted")
        self.node("ReduceSum", [weighted, self.constant("second_axis", np.array([1]))], y, keepdims=0)

    def convolution(self, layer: layers.Convolution) -> None:
        y, stride = layer.output.name, layer.stride
        square = layer.constants["kernel"].reshape(stride, stride, layer.inputs[0].shape[-1], -1)
        kernel = self.constant(f"{y}_kernel", np.ascontiguousarray(np.transpose(square, (3, 2, 0, 1))))
        bias = self.constant(f"{y}_bias", layer.constants["bias"])
        (top, bottom), (left, right) = layer.margin
        first = self.node("Transpose", [layer.inputs[0].name], f"{y}_channels_first", perm=[0, 3, 1, 2])
        sizes = {"kernel_shape": [stride, stride], "strides": [stride, stride], "pads": [top, left, bottom, right]}
        found = self.node("Conv", [first, kernel, bias], f"{y}_found", **sizes)
        self.node("Transpose", [found], y, perm=[0, 2, 3, 1])

    def gates(self, inputs: Sequence[str], y: str) -> None:
        *sums, hidden = inputs
        parts = {}
        for name, x in zip(("in", "state"), sums, strict=True):
            outputs = [f"{y}_{gate}_{name}" for gate in ("reset", "keep", "new")]
            self.nodes.append(self.onnx.helper.make_node("Split", [x], outputs, name=f"{y}_split_{name}", axis=-1))
            parts[name] = outputs
        reset, keep = (
            self.node(
                "Sigmoid", [self.node("Add", [parts["in"][i], parts["state"][i]], f"{y}_{gate}_sum")], f"{y}_{gate}"
            )
            for i, gate in enumerate(("reset", "keep"))
        )
        scaled = self.node("Mul", [reset, parts["state"][2]], f"{y}_new_scaled")
        new = self.node("Tanh", [self.node("Add", [parts["in"][2], scaled], f"{y}_new_sum")], f"{y}_new")
        rest = self.node("Sub", [self.constant("one", np.float32(1)), keep], f"{y}_rest")
        kept = self.node("Mul", [keep, hidden], f"{y}_kept")
        self.node("Add", [kept, self.node("Mul", [rest, new], f"{y}_added")], y)


def model(graph: Graph, description: Description) -> bytes:
    """Serialized ONNX model of a policy, with a `description` of inputs and outputs as metadata.

    Its inputs are `obs` (batch, d), images (batch, height, width, ...) and `hidden_state` (batch, size), its outputs
    `act` (batch, a) and `next_hidden_state`.
    """
    with needs("onnx", "export", UserError):
        import onnx
        import onnx.checker
        import onnx.helper
        import onnx.numpy_helper
    nodes = _Nodes(onnx)
    for layer in graph.layers:
        nodes.add(layer)
    outputs = {"act": graph.action}
    if graph.next_hidden_state:
        outputs["next_hidden_state"] = graph.next_hidden_state
    for name, x in outputs.items():
        nodes.node("Identity", [x.name], name)

    def value(name: str, x: Tensor) -> Any:
        kind = onnx.TensorProto.UINT8 if x.dtype == "uint8" else onnx.TensorProto.FLOAT
        return onnx.helper.make_tensor_value_info(name, kind, ["batch", *x.shape])

    network = onnx.helper.make_graph(
        nodes.nodes,
        "policy",
        [value(x.name, x) for x in graph.inputs],
        [value(name, x) for name, x in outputs.items()],
        nodes.initializers,
    )
    made = onnx.helper.make_model(
        network,
        opset_imports=[onnx.helper.make_opsetid("", _OPSET)],
        ir_version=_IR_VERSION,
        producer_name="jaxdrones",
        doc_string="\n".join(description.lines()),
    )
    onnx.helper.set_model_props(made, {name: json.dumps(x) for name, x in description.as_dict().items()})
    onnx.checker.check_model(made, full_check=True)
    return made.SerializeToString()
