"""Policies in seconds: by the gradient of the simulation, and by batched policy gradient."""

from jaxdrones.learning import bptt, ppo, shac
from jaxdrones.learning.evaluation import Report, evaluate
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.result import Result

__all__ = ["Policy", "Report", "Result", "bptt", "evaluate", "ppo", "shac"]
