"""Layers as calls of a few functions on arrays, in little working memory; C and JavaScript print these calls."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, Self

import numpy as np

from jaxdrones.export import layers
from jaxdrones.export.layers import Graph, Layer, Tensor
from jaxdrones.learning.layers import FADE, SMALL_SQUARE


@dataclasses.dataclass(frozen=True)
class Span:
    """Part of an array from an index on."""

    array: str
    """`work`, or an argument of the caller: `obs`, an image, `hidden`, `act`."""
    start: int = 0

    def __add__(self, offset: int) -> Self:
        return dataclasses.replace(self, start=self.start + offset)


@dataclasses.dataclass(frozen=True)
class Call:
    """Call of a function of the target's run-time library."""

    function: str
    arguments: tuple[int | float | str | Span | None, ...]
    """Numbers, names of constants, spans, and `None` for a missing constant."""


@dataclasses.dataclass(frozen=True, eq=False)
class Program:
    """Calls of one step, the constants that they name, and the length of their working memory."""

    calls: tuple[Call, ...]
    constants: dict[str, np.ndarray]
    work_size: int
    hidden_size: int

    @property
    def ram(self) -> int:
        """Bytes of working memory and hidden state."""
        return layers.BYTES * (self.work_size + self.hidden_size)


def program_of(graph: Graph) -> Program:
    """Calls that compute the layers of a graph in their order."""
    spans, work_size = _spans(graph)
    calls: list[Call] = []
    for layer in graph.layers:
        calls += _calls(layer, [spans[x] for x in layer.inputs], spans[layer.output])
    constants = {_constant(layer, name): x for layer in graph.layers for name, x in layer.constants.items()}
    return Program(tuple(calls), constants, work_size, graph.hidden_size)


def _constant(layer: Layer, name: str) -> str:
    return f"{layer.output.name}_{name}"


def _calls(layer: Layer, inputs: Sequence[Span], output: Span) -> list[Call]:
    def constant(name: str) -> str | None:
        return _constant(layer, name) if name in layer.constants else None

    size, shape = layer.output.size, layer.inputs[0].shape
    arguments: tuple[Any, ...]
    match layer:
        case layers.Normalize():
            function = "normalize"
            arguments = size, inputs[0], constant("mean"), constant("scale"), layer.clip, output
        case layers.Dense():
            function = "dense"
            arguments = layer.rows, shape[-1], layer.output.shape[-1], inputs[0]
            arguments += constant("kernel"), constant("bias"), output
        case layers.Convolution():
            (top, _), (left, _) = layer.margin
            rows, columns, outputs = layer.output.shape
            function = "convolution"
            arguments = *shape, rows, columns, outputs, layer.stride, top, left
            arguments += inputs[0], constant("kernel"), constant("bias"), output
        case layers.Activation():  # in place
            function, arguments = f"apply_{layer.function}", (size, output)
        case layers.Gates():  # in place: the last input is the hidden state
            function, arguments = "gates", (size, *inputs[:2], output)
        case layers.Nearness():
            function, arguments = "nearness", (size, inputs[0], layer.depth_scale, output)
        case layers.Color():
            function, arguments = "color", (size // 3, inputs[0], output)
        case layers.AddToRows():  # in place
            function, arguments = "add_to_rows", (*shape, inputs[1], output)
        case layers.SumOfRows():
            function = "sum_of_rows"
            arguments = *shape, layer.inputs[1].shape[1], *inputs, FADE, 1 / layer.reach, SMALL_SQUARE, output
        case layers.Concatenate():
            ends = itertools.accumulate((x.shape[-1] for x in layer.inputs), initial=0)
            pieces = zip(layer.inputs, inputs, ends, strict=False)
            width = layer.output.shape[-1]
            return [
                Call("copy", (x.size // x.shape[-1], x.shape[-1], width, span, output + at)) for x, span, at in pieces
            ]
        case layers.Flatten() | layers.Slice():
            return []
        case _:
            raise AssertionError(layer)
    return [Call(function, arguments)]


def _spans(graph: Graph) -> tuple[dict[Tensor, Span], int]:
    """Where each tensor lies, and the length of the working memory, in which the space of tensors is used again."""
    root: dict[Tensor, tuple[Tensor, int]] = {x: (x, 0) for x in graph.inputs}  # tensor -> tensor and offset in it
    last_use: dict[Tensor, int] = {}
    for i, layer in enumerate(graph.layers):
        root[layer.output] = _inside(layer, root) or (layer.output, 0)
        last_use |= {root[x][0]: i for x in (*layer.inputs, layer.output)}
    spans = {x: Span("hidden" if x.name == "hidden_state" else x.name) for x in graph.inputs}
    spans[root[graph.action][0]] = Span("act")
    live: list[tuple[int, int, int]] = []  # (start, end, layer of the last use)
    for i, layer in enumerate(graph.layers):
        x, _ = root[layer.output]
        if x not in spans:
            live = sorted(place for place in live if place[2] >= i)
            start = _first_gap(live, x.size)
            live.append((start, start + x.size, last_use[x]))
            spans[x] = Span("work", start)
    ends = [spans[x].start + x.size for x in last_use if spans[x].array == "work"]
    return {x: spans[outer] + offset for x, (outer, offset) in root.items()}, max(ends, default=0)


def _inside(layer: Layer, root: dict[Tensor, tuple[Tensor, int]]) -> tuple[Tensor, int] | None:
    """Tensor that a layer overwrites, or that its output is a part of, and the offset in it."""
    match layer:
        case layers.Activation() | layers.AddToRows() | layers.Flatten():
            return root[layer.inputs[0]]
        case layers.Gates():
            return root[layer.inputs[-1]]
        case layers.Slice():
            outer, offset = root[layer.inputs[0]]
            return outer, offset + layer.start
    return None


def _first_gap(live: Sequence[tuple[int, int, int]], size: int) -> int:
    """Start of the first free place of a size between sorted places."""
    start = 0
    for used, end, _ in live:
        if start + size <= used:
            break
        start = max(start, end)
    return start
