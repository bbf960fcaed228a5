"""Learners by gradients of the simulation or by policy gradients, and evaluation."""

from jaxdrones.learning import bptt, league, loggers, ppo, shac
from jaxdrones.learning.evaluation import Report, evaluate
from jaxdrones.learning.networks import OwnNetwork, Policy, RecurrentPolicy
from jaxdrones.learning.result import Diverged, Result

__all__ = ["Diverged", "OwnNetwork", "Policy", "RecurrentPolicy", "Report", "Result", "evaluate"]
__all__ += ["bptt", "league", "loggers", "ppo", "shac"]
