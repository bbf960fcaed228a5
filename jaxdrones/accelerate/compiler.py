"""Traced programs, notes to XLA and its options: the interfaces that JAX does not promise to keep.

They are used here and nowhere else. Where a version of JAX lacks one of them, `AVAILABLE` is False or a function raises
`UnknownError`, and callers do without.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import jax

try:
    from jax.experimental.xla_metadata import set_xla_metadata
    from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun

    AVAILABLE = True
    """Whether this version of JAX has all that `over_worlds` needs beside `jax.vmap`."""
except ImportError:
    AVAILABLE = False

try:
    from jax.extend.core import unsafe_am_i_under_a_jit_DO_NOT_USE as is_inside_jit
except ImportError:
    _constant = jax.jit(lambda: 0)

    def is_inside_jit() -> bool:
        """Whether what is computed here becomes a part of a traced program."""
        return isinstance(_constant(), jax.core.Tracer)


Equation = Any
"""One line of a traced program, with `primitive`, `params`, `invars`, `outvars` and `effects`."""
Variable = Any
"""An array in a traced program; its shape and type are its `aval`."""

PLAIN_CALLS = frozenset("jit pjit closed_call core_call".split())
"""Primitives that run the program that they hold, and do nothing else."""

CALLS = PLAIN_CALLS | frozenset("remat remat2 checkpoint custom_jvp_call custom_vjp_call".split())
"""The plain calls, and those that also say how derivatives are taken."""


class UnknownError(Exception):
    """A traced program has a form that this code does not know."""


def kernel_options() -> dict[str, Any]:
    """The options of `jax.jit` with which a single kernel is fastest on a CPU; none on other devices.

    Wider vectors where the CPU has them, the older code generator of XLA, and no sums by a library, which a single
    kernel cannot call. Options that the installed compiler does not know are left out.
    """
    return _known(
        xla_cpu_prefer_vector_width=512, xla_cpu_use_fusion_emitters=False, xla_cpu_experimental_ynn_fusion_type=""
    )


def training_options() -> dict[str, Any]:
    """The options with which training compiles faster on a CPU, and runs as fast; none on other devices."""
    return _known(xla_cpu_use_fusion_emitters=False)


@functools.cache
def _known(**options: Any) -> dict[str, Any]:
    if jax.default_backend() != "cpu":
        return {}
    return {name: value for name, value in options.items() if _is_known(name, value)}


def _is_known(name: str, value: Any) -> bool:
    try:
        jax.jit(lambda: 0).lower().compile({name: value})
    except Exception as error:  # of another type in every version
        if "No such compile option" not in str(error):
            raise
        return False
    return True


def set_notes(result: Any, **notes: str) -> Any:
    """The result of a call that carries notes to XLA, or is the plain result where this version of JAX has none."""
    return set_xla_metadata(result, **notes) if AVAILABLE else result


def trace(function: Callable, *arguments: Any) -> tuple[Any, list, Any]:
    """The program of a function, the values that it closes over, and the shapes of its result."""
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
    return *opened(closed), shape


def opened(program: Any) -> tuple[Any, list]:
    """A program, and the values that it closes over. Since JAX 0.12 they are one object."""
    if hasattr(program, "consts"):
        return getattr(program, "jaxpr", program), list(program.consts)
    return program, []


def as_function(program: Any, consts: Sequence) -> Callable[..., list]:
    """A program as a function of its inputs."""
    return jaxpr_as_fun(ClosedJaxpr(program, list(consts)))


def alone(equation: Equation, variables: Iterable[Variable], results: Iterable[Variable]) -> Callable[..., list]:
    """An equation as a function of some of its variables, which returns some of its results."""
    parts = dict(invars=[*variables], outvars=[*results], eqns=[equation], effects=equation.effects)
    return as_function(opened(_nothing())[0].replace(**parts), ())


@functools.cache
def _nothing() -> Any:
    """A program without equations, as a template for others."""
    return jax.make_jaxpr(lambda: ())()


def is_literal(variable: Variable) -> bool:
    """Whether a variable stands for a number that is written in the program."""
    return isinstance(variable, Literal)


def held(equation: Equation) -> Iterator[Any]:
    """The programs that an equation holds, whatever its parameters are called."""
    for value in equation.params.values():
        for each in value if isinstance(value, tuple | list) else (value,):
            if hasattr(each, "eqns"):
                yield opened(each)[0]


def called(equation: Equation) -> tuple[Any, list]:
    """The program of an equation whose primitive is one of `CALLS`."""
    for name in ("jaxpr", "call_jaxpr", "fun_jaxpr"):
        if name in equation.params:
            return opened(equation.params[name])
    raise UnknownError(f"{equation.primitive.name} holds no program")


def scan_counts(equation: Equation) -> tuple[int, int]:
    """How many inputs of a scan are the same in all passages, and how many are carried."""
    params = equation.params
    if "num_carry" in params:
        return params["num_consts"], params["num_carry"]
    try:
        consts, carry, _ = params["ft_in"].unpack()
        return len(consts), len(carry)
    except (KeyError, AttributeError, TypeError, ValueError) as error:
        raise UnknownError(f"scan has {', '.join(params)}") from error


def scan_of(equation: Equation, evaluate: Callable[..., list], inputs: Sequence) -> list:
    """The results of a scan whose passages are evaluated by `evaluate(program, consts, *inputs)`."""
    consts, carried = scan_counts(equation)
    program, own_consts = opened(equation.params["jaxpr"])
    same, first, stacks = inputs[:consts], inputs[consts : consts + carried], inputs[consts + carried :]

    def passage(carry, xs):
        results = evaluate(program, own_consts, *same, *carry, *xs)
        return results[:carried], results[carried:]

    options = {name: equation.params[name] for name in ("length", "reverse", "unroll")}
    carry, ys = jax.lax.scan(passage, list(first), list(stacks), **options)
    return [*carry, *ys]


def evaluated(equation: Equation, inputs: Sequence) -> list:
    """The results of an equation."""
    variables = {v: x for v, x in zip(equation.invars, inputs, strict=True) if not is_literal(v)}
    return alone(equation, variables, equation.outvars)(*variables.values())


def depends(function: Callable, *arguments: Any) -> Any:
    """Which numbers of a function's result depend on its first argument: a pytree of booleans like the result.

    It is read off the traced program, so it holds for all values of the arguments. Where the program is not transparent
    (a loop, a derivative rule of its own) everything that goes in may change everything that comes out.
    """
    program, _, shape = trace(function, *arguments)
    first = len(jax.tree.leaves(arguments[0]))
    given = [i < first for i in range(len(program.invars))]
    return jax.tree.unflatten(jax.tree.structure(shape), _dependent(program, given))


def _dependent(program: Any, given: Sequence[bool]) -> list[bool]:
    """Which results of a program depend on the inputs that are given as true."""
    known = dict(zip(program.invars, given, strict=True))

    def depends(variable: Variable) -> bool:
        return not is_literal(variable) and known.get(variable, False)

    for eqn in program.eqns:
        inputs = [depends(v) for v in eqn.invars]
        if eqn.primitive.name in PLAIN_CALLS:
            found = _dependent(called(eqn)[0], inputs)
        elif eqn.primitive.name == "cond":
            branches = [opened(branch)[0] for branch in eqn.params["branches"]]
            found = [inputs[0] and not same for same in map(_is_forwarded, *(_sources(b) for b in branches))]
            for branch in branches:
                found = [a or b for a, b in zip(found, _dependent(branch, inputs[1:]), strict=True)]
        else:
            found = [any(inputs)] * len(eqn.outvars)
        known |= dict(zip(eqn.outvars, found, strict=True))
    return [depends(v) for v in program.outvars]


def _sources(program: Any) -> list[int | None]:
    """For every result of a program the index of the input that it is, or nothing."""
    inputs = {v: i for i, v in enumerate(program.invars)}
    return [None if is_literal(v) else inputs.get(v) for v in program.outvars]


def _is_forwarded(*sources: int | None) -> bool:
    """Whether a result is the same input in all branches."""
    return sources[0] is not None and len(set(sources)) == 1
