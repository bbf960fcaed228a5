"""Environments: tasks, steps, action types and observations put together."""

from jaxdrones.envs.actions import ACTIONS, Action
from jaxdrones.envs.autoreset import AutoReset
from jaxdrones.envs.contract import ContractError, check_env
from jaxdrones.envs.env import Env
from jaxdrones.envs.observations import OBSERVATIONS
from jaxdrones.envs.registry import TASKS, make
from jaxdrones.tasks.task import ObservationTerm

__all__ = [
    "ACTIONS",
    "OBSERVATIONS",
    "TASKS",
    "Action",
    "AutoReset",
    "ContractError",
    "Env",
    "ObservationTerm",
    "check_env",
    "make",
]
