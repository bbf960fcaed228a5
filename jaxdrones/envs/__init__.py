"""Environments: tasks with steps, action types and observations."""

from jaxdrones.envs.actions import ACTIONS, Action
from jaxdrones.envs.autoreset import AutoReset
from jaxdrones.envs.contract import ContractError, check_env
from jaxdrones.envs.disturbances import dryden
from jaxdrones.envs.env import Env
from jaxdrones.envs.explanation import Explanation, explain
from jaxdrones.envs.named_tasks import TASKS
from jaxdrones.envs.observations import OBSERVATIONS
from jaxdrones.envs.registry import make
from jaxdrones.tasks.task import ObservationTerm

__all__ = ["ACTIONS", "OBSERVATIONS", "TASKS", "Action", "ObservationTerm", "dryden"]
__all__ += ["AutoReset", "ContractError", "Env", "Explanation", "check_env", "explain", "make"]
