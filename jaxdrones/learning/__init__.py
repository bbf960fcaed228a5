"""Policies in seconds: by the gradient of the simulation, and by batched policy gradient."""

from typing import TYPE_CHECKING, Any

from jaxdrones.accelerate.compiler import training_options
from jaxdrones.learning import bptt, ppo, shac
from jaxdrones.learning.evaluation import Report, evaluate
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.result import Result

__all__ = ["COMPILER_OPTIONS", "Policy", "Report", "Result", "bptt", "evaluate", "ppo", "shac"]


if TYPE_CHECKING:
    COMPILER_OPTIONS: dict[str, Any]
else:

    def __getattr__(name: str):
        if name == "COMPILER_OPTIONS":  # the compiler of the device is asked, which importing should not start
            return training_options()
        raise AttributeError(f"module 'jaxdrones.learning' has no attribute {name!r}")
