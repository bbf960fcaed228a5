"""`over_worlds`: fast simulation of many worlds."""

import functools
import itertools
import warnings
from collections.abc import Callable, Sequence
from typing import Any, ParamSpec, TypeVar, cast

import jax
import jax.numpy as jnp
from jax.sharding import AxisType, PartitionSpec
from jaxtyping import Array

from jaxdrones.accelerate import compiler
from jaxdrones.accelerate.chunks import ChunkedProgram
from jaxdrones.accelerate.fitting import NoKernelError
from jaxdrones.checks import check_function, check_sequence, check_whole
from jaxdrones.errors import UserError

_TRACER = jax.core.Tracer

P = ParamSpec("P")
R = TypeVar("R")


def over_worlds(
    function: Callable[P, R], in_axes: int | Sequence[int] = 0, devices: Sequence[jax.Device] = ()
) -> Callable[P, R]:
    """Vectorize a function of one world over many worlds, like `jax.vmap`, and compile it.

    It accepts every traceable function. The first call with arguments of some shapes compiles, like `jax.jit`, and
    later calls reuse the program, so keep the returned function. Closed-over values are fixed at the first call; values
    that change, such as the weights of a network, are arguments of a `jax.jit` around it. Inside of `jax.jit`,
    `jax.grad` or another transformation it is traced like any other function, which is slower on a CPU: take
    derivatives inside, `over_worlds(jax.grad(miss))`.

    On a CPU the worlds are computed in chunks that fit in the cache. A function of loops and arithmetic, such as a
    flight or its gradient, is compiled to a single kernel on one core; on an accelerator each iteration of its loops is
    one or a few kernels. With sorting, large matrix products, solvers, random numbers or branches it is compiled as
    usual; so it is, with a warning, if the single kernel does not compile.

    Args:
        function: function of one world; it may close over values common to all worlds.
        in_axes: axis over worlds, of each argument or of all. Commands (steps, worlds, ...), with axis 1, are read
            fastest. Results have worlds first.
        devices: devices with an equal share of the worlds each. A CPU is one device by default; before the first use of
            JAX, `jax.config.update("jax_num_cpu_devices", 2)` makes it two.

    Raises:
        ValueError: at a call with a wrong number of `in_axes`, unequal numbers of worlds, or a number of worlds that is
            not a multiple of the devices.
    """
    return in_chunks(function, None, in_axes, devices)


def in_chunks(
    function: Callable[P, R],
    chunk: int | None,
    in_axes: int | Sequence[int] = 0,
    devices: Sequence[jax.Device] = (),
) -> Callable[P, R]:
    """`over_worlds` with chunks of a given number of worlds."""
    return cast(Callable[P, R], _ManyWorlds(function, chunk, in_axes, devices))


class _ClosureIsTracedError(Exception):
    """Closure over a traced array."""


class _ManyWorlds:
    """Function of many worlds, and its compiled programs."""

    def __init__(
        self, function: Callable, chunk: int | None, in_axes: int | Sequence[int], devices: Sequence[jax.Device]
    ):
        check_function("function", function, example="jax.grad(cost)")
        self._function, self._chunk, self._in_axes = function, chunk, in_axes
        self._devices = check_sequence("devices", devices, "*jax.devices()")
        self._several_kernels = jax.jit(functools.partial(self._evaluated, kernel=False))
        self._without_kernel: set[Any] = set()  # shapes of arguments without a single kernel

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        if named:
            raise UserError(f"{', '.join(named)} is given by name; give all arguments of many worlds by position")
        can_be_kernel = self._can_be_kernel(arguments)
        if not _is_traced(arguments):
            try:
                return self._one_kernel(*arguments) if can_be_kernel else self._several_kernels(*arguments)
            except _ClosureIsTracedError:
                pass
        if can_be_kernel:
            try:
                return self._evaluated(*arguments, kernel=True)
            except NoKernelError:
                self._goes_without_kernel(arguments)
        return self._evaluated(*arguments, kernel=False)

    def _one_kernel(self, *arguments: Any) -> Any:
        """Results by a single kernel, or by several as a fallback."""
        try:
            return self._single_kernel(*arguments)
        except NoKernelError:
            self._goes_without_kernel(arguments)
        except jax.errors.JaxRuntimeError as error:
            if self._compiles(arguments):
                raise  # failed at run time
            self._goes_without_kernel(arguments)
            name = getattr(self._function, "__name__", repr(self._function))
            warnings.warn(
                f"over_worlds: the single kernel of {name} does not compile ({str(error).splitlines()[0]}); it is "
                "compiled as several kernels, which give the same numbers more slowly",
                RuntimeWarning,
                stacklevel=3,
            )
        return self._several_kernels(*arguments)

    @functools.cached_property
    def _single_kernel(self) -> Any:
        def evaluated(*arguments):
            return self._evaluated(*arguments, kernel=True, has_options=True)

        return jax.jit(evaluated, compiler_options=compiler.kernel_options())

    def _compiles(self, arguments: tuple) -> bool:
        try:
            self._single_kernel.lower(*arguments).compile()
        except jax.errors.JaxRuntimeError:
            return False
        return True

    def _can_be_kernel(self, arguments: tuple) -> bool:
        if not _is_able():
            return False
        return not self._without_kernel or _shapes(arguments) not in self._without_kernel

    def _goes_without_kernel(self, arguments: tuple) -> None:
        self._without_kernel.add(_shapes(arguments))

    def _evaluated(self, *arguments: Any, kernel: bool, has_options: bool = False) -> Any:
        """Results of many worlds.

        Raises:
            NoKernelError: the program cannot be a single kernel.
            _ClosureIsTracedError: a closure over traced arrays, which forbids compiler options.
        """
        axes = tuple(self._in_axes) if isinstance(self._in_axes, Sequence) else (self._in_axes,) * len(arguments)
        worlds = _number_of_worlds(arguments, axes)
        if self._devices and worlds % len(self._devices):
            raise UserError(
                f"{worlds} worlds cannot be shared equally by {len(self._devices)} devices; give a multiple"
            )
        if not worlds:
            return jax.vmap(self._function, axes)(*arguments)
        if not compiler.AVAILABLE:
            return self._shared(jax.vmap(self._function, axes), axes)(*arguments)

        leaves, tree = jax.tree.flatten(jax.tree.map(jnp.asarray, arguments))
        along = tuple(axis for argument, axis in zip(arguments, axes, strict=True) for _ in jax.tree.leaves(argument))
        of_one_world = [_without_axis(x, axis) for x, axis in zip(leaves, along, strict=True)]
        program, outer = ChunkedProgram.of(self._function, tree, of_one_world, along, self._chunk)
        if has_options and any(isinstance(x, jax.core.Tracer) for x in program.consts):
            raise _ClosureIsTracedError
        if not any(program.used):
            return jax.vmap(self._function, axes)(*arguments)
        try:
            if kernel and not program.fits_a_kernel:
                raise NoKernelError("a primitive is not on the list")
            flown = program.by_one_kernel if kernel else program.by_vmap
            return outer.unflatten(self._shared(flown, program.along)(*itertools.compress(leaves, program.used)))
        except compiler.UnknownError as error:
            _warn_of_version(f"has an equation ({error}) other than those")
            raise NoKernelError(str(error)) from error

    def _shared(self, function: Callable, axes: tuple[int, ...]) -> Callable:
        """Function with the worlds sharded over the devices."""
        if not self._devices:
            return function
        mesh = jax.make_mesh((len(self._devices),), ("worlds",), axis_types=(AxisType.Auto,), devices=self._devices)
        shares = tuple(PartitionSpec(*[None] * axis, "worlds") for axis in axes)
        first = PartitionSpec("worlds")
        return jax.shard_map(function, mesh=mesh, in_specs=shares, out_specs=first, check_vma=False)


def _number_of_worlds(arguments: tuple, axes: tuple[int, ...]) -> int:
    """Number of worlds, equal for all arguments."""
    for axis in axes:
        if axis is None:
            raise UserError(
                "an axis of in_axes is None; close over an argument that all worlds share, for example "
                "over_worlds(lambda start: fly(params, start)), inside of a jax.jit of it if it changes between calls"
            )
        check_whole("an axis of in_axes", axis, minimum=0)
    if len(axes) != len(arguments):
        raise UserError(f"in_axes is of {len(axes)} arguments, {len(arguments)} were given; give an axis for each")
    shapes = [(jnp.shape(x), axis) for tree, axis in zip(arguments, axes, strict=True) for x in jax.tree.leaves(tree)]
    for shape, axis in shapes:
        if len(shape) <= axis:
            raise UserError(f"an array of shape {shape} has no axis {axis} over worlds; give one, or close over it")
    found = {shape[axis] for shape, axis in shapes}
    if len(found) != 1:
        raise UserError(f"arguments of {sorted(found)} worlds, by in_axes {axes}; give all of them the same number")
    return found.pop()


def _is_traced(tree: Any) -> bool:
    """Whether any array is traced, or the caller runs inside a trace."""
    return compiler.is_inside_jit() or True in [isinstance(x, _TRACER) for x in jax.tree.leaves(tree)]


def _shapes(tree: Any) -> Any:
    leaves, structure = jax.tree.flatten(tree)
    return structure, *((jnp.shape(x), jnp.result_type(x)) for x in leaves)


def _without_axis(x: Array, axis: int) -> jax.ShapeDtypeStruct:
    shape = (*x.shape[:axis], *x.shape[axis + 1 :])
    return jax.ShapeDtypeStruct(shape, x.dtype, weak_type=jax.typeof(x).weak_type)


def _is_able() -> bool:
    if not compiler.AVAILABLE:
        _warn_of_version("lacks an interface")
    return compiler.AVAILABLE


@functools.cache
def _warn_of_version(why: str) -> None:
    warnings.warn(
        f"jaxdrones.over_worlds uses jax.vmap: JAX {jax.__version__} {why} of the supported versions",
        RuntimeWarning,
        stacklevel=5,
    )
