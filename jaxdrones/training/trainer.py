"""Compiled programs of a recipe."""

import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.arguments import Count, checked
from jaxdrones.envs import Env
from jaxdrones.errors import UserError
from jaxdrones.learning import compilation, sharding
from jaxdrones.learning.evaluation import check_episodes, compile_evaluation
from jaxdrones.learning.metrics import with_unknown
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.policies import check_fits
from jaxdrones.learning.result import advance
from jaxdrones.limits import check_memory
from jaxdrones.training import algorithms
from jaxdrones.training.plan import check_stop_at
from jaxdrones.training.recipe import Recipe
from jaxdrones.training.run import size_of

_DISK_FACTOR = 4  # number of training states that must fit on the disk


class Trainer:
    """Compiled programs of a recipe, shared by all seeds; worlds are sharded over all devices of all hosts."""

    @checked
    def __init__(self, recipe: Recipe, episodes: Count = 1000, first_policy: Policy | None = None):
        """Prepare the programs, with this number of episodes in an evaluation; `compile` compiles them.

        Trainings start from `first_policy`, or from random parameters.
        """
        self.recipe, self.episodes = recipe, episodes
        self.mesh = sharding.make_mesh(recipe.config.worlds, _devices(recipe.config))
        self.env, self.practice_env = recipe.env(), recipe.env(practice=True)
        self.learner = algorithms.learner(recipe.algorithm)
        self.compile_seconds = 0.0
        self.shapes = jax.eval_shape(self._init, jax.random.key(0))
        if first_policy is not None:
            _check_first(first_policy, self.env, self.shapes.policy)
        self.first_policy = first_policy
        self.disk_size = _DISK_FACTOR * size_of(self.shapes)
        """Bytes that a run must be able to write."""
        check_episodes(self.env, episodes)
        check_stop_at(recipe.stop_at, self.env.task.success is not None, episodes)
        actions = recipe.config.worlds * self.env.drones * self.env.action_size * jnp.zeros(()).dtype.itemsize
        step = actions + size_of((self.shapes.worlds.obs, self.shapes.worlds.hidden_state))
        size = (size_of(self.shapes) + recipe.config.horizon * step) // jax.process_count()
        what = f"{recipe.config.worlds} worlds x {recipe.config.horizon} control steps x {self.env.drones} drones"
        check_memory(f"a training of {what}", size, "give fewer worlds, a shorter horizon or smaller networks")
        start = time.perf_counter()
        self._traced = self._trace_updates()
        self.metrics = sorted(jax.eval_shape(with_unknown, self._traced.out_info[1]))
        self.compile_seconds = time.perf_counter() - start

    def compile(self) -> None:
        """Compile the programs of `start`, `evaluate(policy, key)` and `advance`, the last one concurrently."""
        start = time.perf_counter()
        state, same = sharding.state_sharding(self.mesh, self.shapes), sharding.replicated(self.mesh)
        init = compilation.jit(self._init, self.practice_env, in_shardings=same, out_shardings=state)
        with ThreadPoolExecutor(1) as beside:
            with jax.set_mesh(self.mesh):
                updates = beside.submit(self._traced.lower().compile)
                self._start = init.lower(jax.random.key(0)).compile()
            self.evaluate = compile_evaluation(self.env, self.shapes.policy, self.episodes, self.mesh.local_devices)
            self._advance = updates.result()
        self.compile_seconds += time.perf_counter() - start

    def start(self, key: jax.Array) -> Any:
        """State before the first update."""
        state = self._start(key)
        if self.first_policy is None:
            return state

        def put(x: Any, own: Any) -> Any:
            return own if x is own else jax.device_put(x.astype(own.dtype), own.sharding)

        return jax.tree.map(put, state.with_policy(self.first_policy), state)

    def advance(self, state: Any, updates: int) -> tuple[Any, dict[str, np.ndarray]]:
        """Run at most `MAX_CALL` updates in one call: the next state, and (updates,) of every metric."""
        total = jnp.asarray(self.recipe.config.updates, jnp.int32)
        state, metrics = self._advance(state, jnp.asarray(updates, jnp.int32), total)
        return state, {name: np.asarray(x)[:updates] for name, x in with_unknown(metrics).items()}

    def _trace_updates(self) -> Any:
        count = jnp.zeros((), jnp.int32)
        state, same = sharding.state_sharding(self.mesh, self.shapes), sharding.replicated(self.mesh)
        shardings = {"in_shardings": (state, same, same), "out_shardings": (state, same)}
        updates = compilation.jit(self._updates, self.practice_env, self.recipe.config, **shardings)
        with jax.set_mesh(self.mesh):
            return updates.trace(self.shapes, count, count)

    def _init(self, key: jax.Array):
        return self.learner.init(key, self.practice_env, self.recipe.config)

    def _updates(self, state, count, total):
        """Run `count` updates of a training of `total` updates; both can change without recompilation."""
        return advance(self.learner.update, self.practice_env, self.recipe.config, state, count, total)


def _check_first(policy: Policy, env: Env, expected: Policy) -> None:
    """Raise unless a policy to start from has the network of the settings."""
    check_fits("to start from", policy, env)
    if jax.tree.map(np.shape, policy) != jax.tree.map(np.shape, expected):
        raise UserError(
            f"the policy to start from is {policy}, that of the settings {expected}; give the settings of its network, "
            "for example hidden_sizes"
        )


def _devices(config: Any) -> list[jax.Device]:
    """All devices of all hosts; on a single CPU, as many cores as can share worlds and their groups equally."""
    devices = jax.devices()
    if devices[0].platform != "cpu" or jax.process_count() > 1:
        return devices
    parts = config.worlds // getattr(config, "minibatches", getattr(config, "past_policies", 1))
    return devices[: max(n for n in range(1, len(devices) + 1) if parts % n == 0)]
