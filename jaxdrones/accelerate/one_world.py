"""Rules of primitives that keep the program of one world under `jax.vmap` and under derivatives.

Their operands are the inputs of the program, some with a leading axis over worlds.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdrones.accelerate import compiler


def shapes_of(variables: Sequence[compiler.Variable], worlds: int | None = None) -> list[jax.ShapeDtypeStruct]:
    """Shapes of inputs or results of a program, of one world or of many."""
    leading = () if worlds is None else (worlds,)
    return [jax.ShapeDtypeStruct((*leading, *v.aval.shape), v.aval.dtype) for v in variables]


def abstract(variables: Sequence[compiler.Variable], worlds: int | None) -> list[Any]:
    """Types of the results of a primitive."""
    return [jax.core.ShapedArray(x.shape, x.dtype) for x in shapes_of(variables, worlds)]


def by_vmap(program: Any, mapped: Sequence[bool], worlds: int) -> Any:
    """Function of the inputs of a program, in many worlds."""
    axes = [0 if varies else None for varies in mapped]
    return jax.vmap(compiler.as_function(program, ()), axes, axis_size=worlds)


def in_more_worlds(
    operands: Sequence[Any], axes: Sequence[int | None], mapped: Sequence[bool], always: int, worlds: int | None
) -> tuple[list[Any], tuple[bool, ...], int]:
    """Operands with an axis over more worlds, whether each varies between them, and the number of these worlds.

    The axis is new, or becomes part of that over `worlds`. The first `always` operands have it in any case.
    """
    size = next(x.shape[axis] for x, axis in zip(operands, axes, strict=True) if axis is not None)

    def leading(x: Any, axis: int | None, was: bool) -> Any:
        x = x[None] if axis is None else jnp.moveaxis(x, axis, 0)
        if worlds is None:
            return jnp.broadcast_to(x, (size, *x.shape[1:]))
        x = x if was else x[:, None]
        return jnp.broadcast_to(x, (size, worlds, *x.shape[2:])).reshape(size * worlds, *x.shape[2:])

    varying = tuple(
        i < always or was or axis is not None for i, (was, axis) in enumerate(zip(mapped, axes, strict=True))
    )
    of_each = zip(operands, axes, mapped, varying, strict=True)
    return [leading(x, axis, was) if varies else x for x, axis, was, varies in of_each], varying, size


def of_worlds(results: Sequence[Array], worlds: int | None, size: int) -> tuple[list[Array], list[int]]:
    """Results of more worlds with an axis of its own for those that were added, and that axis."""
    if worlds is not None:
        results = [x.reshape(size, worlds, *x.shape[1:]) for x in results]
    return list(results), [0] * len(results)


def differentiated(
    program: Any, mapped: Sequence[bool], inputs: Sequence[Array], changes: Sequence, results: Sequence[Array]
) -> tuple[list, dict[str, Any], list[int]]:
    """Operands and parameters that compute the changes of results, and the indices of the results that have one.

    The program of the changes has the inputs of the first one, and those of their changes that are not zero.
    """
    evaluate, shapes = compiler.as_function(program, ()), shapes_of(program.invars)
    moving = [i for i, change in enumerate(changes) if not compiler.is_zero(change)]
    smooth = [i for i, x in enumerate(results) if jnp.issubdtype(x.dtype, jnp.inexact)]

    def changed(inputs: list, changes: list) -> list:
        def of_moving(*moved: Array) -> list:
            results = evaluate(*replaced(inputs, moving, moved))
            return [results[i] for i in smooth]

        if not changes:
            return [jnp.zeros_like(x) for x in of_moving()]
        return jax.jvp(of_moving, [inputs[i] for i in moving], changes)[1]

    linear, consts, _ = compiler.trace_open(changed, shapes, [shapes[i] for i in moving])
    varying = (*(False for _ in consts), *mapped, *(mapped[i] for i in moving))
    return [*consts, *inputs, *(changes[i] for i in moving)], dict(program=linear, mapped=varying), smooth


def transposed(
    program: Any, mapped: Sequence[bool], worlds: int | None, inputs: Sequence, given: Sequence
) -> tuple[list, dict[str, Any], Callable[[Sequence[Array]], list]]:
    """Operands and parameters that compute the cotangents of the inputs in which a program is linear.

    Also a function from what these give to the cotangents of all inputs; those of a shared input are summed up. The
    program of the cotangents has the other inputs, and the cotangents of the results that are not zero.
    """
    evaluate, shapes = compiler.as_function(program, ()), shapes_of(program.invars)
    linear = [i for i, x in enumerate(inputs) if compiler.is_linear(x)]
    known = [i for i in range(len(inputs)) if i not in linear]
    used = [i for i, x in enumerate(given) if not compiler.is_zero(x)]
    of_results = shapes_of([program.outvars[i] for i in used])

    def backward(values: list, given: list) -> list:
        def of_linear(*moved: Array) -> list:
            found = evaluate(*replaced(replaced([None] * len(shapes), known, values), linear, moved))
            return [found[i] for i in used]

        return jax.linear_transpose(of_linear, *(shapes[i] for i in linear))(given)

    def of_inputs(found: Sequence[Array]) -> list:
        shared = [worlds is not None and not mapped[i] for i in linear]
        summed = [x.sum(axis=0) if sums else x for x, sums in zip(found, shared, strict=True)]
        return replaced([None] * len(inputs), linear, summed)

    back, consts, _ = compiler.trace_open(backward, [shapes[i] for i in known], of_results)
    varying = (*(False for _ in consts), *(mapped[i] for i in known), *(worlds is not None for _ in used))
    operands = [*consts, *(inputs[i] for i in known), *(given[i] for i in used)]
    return operands, dict(program=back, mapped=varying), of_inputs


def replaced(values: Sequence, places: Sequence[int], others: Sequence) -> list:
    """Copy of a list with other values in some places."""
    new = list(values)
    for i, x in zip(places, others, strict=True):
        new[i] = x
    return new
