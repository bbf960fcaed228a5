"""`jit_small`: compilation of functions of few numbers."""

from collections.abc import Callable
from typing import Any

import jax

from jaxdrones.accelerate import compiler
from jaxdrones.accelerate.chunks import as_one_kernel
from jaxdrones.accelerate.fitting import can_be_a_kernel


def jit_small(function: Callable, static: int = 0) -> Callable:
    """Compile a function, like `jax.jit`; to a single kernel on a CPU, if its primitives allow it.

    XLA hands each of its usual kernels to a thread, which takes longer than the arithmetic of few numbers. The first
    `static` arguments are static. The result cannot be called inside another traced function.
    """
    programs = [jax.jit(function, static_argnums=tuple(range(static)))]
    if compiler.AVAILABLE and compiler.is_cpu():
        kernel = in_one_kernel(function, static)
        options = compiler.small_options()
        programs.append(jax.jit(kernel, static_argnums=tuple(range(static)), compiler_options=options))

    def call(*arguments: Any) -> Any:
        try:
            return programs[-1](*arguments)
        except jax.errors.JaxRuntimeError:
            if len(programs) == 1:
                raise
            programs.pop()  # the single kernel does not compile
            return call(*arguments)

    return call


def in_one_kernel(function: Callable, static: int) -> Callable:
    """Function to compile to a single kernel; unchanged if a primitive forbids it."""

    def called(*arguments: Any) -> Any:
        leaves, tree = jax.tree.flatten(arguments[static:])
        program, consts, shape = compiler.trace(
            lambda *leaves: function(*arguments[:static], *jax.tree.unflatten(tree, leaves)), *leaves
        )

        def evaluate(consts, leaves):
            return compiler.as_function(program, consts)(*leaves)

        results = (as_one_kernel(evaluate) if can_be_a_kernel(program) else evaluate)(consts, leaves)
        return jax.tree.unflatten(jax.tree.structure(shape), results)

    return called
