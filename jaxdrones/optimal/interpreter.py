"""Evaluation of traced JAX programs on CasADi symbols.

An array is a NumPy array of numbers, or of objects: numbers and scalar `casadi.SX`. Equations of numbers alone are
evaluated by JAX. Equations that only rearrange entries are evaluated by JAX on their indices.
"""

import itertools
import operator
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.accelerate import compiler
from jaxdrones.accelerate.compiler import CALLS, Equation, is_literal
from jaxdrones.optimal.primitives import ELEMENTWISE, REDUCTIONS, casadi, converted, select, truncated

_MOVES = frozenset(  # primitives that rearrange the entries of their inputs
    "broadcast_in_dim concatenate copy gather pad reshape rev slice split squeeze stack transpose "
    "expand_dims unstack dynamic_slice dynamic_update_slice scatter".split()
)
_MOVED = {"gather": (0,), "dynamic_slice": (0,), "dynamic_update_slice": (0, 1), "scatter": (0, 2)}  # others: indices
_LOGICAL = ("and", "not", "or", "xor")  # of booleans; of integers they act on bits
_UNCHANGED = frozenset(  # primitives that leave values unchanged
    "stop_gradient optimization_barrier copy_start copy_done reduce_precision name xla_metadata_value".split()
)


def on_symbols(function: Callable, **arguments: Any) -> tuple[list, Any]:
    """Evaluate a traceable function of pytrees of arrays on symbols, named like the arguments and with their shapes.

    Returns:
        One vector of symbols per argument, `casadi.SX`, and the vector of the results.
    """
    with jax.enable_x64(True):
        program, consts, _ = compiler.trace(function, *arguments.values())
        symbols = [_symbols(name, tree) for name, tree in arguments.items()]
        results = evaluate(program, consts, [array for _, arrays in symbols for array in arrays])
    numbers = [casadi.SX(number) for result in results for number in result.ravel()]
    return [vector for vector, _ in symbols], casadi.vertcat(*numbers)


def _symbols(name: str, tree: Any) -> tuple[Any, list[np.ndarray]]:
    """Vector of symbols, and the same symbols in the shapes of a pytree's leaves."""
    shapes = [np.shape(leaf) for leaf in jax.tree.leaves(tree)]
    ends = np.cumsum([0, *(int(np.prod(shape, dtype=int)) for shape in shapes)]).tolist()
    vector = casadi.SX.sym(name, ends[-1])
    numbers = np.empty(vector.numel(), object)
    numbers[:] = [vector[i] for i in range(vector.numel())]
    parts = [numbers[start:end] for start, end in itertools.pairwise(ends)]
    return vector, [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


def evaluate(program: Any, consts: Sequence, inputs: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Results of a traced program.

    Raises:
        NotImplementedError: an unsupported primitive.
    """
    values: dict[Any, np.ndarray] = dict(zip(program.constvars, map(np.asarray, consts), strict=True))
    values |= zip(program.invars, inputs, strict=True)

    def read(variable: Any) -> np.ndarray:
        return np.asarray(variable.val) if is_literal(variable) else values[variable]

    for equation in program.eqns:
        results = _evaluate_equation(equation, [read(v) for v in equation.invars])
        values |= zip(equation.outvars, results, strict=True)
    return [read(v) for v in program.outvars]


def _evaluate_equation(equation: Equation, inputs: list[np.ndarray]) -> list[np.ndarray]:
    name, params = equation.primitive.name, equation.params
    if name in CALLS:
        return evaluate(*compiler.called(equation), inputs)
    if not any(map(_is_symbolic, inputs)):
        return [np.asarray(x) for x in compiler.evaluated(equation, [jnp.asarray(x) for x in inputs])]
    if name == "convert_element_type":
        conversion = converted(np.dtype(equation.invars[0].aval.dtype), np.dtype(params["new_dtype"]))
        return inputs if conversion is None else [_elementwise(conversion, inputs)]
    if name == "div" and np.dtype(equation.invars[0].aval.dtype).kind in "iu":
        return [_elementwise(lambda x, y: truncated(x / y), inputs)]
    if name in _UNCHANGED:
        return inputs
    if name in _MOVES:
        return _moved(equation, inputs)
    bitwise = name in _LOGICAL and np.dtype(equation.invars[0].aval.dtype).kind != "b"
    if name in ELEMENTWISE and not bitwise:
        return [_elementwise(lambda *x: ELEMENTWISE[name](*x, **params), inputs)]
    if name in REDUCTIONS:
        return [_reduced(REDUCTIONS[name], inputs[0], params["axes"])]
    if name in _WHOLE:
        return _WHOLE[name](equation, inputs)
    raise NotImplementedError(
        f"the traced program has the primitive {name!r}, which has no counterpart in CasADi here; write the effect or "
        "model without it (loops of a length that depends on values, sorting and searching have none), or, if it is a "
        "function of each number, add it to jaxdrones.optimal.primitives.ELEMENTWISE"
    )


def _is_symbolic(x: np.ndarray) -> bool:
    return x.dtype == object


def _elementwise(function: Callable, inputs: Sequence[np.ndarray]) -> np.ndarray:
    shape = np.broadcast_shapes(*(x.shape for x in inputs))
    flat = [np.broadcast_to(x, shape).ravel() for x in inputs]
    return _array([function(*numbers) for numbers in zip(*flat, strict=True)], shape)


def _array(items: Sequence, shape: tuple[int, ...]) -> np.ndarray:
    result = np.empty(len(items), object)
    result[:] = items
    return result.reshape(shape)


def _moved(equation: Equation, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Results of a rearranging equation, by its effect on indices."""
    moving = _MOVED.get(equation.primitive.name, tuple(range(len(inputs))))
    if any(_is_symbolic(x) for i, x in enumerate(inputs) if i not in moving):
        raise NotImplementedError(
            f"an index of {equation.primitive.name!r} depends on the state or the command; choose by jnp.where instead"
        )
    items = np.concatenate([inputs[i].astype(object).ravel() for i in moving])
    positions: list[Any] = list(inputs)
    start = 0
    for i in moving:
        size = inputs[i].size
        positions[i] = jnp.arange(start, start + size, dtype=jnp.int32).reshape(inputs[i].shape)
        start += size
    params = equation.params
    if equation.primitive.name == "gather":  # beyond the array is a number of its own
        fill = params["fill_value"]
        items, params = np.append(items, np.nan if fill is None else fill), params | {"fill_value": len(items)}
    bound = equation.primitive.bind(*positions, **params)
    moved = bound if equation.primitive.multiple_results else [bound]
    return [items[np.asarray(x)] if np.ndim(x) else _array([items[int(x)]], ()) for x in moved]


def _reduced(function: Callable, x: np.ndarray, axes: Sequence[int]) -> np.ndarray:
    last = np.moveaxis(x, axes, range(x.ndim - len(axes), x.ndim))
    kept = last.shape[: x.ndim - len(axes)]
    rows = last.reshape(int(np.prod(kept, dtype=int)), -1)
    return _array([function(list(row)) for row in rows], kept)


def _dot_general(equation: Equation, inputs: list[np.ndarray]) -> list[np.ndarray]:
    (left_sum, right_sum), (left_batch, right_batch) = equation.params["dimension_numbers"]
    left, right = inputs

    def arranged(x: np.ndarray, batch: Sequence[int], summed: Sequence[int]) -> tuple[np.ndarray, tuple]:
        free = [i for i in range(x.ndim) if i not in (*batch, *summed)]
        shape = [int(np.prod([x.shape[i] for i in axes], dtype=int)) for axes in (batch, free, summed)]
        return x.transpose(*batch, *free, *summed).reshape(shape), tuple(x.shape[i] for i in free)

    a, left_free = arranged(left, left_batch, left_sum)
    b, right_free = arranged(right, right_batch, right_sum)
    products = a[:, :, None, :] * b[:, None, :, :]
    batch = tuple(left.shape[i] for i in left_batch)
    return [_reduced(REDUCTIONS["reduce_sum"], products, [3]).reshape(batch + left_free + right_free)]


def _cond(equation: Equation, inputs: list[np.ndarray]) -> list[np.ndarray]:
    branches = [compiler.opened(branch) for branch in equation.params["branches"]]
    results = [evaluate(program, consts, inputs[1:]) for program, consts in branches]
    return [_elementwise(select, [inputs[0], *each]) for each in zip(*results, strict=True)]


def _scan(equation: Equation, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Unrolled loop of known length."""
    constants, carried = compiler.scan_counts(equation)
    program, own = compiler.opened(equation.params["jaxpr"])
    same, carry, stacks = inputs[:constants], inputs[constants : constants + carried], inputs[constants + carried :]
    length = equation.params["length"]
    order = range(length)[::-1] if equation.params["reverse"] else range(length)
    rows: dict[int, list[np.ndarray]] = {}
    for i in order:
        results = evaluate(program, own, [*same, *carry, *(x[i] if x.ndim > 1 else np.asarray(x[i]) for x in stacks)])
        carry, rows[i] = results[:carried], results[carried:]
    columns = zip(*(rows[i] for i in range(length)), strict=True)
    return [*carry, *(np.stack([x.astype(object) for x in column]) for column in columns)]


def _accumulated(function: Callable) -> Callable[[Equation, list[np.ndarray]], list[np.ndarray]]:
    def accumulate(equation: Equation, inputs: list[np.ndarray]) -> list[np.ndarray]:
        axis, backward = equation.params["axis"], equation.params["reverse"]
        x = np.flip(inputs[0], axis) if backward else inputs[0]
        rows = itertools.accumulate(np.split(x, x.shape[axis], axis), lambda a, b: _elementwise(function, [a, b]))
        result = np.concatenate(list(rows), axis)
        return [np.flip(result, axis) if backward else result]

    return accumulate


_WHOLE: dict[str, Callable[[Equation, list[np.ndarray]], list[np.ndarray]]] = {
    "cumprod": _accumulated(operator.mul),
    "cumsum": _accumulated(operator.add),
    "dot_general": _dot_general,
    "select_n": lambda equation, inputs: [_elementwise(select, inputs)],
    "cond": _cond,
    "scan": _scan,
}
"""Primitives that are not elementwise."""
