"""Tasks: starts, targets, rewards and terminations of episodes."""

from jaxdrones.quantity import Quantity, described
from jaxdrones.tasks.shaping import REACH_AND_STAY, out_of_control
from jaxdrones.tasks.task import ObservationTerm, Task, World

__all__ = ["REACH_AND_STAY", "ObservationTerm", "Quantity", "Task", "World", "described", "out_of_control"]
