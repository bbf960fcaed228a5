"""Functions of one world that `jax.vmap` computes in kernels of their own.

The primitive here keeps the program of one world under `jax.vmap` and under derivatives. Only when it is compiled, it
is laid out for all worlds, see `soa`: a single kernel on a CPU, few kernels on an accelerator. Programs of few entries
are computed number by number, others array by array, which on an accelerator is left to `jax.vmap`.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdrones.accelerate import compiler, one_world
from jaxdrones.accelerate.chunks import kernel_of_chunks
from jaxdrones.accelerate.fitting import (
    NoKernelError,
    can_be_a_kernel,
    fits_number_by_number,
    has_few_entries,
    has_reverse_rule,
)
from jaxdrones.accelerate.soa import over_last_axis

P = ParamSpec("P")
R = TypeVar("R")


def apart_under_vmap(function: Callable[P, R]) -> Callable[P, R]:
    """Compute a function of one world in kernels of its own under `jax.vmap`, and so its derivatives.

    In reverse mode it is recomputed. It is unchanged if a primitive forbids it.
    """

    def called(*arguments: P.args, **named: P.kwargs) -> R:
        if not compiler.AVAILABLE:
            return function(*arguments, **named)
        leaves, tree = jax.tree.flatten((arguments, named))
        program, consts, shape = compiler.trace_open(lambda *leaves: _called(function, tree, leaves), *leaves)
        if not _fits(program) or has_reverse_rule(program):
            return function(*arguments, **named)
        inputs = [*consts, *map(jnp.asarray, leaves)]
        results = _apart.bind(*inputs, program=program, mapped=(False,) * len(inputs), worlds=None)
        return jax.tree.unflatten(jax.tree.structure(shape), results)

    return functools.wraps(function)(called)


def _called(function: Callable, tree: Any, leaves: Sequence) -> Any:
    arguments, named = jax.tree.unflatten(tree, leaves)
    return function(*arguments, **named)


def _fits(program: Any) -> bool:
    return can_be_a_kernel(program) and (compiler.is_cpu() or _by_numbers(program))


def _by_numbers(program: Any) -> bool:
    return fits_number_by_number(program) and has_few_entries(program)


def _computed(*inputs: Array, program: Any, mapped: tuple[bool, ...], worlds: int | None) -> list[Array]:
    if worlds is None:
        return compiler.as_function(program, ())(*inputs)
    by_vmap = one_world.by_vmap(program, mapped, worlds)
    if not worlds or not _fits(program):  # a derivative can have other primitives than its function
        return by_vmap(*inputs)

    def many(same: Sequence[Array], varying: Sequence[Array]) -> list[Array]:
        found = {True: iter([jnp.moveaxis(x, 0, -1) for x in varying]), False: iter(same)}
        last = [next(found[varies]) for varies in mapped]
        results = over_last_axis(program, last, mapped, _by_numbers(program))
        return [jnp.moveaxis(x, -1, 0) for x in results]

    same, varying = ([x for x, varies in zip(inputs, mapped, strict=True) if varies == wanted] for wanted in (0, 1))
    try:
        return kernel_of_chunks(many, same, varying, worlds) if compiler.is_cpu() else many(same, varying)
    except (NoKernelError, compiler.UnknownError):  # an equation of an unsupported form
        return by_vmap(*inputs)


def _at_once(*inputs: Array, **params: Any) -> list[Array]:
    return jax.jit(functools.partial(_computed, **params))(*inputs)


def _shapes(*_: Any, program: Any, worlds: int | None, **__: Any) -> list[Any]:
    return one_world.abstract(program.outvars, worlds)


def _batched(operands: Sequence, axes: Sequence, *, program: Any, mapped: tuple, worlds: int | None) -> tuple:
    """More worlds: an axis over worlds, or one over worlds of worlds, which becomes part of it."""
    operands, varying, size = one_world.in_more_worlds(operands, axes, mapped, 0, worlds)
    results = _apart.bind(*operands, program=program, mapped=varying, worlds=size * (worlds or 1))
    return one_world.of_worlds(results, worlds, size)


def _differentiated(primals: Sequence, tangents: Sequence, *, program: Any, mapped: tuple, worlds: int | None) -> tuple:
    """Results, and their changes by the program of the changes of one world."""
    results = _apart.bind(*primals, program=program, mapped=mapped, worlds=worlds)
    operands, params, smooth = one_world.differentiated(program, mapped, primals, tangents, results)
    found = _apart.bind(*operands, worlds=worlds, **params)
    return results, one_world.replaced([compiler.zero_of(x) for x in results], smooth, found)


def _transposed(given: Sequence, *inputs: Any, program: Any, mapped: tuple, worlds: int | None) -> list:
    """Cotangents of the inputs in which the program is linear."""
    operands, params, of_inputs = one_world.transposed(program, mapped, worlds, inputs, given)
    return of_inputs(_apart.bind(*operands, worlds=worlds, **params))


if compiler.AVAILABLE:
    _apart = compiler.primitive("apart", _computed, _at_once, _shapes, _batched, _differentiated, _transposed)
    """Operands are the inputs of `program`. Those that are `mapped` and all results have a leading axis over `worlds`;
    without worlds (`None`) nothing has it."""
