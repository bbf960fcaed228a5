"""Unstable interfaces of JAX: traced programs, XLA attributes and compiler options.

They are used only here. If a version of JAX lacks one of them, `AVAILABLE` is False or a function raises
`UnknownError`, with a fallback in the callers.
"""

import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import jax

try:
    from jax.experimental.xla_metadata import set_xla_metadata
    from jax.extend.core import ClosedJaxpr, Literal, Primitive, jaxpr_as_fun
    from jax.interpreters import ad, batching, mlir
    from jax.interpreters.partial_eval import dce_jaxpr

    AVAILABLE = True
    """Whether this version of JAX supports `over_worlds` beyond `jax.vmap`."""
except ImportError:
    AVAILABLE = False

try:
    from jax.extend.core import unsafe_am_i_under_a_jit_DO_NOT_USE as is_inside_jit
except ImportError:
    _constant = jax.jit(lambda: 0)

    def is_inside_jit() -> bool:
        """Whether the caller runs inside a traced program."""
        return isinstance(_constant(), jax.core.Tracer)


Equation = Any
"""Equation of a traced program, with `primitive`, `params`, `invars`, `outvars` and `effects`."""
Variable = Any
"""Variable of a traced program, with shape and type in its `aval`."""

PLAIN_CALLS = frozenset("jit pjit closed_call core_call".split())
"""Primitives that only call a program."""

CALLS = PLAIN_CALLS | frozenset("apart remat remat2 checkpoint custom_jvp_call custom_vjp_call".split())
"""Plain calls, and calls with rules of their own under derivatives or `jax.vmap`."""


def is_cpu() -> bool:
    """Whether the default device of JAX is a CPU."""
    return jax.default_backend() == "cpu"


class UnknownError(Exception):
    """Unknown form of a traced program."""


def kernel_options() -> dict[str, Any]:
    """Options of `jax.jit` for a single kernel on a CPU; empty on other devices.

    They select wider vectors if available, the older code generator of XLA, and no sums by a library, which a single
    kernel cannot call. Options unknown to the installed compiler are left out.
    """
    return _known(
        xla_cpu_prefer_vector_width=512, xla_cpu_use_fusion_emitters=False, xla_cpu_experimental_ynn_fusion_type=""
    )


def small_options() -> dict[str, Any]:
    """Options of `jax.jit` for a function that may be a single kernel on a CPU: no sums by a library."""
    return _known(xla_cpu_experimental_ynn_fusion_type="")


def training_options(large_arrays: bool) -> dict[str, Any]:
    """Options for short compilation and execution of trainings on a CPU; empty on other devices.

    LLVM's optimizations beyond the first level gain nothing. The older code generator of XLA compiles in two thirds of
    the time. Its elementwise code is up to ten times slower, which shows in `large_arrays`, the epochs of PPO on large
    batches and images, and not in a program that differentiates the physics and is dominated by its many small arrays.
    """
    older = {} if large_arrays else {"xla_cpu_use_fusion_emitters": False}
    return _known(xla_backend_optimization_level=1, **older)


@functools.cache
def _known(**options: Any) -> dict[str, Any]:
    if not is_cpu():
        return {}
    return {name: value for name, value in options.items() if _is_supported(name, value)}


def _is_supported(name: str, value: Any) -> bool:
    try:
        jax.jit(lambda: 0).lower().compile({name: value})
    except Exception as error:  # of another type in every version
        if "No such compile option" not in str(error):
            raise
        return False
    return True


def set_notes(result: Any, **notes: str) -> Any:
    """Result of a call with XLA attributes, or of a plain call without support in JAX."""
    return set_xla_metadata(result, **notes) if AVAILABLE else result


def primitive(
    name: str,
    compute: Callable,
    at_once: Callable,
    shapes: Callable,
    batched: Callable,
    differentiated: Callable,
    transposed: Callable,
) -> Any:
    """Primitive of several results, with its rules as JAX calls them; `compute` is what is compiled.

    In `differentiated` a tangent can be `zero_of` a number, and `is_zero` then; in `transposed` it can be a cotangent,
    and an input in which the primitive is linear `is_linear`.
    """
    new = Primitive(name)
    new.multiple_results = True
    new.def_impl(at_once)
    new.def_abstract_eval(shapes)
    batching.primitive_batchers[new] = batched
    ad.primitive_jvps[new] = differentiated
    ad.primitive_transposes[new] = transposed
    mlir.register_lowering(new, mlir.lower_fun(compute, multiple_results=True))
    return new


def zero_of(x: Any) -> Any:
    """Tangent of an array that does not change."""
    return ad.Zero(jax.typeof(x).to_tangent_aval())


def is_zero(tangent: Any) -> bool:
    """Whether a tangent or cotangent is zero without being an array."""
    return type(tangent) is ad.Zero


def instantiated(tangent: Any) -> Any:
    """Tangent as an array, also if it is zero."""
    return ad.instantiate_zeros(tangent)


def is_linear(x: Any) -> bool:
    """Whether the operand of a transposed primitive is an input in which it is linear."""
    return ad.is_undefined_primal(x)


def trace(function: Callable, *arguments: Any) -> tuple[Any, list, Any]:
    """Program of a function, its closed-over values, and the shapes of its result."""
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
    return *opened(closed), shape


def trace_open(function: Callable, *arguments: Any) -> tuple[Any, list, Any]:
    """Program of a function without closed-over values, its inputs that replace them, and the shapes of its result."""
    program, consts, shape = trace(function, *arguments)
    return (
        _program([*program.constvars, *program.invars], program.outvars, program.eqns, program.effects),
        consts,
        shape,
    )


def opened(program: Any) -> tuple[Any, list]:
    """Program and its closed-over values; one object since JAX 0.12."""
    if hasattr(program, "consts"):
        return getattr(program, "jaxpr", program), list(program.consts)
    return program, []


def without_dead(program: Any) -> tuple[Any, list[bool]]:
    """Program without inputs and equations that no result depends on, and whether each input is kept."""
    return dce_jaxpr(program, [True] * len(program.outvars))


def as_function(program: Any, consts: Sequence) -> Callable[..., list]:
    """Function of a program."""
    return jaxpr_as_fun(ClosedJaxpr(program, list(consts)))


def alone(equation: Equation, variables: Iterable[Variable], results: Iterable[Variable]) -> Callable[..., list]:
    """Function from some variables of an equation to some of its results."""
    return as_function(_program(variables, results, [equation], equation.effects), ())


def _program(inputs: Iterable, results: Iterable, equations: Sequence[Equation], effects: Any) -> Any:
    parts = dict(invars=[*inputs], outvars=[*results], eqns=equations, effects=effects)
    return opened(_nothing())[0].replace(**parts)


@functools.cache
def _nothing() -> Any:
    """Empty program, as a template."""
    return jax.make_jaxpr(lambda: ())()


def is_literal(variable: Variable) -> bool:
    """Whether a variable is a literal."""
    return isinstance(variable, Literal)


def held(equation: Equation) -> Iterator[Any]:
    """Programs in the parameters of an equation."""
    for value in equation.params.values():
        for each in value if isinstance(value, tuple | list) else (value,):
            if hasattr(each, "eqns"):
                yield opened(each)[0]


def called(equation: Equation) -> tuple[Any, list]:
    """Program of an equation with a primitive of `CALLS`."""
    for name in ("jaxpr", "call_jaxpr", "fun_jaxpr", "program"):
        if name in equation.params:
            return opened(equation.params[name])
    raise UnknownError(f"{equation.primitive.name} holds no program")


def scan_counts(equation: Equation) -> tuple[int, int]:
    """Numbers of constants and of carries of a scan."""
    params = equation.params
    if "num_carry" in params:
        return params["num_consts"], params["num_carry"]
    try:
        consts, carry, _ = params["ft_in"].unpack()
        return len(consts), len(carry)
    except (KeyError, AttributeError, TypeError, ValueError) as error:
        raise UnknownError(f"scan has {', '.join(params)}") from error


def scan_of(equation: Equation, evaluate: Callable[..., list], inputs: Sequence) -> list:
    """Results of a scan with its body evaluated by `evaluate(program, consts, *inputs)`."""
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
    """Results of an equation."""
    variables = {v: x for v, x in zip(equation.invars, inputs, strict=True) if not is_literal(v)}
    return alone(equation, variables, equation.outvars)(*variables.values())


def depends(function: Callable, *arguments: Any) -> Any:
    """Pytree of booleans: dependence of each array of a function's result on its first argument.

    It is a property of the traced program, so it holds for all values of the arguments. In opaque equations (loops,
    custom derivative rules) all outputs are assumed to depend on all inputs.
    """
    program, _, shape = trace(function, *arguments)
    first = len(jax.tree.leaves(arguments[0]))
    given = [i < first for i in range(len(program.invars))]
    return jax.tree.unflatten(jax.tree.structure(shape), _dependent(program, given))


def _dependent(program: Any, given: Sequence[bool]) -> list[bool]:
    """Dependence of the results of a program on the inputs marked true."""
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
    """Index of the forwarded input of every result of a program, or nothing."""
    inputs = {v: i for i, v in enumerate(program.invars)}
    return [None if is_literal(v) else inputs.get(v) for v in program.outvars]


def _is_forwarded(*sources: int | None) -> bool:
    """Whether a result is the same forwarded input in all branches."""
    return sources[0] is not None and len(set(sources)) == 1
