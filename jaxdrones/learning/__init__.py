"""Policies in seconds: by the gradient of the simulation, and by batched policy gradient."""

from jaxdrones.learning import bptt, ppo, presets, shac
from jaxdrones.learning.evaluation import Report, evaluate
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.result import COMPILER_OPTIONS, Result

__all__ = ["COMPILER_OPTIONS", "Policy", "Report", "Result", "bptt", "evaluate", "ppo", "presets", "shac"]
