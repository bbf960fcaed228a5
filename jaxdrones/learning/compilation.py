"""Compilation of trainings and evaluations."""

from collections.abc import Callable
from typing import Any

import jax

from jaxdrones.accelerate.compiler import training_options
from jaxdrones.envs import Env
from jaxdrones.learning.gradients import GradientConfig
from jaxdrones.learning.settings import Config


def jit(function: Callable, env: Env, config: Config | None = None, **arguments: Any) -> Any:
    """`jax.jit` with compiler options for the updates of a learner in an environment.

    The result can be called or lowered, but not inside another traced function, where JAX rejects compiler options. The
    options depend on the device, so this initializes it.
    """
    has_epochs = config is not None and not isinstance(config, GradientConfig)
    options = training_options(large_arrays=has_epochs or env.vision is not None)
    return jax.jit(function, compiler_options=options, **arguments)
