"""Single episodes on the host, with NumPy arrays and one compiled call per control step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import jax
import numpy as np
from jax.typing import ArrayLike

from jaxdrones.adapters import pictures
from jaxdrones.arguments import checked, choice
from jaxdrones.checks import UnexpectedKeyword
from jaxdrones.envs import AutoReset, Env, make
from jaxdrones.tasks.task import Task, World

SEEDS = 2**32  # modulus of seeds
_GROUPS = {"rewards": "reward", "metrics": "metric", "terminations": "termination", "truncations": "truncation"}


class Session:
    """World on the device, with observations as new NumPy arrays."""

    def __init__(self, env: Env):
        self.env = env
        self.world: World | None = None
        self.running = False
        """Whether an episode is in progress."""

    def reset(self, seed: int) -> Any:
        """Start an episode; return the observation."""
        self._key, self.world, obs = self.env.compiled(begin)(np.uint32(seed % SEEDS))
        self.running = True
        return _numpy(obs)

    def step(self, action: np.ndarray) -> tuple[Any, np.ndarray, bool, bool, dict[str, Any]]:
        """One control step with a validated action (n, a); the result is that of the environment."""
        self.world, outcome = self.env.compiled(_advance)(self._key, self.world, action)
        obs, reward, terminated, truncated, info = _numpy(outcome)
        terminated, truncated = bool(terminated), bool(truncated)
        self.running = not (terminated or truncated)
        return obs, reward, terminated, truncated, info

    def photo(self) -> np.ndarray:
        """Picture of the team from the side, RGB (height, width, 3) uint8."""
        assert self.world is not None
        return pictures.of_world(self.env, self.world)

    def close(self) -> None:
        """Close the connection to Bullet, if any."""
        self.running = False
        self.env.close()


def as_env(task: str | Task | Env, options: dict[str, Any]) -> Env:
    """Environment from a name, a task, or an environment."""
    if not isinstance(task, Env):
        return make(task, **options)
    if options:
        raise UnexpectedKeyword(
            f"got an unexpected keyword argument {next(iter(options))!r} beside an environment; give options to "
            "jaxdrones.make"
        )
    return task


@checked
def rewarding(team_reward: Annotated[str, choice("team_reward", ("sum", "mean"))]) -> Callable[[Any], Any]:
    """Function from the rewards (*batch, n) of the drones to that (*batch) of their team.

    Args:
        team_reward: `sum`, as in gym-pybullet-drones' `MultiHoverAviary`, or `mean`, independent of the team's size.
    """
    return lambda rewards: getattr(rewards, team_reward)(-1)


def flat(info: dict[str, Any]) -> dict[str, Any]:
    """Flatten the infos of an environment to one dictionary: `reward_position`, `metric_error`, ..."""
    return {f"{prefix}_{name}": x for group, prefix in _GROUPS.items() for name, x in info[group].items()}


def begin(env: Env | AutoReset, seed: ArrayLike) -> tuple[jax.Array, Any, Any]:
    """Key of an episode's steps, initial world, and first observation."""
    key, start = jax.random.split(jax.random.PRNGKey(seed))
    obs, world = env.reset(start)
    return key, world, obs


def _advance(env: Env, key: jax.Array, world: World, action: np.ndarray) -> tuple[World, Any]:
    obs, world, *rest = env.step(jax.random.fold_in(key, world.step), world, action)
    return world, (obs, *rest)


def _numpy(tree: Any) -> Any:
    """Copy to NumPy, real arrays in single precision."""
    return jax.tree.map(lambda x: np.array(x, np.float32 if x.dtype == np.float64 else None), tree)
