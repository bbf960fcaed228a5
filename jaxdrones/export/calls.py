"""Layers as calls of a few functions on arrays, in little working memory; C and JavaScript print these calls."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxdrones.export.layers import (
    Activation,
    Color,
    Concatenate,
    Convolution,
    Dense,
    Flatten,
    Gates,
    Graph,
    Layer,
    Nearness,
    Normalize,
    Tensor,
)

_BYTES = 4  # of a number


@dataclasses.dataclass(frozen=True)
class Span:
    """Part of an array from an index on."""

    array: str
    """`work`, or an argument of the caller: `obs`, an image, `hidden`, `act`."""
    start: int = 0

    def __add__(self, offset: int) -> Span:
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
        return _BYTES * (self.work_size + self.hidden_size)


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
    """Calls of one layer, on the spans of its inputs and output."""

    def constant(name: str) -> str | None:
        return _constant(layer, name) if name in layer.constants else None

    size, shape = layer.output.size, layer.inputs[0].shape
    arguments: tuple[Any, ...]
    match layer:
        case Normalize():
            function = "normalize"
            arguments = size, inputs[0], constant("mean"), constant("scale"), layer.clip, output
        case Dense():
            function = "dense"
            arguments = shape[-1], layer.output.shape[-1], inputs[0], constant("kernel"), constant("bias"), output
        case Convolution():
            (top, _), (left, _) = layer.margin
            rows, columns, outputs = layer.output.shape
            function = "convolution"
            arguments = *shape, rows, columns, outputs, layer.stride, top, left
            arguments += inputs[0], constant("kernel"), constant("bias"), output
        case Activation():  # in place
            function, arguments = f"apply_{layer.function}", (size, output)
        case Gates():  # in place: the last input is the hidden state
            function, arguments = "gates", (size, *inputs[:2], output)
        case Nearness():
            function, arguments = "nearness", (size, inputs[0], layer.depth_scale, output)
        case Color():
            function, arguments = "color", (size // 3, inputs[0], output)
        case Concatenate():
            return _copies(layer, inputs, output)
        case Flatten():
            return []
        case _:
            raise AssertionError(layer)
    return [Call(function, arguments)]


def _copies(layer: Layer, inputs: Sequence[Span], output: Span) -> list[Call]:
    width = layer.output.shape[-1]
    calls, offset = [], 0
    for x, span in zip(layer.inputs, inputs, strict=True):
        calls.append(Call("copy", (x.size // x.shape[-1], x.shape[-1], width, span, output + offset)))
        offset += x.shape[-1]
    return calls


def _spans(graph: Graph) -> tuple[dict[Tensor, Span], int]:
    """Where each tensor lies, and the length of the working memory, in which the space of tensors is used again."""
    root: dict[Tensor, Tensor] = {x: x for x in graph.inputs}
    last_use: dict[Tensor, int] = {}
    for i, layer in enumerate(graph.layers):
        root[layer.output] = _in_place(layer, root) or layer.output
        last_use |= {root[x]: i for x in (*layer.inputs, layer.output)}
    spans = {x: Span("hidden" if x.name == "hidden_state" else x.name) for x in graph.inputs}
    spans[root[graph.action]] = Span("act")
    live: list[tuple[int, int, int]] = []  # (start, end, layer of the last use)
    for i, layer in enumerate(graph.layers):
        x = root[layer.output]
        if x not in spans:
            live = sorted(place for place in live if place[2] >= i)
            start = _first_gap(live, x.size)
            live.append((start, start + x.size, last_use[x]))
            spans[x] = Span("work", start)
    ends = [spans[x].start + x.size for x in last_use if spans[x].array == "work"]
    return {x: spans[its_root] for x, its_root in root.items()}, max(ends, default=0)


def _in_place(layer: Layer, root: dict[Tensor, Tensor]) -> Tensor | None:
    """Tensor that a layer overwrites, or that its output is another shape of."""
    return root[layer.inputs[-1]] if isinstance(layer, Activation | Flatten | Gates) else None


def _first_gap(live: Sequence[tuple[int, int, int]], size: int) -> int:
    """Start of the first free place of a size between sorted places."""
    start = 0
    for used, end, _ in live:
        if start + size <= used:
            break
        start = max(start, end)
    return start
