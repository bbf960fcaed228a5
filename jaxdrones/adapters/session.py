"""Episodes of one world on the host, with NumPy arrays and one compiled call per control step."""

from collections.abc import Callable
from typing import Annotated, Any

import jax
import numpy as np
from jax.typing import ArrayLike

from jaxdrones.adapters import pictures
from jaxdrones.adapters.spaces import Layout
from jaxdrones.arguments import checked, choice
from jaxdrones.checks import UnexpectedKeyword, check_whole
from jaxdrones.envs import AutoReset, Env, make
from jaxdrones.errors import UserError
from jaxdrones.tasks.task import Task, World

TaskOrEnv = str | Task | Callable[..., Task] | Env
"""Task as for `jaxdrones.make`, or an environment."""
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
        return as_numpy(obs)

    def step(self, action: np.ndarray) -> tuple[Any, np.ndarray, bool, bool, dict[str, Any]]:
        """One control step with a validated action (n, a); the result is that of the environment."""
        self.world, outcome = self.env.compiled(_advance)(self._key, self.world, action)
        obs, reward, terminated, truncated, info = as_numpy(outcome)
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


class TeamEpisodes:
    """Episodes by agent, `drone_0`, `drone_1`, ...: the part of the interface that PettingZoo and RLlib share.

    An agent leaves `agents` when its episode has ended, by default with all others. See `Task.ends`.
    """

    def _wrap(self, task: TaskOrEnv, options: dict[str, Any]) -> None:
        self.env = as_env(task, options)
        self.possible_agents = [f"drone_{i}" for i in range(self.env.drones)]
        self.agents: list[str] = []
        self._layout = Layout(self.env, self.possible_agents)
        self.observation_spaces = dict(self._layout.observation.items())
        self.action_spaces = dict(self._layout.action.items())
        self._session = Session(self.env)
        self._seeds = np.random.default_rng()
        self._obs: Any = None

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Start an episode; a seed makes it and the following ones reproducible. There are no options."""
        if seed is not None:
            check_whole("seed", seed, 0)
            self._seeds = np.random.default_rng(seed)
        self.agents = list(self.possible_agents)
        self._obs = self._session.reset(int(self._seeds.integers(SEEDS)) if seed is None else seed)
        return self._layout.arrange(self._obs), {agent: {} for agent in self.agents}

    def _step(self, actions: Any) -> tuple[list[dict[str, Any]], tuple[bool, bool], dict[str, Any]]:
        """Observations, rewards and ends by agent; the ends of the team; and the info of all drones."""
        if not self._session.running:
            raise UserError("step is called before reset or after the end of an episode; call reset")
        drones = {agent: i for i, agent in enumerate(self.possible_agents) if agent in self.agents}
        self._obs, reward, *ends, info = self._session.step(self._layout.gather_present(actions, drones))
        observed, flags = self._layout.arrange(self._obs), (info["terminated"], info["truncated"])
        self.agents = [agent for agent, i in drones.items() if not any(flag[i] for flag in flags)]
        results = [
            {agent: observed[agent] for agent in drones},
            {agent: reward[i].item() for agent, i in drones.items()},
            *({agent: bool(flag[i]) for agent, i in drones.items()} for flag in flags),
        ]
        return results, (ends[0], ends[1]), info

    def close(self) -> None:
        """Close the connection to Bullet, if any."""
        self._session.close()


def as_env(task: TaskOrEnv, options: dict[str, Any]) -> Env:
    """Environment of a task with options of `jaxdrones.make`, or the given one."""
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

    It is the `sum`, as in gym-pybullet-drones' `MultiHoverAviary`, or the `mean`, independent of the team's size.
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


def as_numpy(tree: Any) -> Any:
    """Copy to NumPy, real arrays in single precision."""
    return jax.tree.map(lambda x: np.array(x, np.float32 if x.dtype == np.float64 else None), tree)
