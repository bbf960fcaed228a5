"""Learners that train policies in seconds, by gradients of the simulation or by policy gradients, and evaluation."""

from jaxdrones.learning import bptt, ppo, shac
from jaxdrones.learning.evaluation import Report, evaluate
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.recurrence import RecurrentPolicy
from jaxdrones.learning.result import Diverged, Result

__all__ = ["Diverged", "Policy", "RecurrentPolicy", "Report", "Result", "bptt", "evaluate", "ppo", "shac"]
