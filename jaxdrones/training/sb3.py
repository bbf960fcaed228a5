"""The paper's single-agent workflow: Stable-Baselines3's learners on our tasks. Needs the extra `sb3`.

A run's folder has the models as .zip, which `stable_baselines3` loads, where our own learners leave .msgpack.
"""

from __future__ import annotations

import dataclasses
import inspect
import io
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.adapters.sb3 import VecEnv  # says which extra to install, so it comes before what follows
from jaxdrones.checks import check_choice, check_whole
from jaxdrones.envs import TASKS, Env
from jaxdrones.learning import checkpoint
from jaxdrones.training import runs
from jaxdrones.training.runs import checked, divided, fitting_preset

# isort: split
import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm

ALGORITHMS: dict[str, type[BaseAlgorithm]] = {
    "ppo": stable_baselines3.PPO,
    "a2c": stable_baselines3.A2C,
    "sac": stable_baselines3.SAC,
}

NETWORK = (512, 512, 256, 128)
"""The paper's hidden layers, ReLU. Its ppo and a2c shared the first two of actor and critic; SB3 has dropped that."""

_PRESETS: dict[str, dict[str, Any]] = {
    "ppo": dict(steps=120_000, worlds=16, n_steps=128, batch_size=256, n_epochs=5, gamma=0.98),
    "a2c": dict(steps=120_000, worlds=8, n_steps=121, gamma=0.98, gae_lambda=0.95, normalize_advantage=True),
    "sac": dict(steps=14_000, worlds=4, batch_size=64, gamma=0.98, tau=0.02, ent_coef=0.01, learning_starts=1000),
}
"""40 to 90 s of a core; ppo comes to the best return of equation 12, a2c and sac may not. The rest is SB3's."""

_HIDDEN = ("verbose", "_init_setup_model", "use_sde", "sde_sample_freq", "use_sde_at_warmup")
_OPTIONAL = ("clip_range_vf", "target_kl")  # numbers that SB3 leaves out


@dataclasses.dataclass(frozen=True)
class Recipe:
    """What is trained, on what, with which settings."""

    task: str
    algorithm: str
    realistic: bool
    options: dict[str, Any]
    """Of `jaxdrones.make`."""
    config: dict[str, Any]
    """`steps` (control steps of all worlds), `worlds`, `net_arch`, and arguments of SB3's algorithm."""
    library: str = "sb3"

    @classmethod
    def of(cls, task: str, algorithm: str = "ppo", realistic: bool = False, **changes) -> Recipe:
        """A preset with changes.

        Args:
            task: a name of `jaxdrones.envs.TASKS`.
            algorithm: ppo, a2c or sac.
            realistic: see `presets.preset`.
            **changes: arguments of SB3's algorithm, `steps`, `worlds`, `net_arch`, and options of `jaxdrones.make`.

        Raises:
            ValueError: an unknown name, or a value of the wrong kind.
        """
        check_choice("task", task, TASKS)
        check_choice("algorithm", algorithm, ALGORITHMS)
        defaults = _defaults(algorithm)
        options, settings = divided(task, changes, defaults)
        for name, x in settings.items():
            settings[name] = x if isinstance(defaults[name], str) else checked(name, x, defaults[name])
        recipe = cls(task, algorithm, realistic, options, _PRESETS[algorithm] | {"net_arch": NETWORK} | settings)
        for name in ("steps", "worlds"):
            check_whole(name, recipe.config[name])
        recipe.env()
        return recipe

    @classmethod
    def from_dict(cls, kept: dict[str, Any]) -> Recipe:
        """What `as_dict` gave.

        Raises:
            ValueError: it is of another version of this library, or damaged.
        """
        try:
            check_choice("task", kept["task"], TASKS)
            check_choice("algorithm", kept["algorithm"], ALGORITHMS)
            return cls(**kept)
        except (KeyError, TypeError) as error:
            raise ValueError(f"the recipe is not one of this version ({error!r}); train anew") from error

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return dataclasses.asdict(self)

    @property
    def learner(self) -> str:
        """The algorithm and its library."""
        return f"{self.library} {self.algorithm}"

    def env(self, **options) -> Env:
        """The environment; options of `jaxdrones.make` replace those of the recipe."""
        return fitting_preset(self.task, "ppo", self.realistic, self.options | options)[0]

    def model(self, envs: VecEnv, seed: int) -> BaseAlgorithm:
        """SB3's algorithm, untrained.

        Args:
            envs: many worlds of `env`.
            seed: of the network, of exploration and of the first reset.

        Raises:
            ValueError: settings that SB3 refuses.
        """
        own = ("steps", "worlds", "net_arch")
        settings = {"device": "cpu"} | {name: x for name, x in self.config.items() if name not in own}
        network = {"net_arch": list(self.config["net_arch"]), "activation_fn": torch.nn.ReLU}
        try:
            return ALGORITHMS[self.algorithm]("MlpPolicy", envs, seed=seed, policy_kwargs=network, **settings)
        except (AssertionError, TypeError, ValueError, RuntimeError) as error:
            raise ValueError(f"settings {settings} do not fit {self.learner}: {error}") from error


def _defaults(algorithm: str) -> dict[str, Any]:
    """Of all that can be set: numbers and words, no classes."""
    arguments = {name: x.default for name, x in inspect.signature(ALGORITHMS[algorithm]).parameters.items()}
    plain = {
        name: x
        for name, x in arguments.items()
        if isinstance(x, int | float | str) and x is not inspect.Parameter.empty
    }
    optional = {name: None for name in _OPTIONAL if name in arguments}
    own = {"steps": 1, "worlds": 1, "net_arch": NETWORK}
    return {name: x for name, x in (plain | optional | own).items() if name not in _HIDDEN}


class Actor(flax.struct.PyTreeNode):
    """What flies: a trained model without exploration, as a function of JAX."""

    layers: tuple[tuple[Float[Array, "out in"], Float[Array, " out"]], ...]
    """Weights and biases of the linear layers, ReLU between them."""
    squashed: bool = flax.struct.field(pytree_node=False)
    """Whether the last one goes through tanh, as sac's does, or is cut to [-1, 1]."""

    @classmethod
    def of(cls, model: BaseAlgorithm) -> Actor:
        """What `model.predict(obs, deterministic=True)` does."""
        policy, squashed = model.policy, isinstance(model, ALGORITHMS["sac"])
        modules = (
            (*policy.actor.latent_pi, policy.actor.mu)
            if squashed
            else (*policy.mlp_extractor.policy_net, policy.action_net)
        )
        linear = [module for module in modules if isinstance(module, torch.nn.Linear)]
        return cls(tuple((_array(layer.weight), _array(layer.bias)) for layer in linear), squashed)

    def __call__(self, obs: Float[Array, "n d"]) -> Float[Array, "n a"]:
        """The team's action, in [-1, 1]; SB3 sees a team as one agent."""
        x = jnp.ravel(obs)
        for weight, bias in self.layers[:-1]:
            x = jax.nn.relu(weight @ x + bias)
        weight, bias = self.layers[-1]
        x = weight @ x + bias
        return (jnp.tanh(x) if self.squashed else jnp.clip(x, -1, 1)).reshape(len(obs), -1)


def _array(x: torch.Tensor) -> Array:
    return jnp.array(x.detach().cpu().numpy())


class Run(runs.Run):
    """The folder of a training by Stable-Baselines3; nothing goes on from it."""

    policy_suffix = "zip"

    def recipe(self, name: str = "best") -> Any:
        """What was trained here."""
        return Recipe.from_dict(self.told(name, "recipe"))

    def policy(self, name: str = "best", env: Env | None = None) -> Any:
        """The policy `best` or `last`; raises as `load` does, and if it does not fit `env`."""
        actor = Actor.of(self.load(name))
        if env is not None:
            given = (actor.layers[0][0].shape[1], actor.layers[-1][0].shape[0])
            wanted = (env.drones * env.observation_size, env.drones * env.action_size)
            if given != wanted:
                raise runs.misfit(self.folder / name, env, given, wanted)
        return actor

    def load(self, name: str = "best") -> BaseAlgorithm:
        """SB3's model `best` or `last`.

        Raises:
            FileNotFoundError: there is none.
            ValueError: it is damaged, or has numbers that are not finite.
        """
        file = self.folder / f"{name}.zip"
        algorithm = ALGORITHMS[self.recipe(name).algorithm]
        content = checkpoint.load_bytes(file, self.about(name))
        try:
            model = algorithm.load(io.BytesIO(content), device="cpu")
        except Exception as error:  # zip, pickle and torch have several of their own
            raise ValueError(f"{file} cannot be loaded: {checkpoint.line(error)}; {checkpoint.ANOTHER}") from error
        if not all(torch.isfinite(x).all() for x in model.policy.parameters()):
            raise ValueError(f"{file} holds numbers that are not finite; {checkpoint.ANOTHER}")
        return model

    def save_model(self, name: str, model: BaseAlgorithm, **about) -> None:
        """Write `best` or `last`."""
        content = io.BytesIO()
        model.save(content)
        versions = {"stable_baselines3": stable_baselines3.__version__, "torch": torch.__version__}
        checkpoint.save_bytes(self.folder / f"{name}.zip", content.getvalue(), **about, versions=versions)
