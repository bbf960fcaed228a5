"""Trainings by Stable-Baselines3: recipes, models as policies, and their folders. Needs the extra `sb3`.

The folder of such a run holds models as .zip files, which Stable-Baselines3 itself loads too. Here only their weights
are read, so that no code of the file is executed.
"""

from __future__ import annotations

import dataclasses
import inspect
import io
import zipfile
from collections.abc import Mapping
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.adapters.sb3 import VecEnv  # names the extra to install, so it comes before the libraries of the extra
from jaxdrones.checks import check_choice, check_whole
from jaxdrones.envs import Env
from jaxdrones.errors import UserError
from jaxdrones.learning import files
from jaxdrones.pytree import PyTreeNode
from jaxdrones.training import user_files
from jaxdrones.training.algorithms import SB3_ALGORITHMS
from jaxdrones.training.recipe import checked_preset, convert_setting, split_changes
from jaxdrones.training.run import Run

# isort: split
import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm

NETWORK = (512, 512, 256, 128)
"""The paper's hidden layers, with ReLU. In the paper, actor and critic of ppo and a2c share the first two layers, which
Stable-Baselines3 no longer offers."""

PRESET_TASK = "hover-2021"
"""The task that the settings below were found for."""
_PRESETS: dict[str, dict[str, Any]] = {
    "ppo": dict(steps=120_000, worlds=16, n_steps=128, batch_size=256, n_epochs=5, gamma=0.98),
    "a2c": dict(steps=120_000, worlds=8, n_steps=121, gamma=0.98, gae_lambda=0.95, normalize_advantage=True),
    "sac": dict(steps=14_000, worlds=4, batch_size=64, gamma=0.98, tau=0.02, ent_coef=0.01, learning_starts=1000),
}
"""Settings for that task, on which ppo reaches the best return, and a2c and sac may not. All other settings are the
defaults of Stable-Baselines3."""

_NO_SETTINGS = ("verbose", "_init_setup_model", "use_sde", "sde_sample_freq", "use_sde_at_warmup")
_NONE_BY_DEFAULT = ("clip_range_vf", "target_kl")  # numbers whose default is `None`


@dataclasses.dataclass(frozen=True)
class SB3Recipe:
    """The task, the learner of Stable-Baselines3 and the settings of a training."""

    task: str
    algorithm: str
    realistic: bool | str
    options: dict[str, Any]
    """Options of `jaxdrones.make`."""
    config: dict[str, Any]
    """`steps` (control steps of all worlds), `worlds`, `net_arch`, and arguments of the algorithm's class."""
    library: str = "sb3"
    files: user_files.Files = dataclasses.field(default_factory=dict)
    """Texts of the user's files that task and vehicle are in."""
    stop_at: float | None = None
    """Lower bound of the success rate at which to stop; `None` to make all steps."""

    @classmethod
    def of(cls, task: str, algorithm: str = "ppo", realistic: bool | str = False, **changes: Any) -> SB3Recipe:
        """A preset with changes.

        Args:
            task: a name of `jaxdrones.envs.TASKS`, or `file.py:function` of a function that returns a task.
            algorithm: ppo, a2c or sac.
            realistic: see `presets.preset`.
            **changes: `steps`, `worlds`, `net_arch`, arguments of the algorithm's class, and options of
                `jaxdrones.make`.

        Raises:
            ValueError: an unknown name, or a value of the wrong type.
        """
        task, files = user_files.take_task(task)
        function = user_files.task_of(task, files)
        check_choice("algorithm", algorithm, SB3_ALGORITHMS)
        defaults = _defaults(algorithm)
        options, settings = split_changes(function, changes, defaults)
        options, vehicle = user_files.take_vehicle(options)
        for name, x in settings.items():
            settings[name] = x if isinstance(defaults[name], str) else convert_setting(name, x, defaults[name])
        config = _PRESETS[algorithm] | {"net_arch": NETWORK} | settings
        recipe = cls(task, algorithm, realistic, options, config, files=files | vehicle)
        for name in ("steps", "worlds"):
            check_whole(name, recipe.config[name])
        recipe.env()
        return recipe

    @classmethod
    def from_dict(cls, entries: dict[str, Any]) -> SB3Recipe:
        """The recipe of which `as_dict` gave the entries.

        Raises:
            ValueError: they are damaged, or of another version of this library.
        """
        try:
            user_files.task_of(entries["task"], entries.get("files", {}))
            check_choice("algorithm", entries["algorithm"], SB3_ALGORITHMS)
            return cls(**entries)
        except (KeyError, TypeError) as error:
            raise UserError(f"the recipe is not one of this version ({error!r}); train anew") from error

    def as_dict(self) -> dict[str, Any]:
        """The recipe for JSON."""
        return dataclasses.asdict(self)

    @property
    def trained_by(self) -> str:
        """Name of the library and the algorithm for titles."""
        return f"{self.library} {self.algorithm}"

    def env(self, **options: Any) -> Env:
        """The environment; options of `jaxdrones.make` replace those of the recipe."""
        task = user_files.task_of(self.task, self.files)
        return checked_preset(task, "ppo", self.realistic, user_files.options_of(self.options | options, self.files))[0]

    def model(self, envs: VecEnv, seed: int) -> BaseAlgorithm:
        """The untrained model.

        Args:
            envs: many worlds of `env`.
            seed: seed of the network, of exploration and of the first reset.

        Raises:
            ValueError: Stable-Baselines3 refuses the settings.
        """
        own = ("steps", "worlds", "net_arch")
        settings = {"device": "cpu"} | {name: x for name, x in self.config.items() if name not in own}
        network = {"net_arch": list(self.config["net_arch"]), "activation_fn": torch.nn.ReLU}
        try:
            return _class(self.algorithm)("MlpPolicy", envs, seed=seed, policy_kwargs=network, **settings)
        except (AssertionError, TypeError, ValueError, RuntimeError) as error:
            raise UserError(f"settings {settings} do not fit {self.trained_by}: {error}") from error


def _class(algorithm: str) -> type[BaseAlgorithm]:
    return getattr(stable_baselines3, SB3_ALGORITHMS[algorithm])


def _defaults(algorithm: str) -> dict[str, Any]:
    """Default values of all settings that are numbers or words."""
    arguments = {name: x.default for name, x in inspect.signature(_class(algorithm)).parameters.items()}
    plain = {
        name: x
        for name, x in arguments.items()
        if isinstance(x, int | float | str) and x is not inspect.Parameter.empty
    }
    optional = {name: None for name in _NONE_BY_DEFAULT if name in arguments}
    own = {"steps": 1, "worlds": 1, "net_arch": NETWORK}
    return {name: x for name, x in (plain | optional | own).items() if name not in _NO_SETTINGS}


class SB3Policy(PyTreeNode):
    """The actor of a trained model, without exploration, as a function of JAX."""

    layers: tuple[tuple[Float[Array, "out in"], Float[Array, " out"]], ...]
    """Weights and biases of the linear layers, with ReLU between them."""
    squashed: bool = flax.struct.field(pytree_node=False)
    """Whether outputs pass through tanh, as those of sac do; otherwise they are clipped to [-1, 1]."""

    @classmethod
    def of(cls, weights: Mapping[str, torch.Tensor], algorithm: str) -> SB3Policy:
        """The function that `model.predict(obs, deterministic=True)` computes.

        Args:
            weights: those of `model.policy.state_dict()`.
            algorithm: name of the algorithm that trained the model.

        Raises:
            UserError: they are not those of a network that `SB3Recipe.model` makes.
        """
        squashed = algorithm == "sac"
        hidden, last = ("actor.latent_pi.", "actor.mu") if squashed else ("mlp_extractor.policy_net.", "action_net")
        names = [name.removesuffix(".weight") for name in weights if name.startswith(hidden) and ".weight" in name]
        try:
            layers = [[weights[f"{name}.{part}"] for part in ("weight", "bias")] for name in (*names, last)]
        except KeyError as error:
            raise UserError(f"the model has no {error.args[0]}; its algorithm is not {algorithm}, train anew") from None
        return cls(tuple((_array(weight), _array(bias)) for weight, bias in layers), squashed)

    def __call__(self, obs: Float[Array, "n d"]) -> Float[Array, "n a"]:
        """Actions of the team, in [-1, 1]; for Stable-Baselines3 a team is one agent."""
        x = jnp.ravel(obs)
        for weight, bias in self.layers[:-1]:
            x = jax.nn.relu(weight @ x + bias)
        weight, bias = self.layers[-1]
        x = weight @ x + bias
        return (jnp.tanh(x) if self.squashed else jnp.clip(x, -1, 1)).reshape(len(obs), -1)


def _array(x: torch.Tensor) -> Array:
    return jnp.array(x.detach().cpu().numpy())


class SB3Run(Run):
    """The folder of a training by Stable-Baselines3, which cannot be resumed."""

    policy_suffix = "zip"

    def recipe(self, name: str = "best") -> Any:
        """The recipe of the training."""
        self.check_identity(name)
        return SB3Recipe.from_dict(self.sidecar_entry(name, "recipe"))

    def policy(self, name: str = "best", env: Env | None = None) -> Any:
        """The policy `best` or `last`; raises as `load` does, and if it does not fit `env`."""
        self.check_identity(name)
        policy = SB3Policy.of(self.weights(name), self.recipe(name).algorithm)
        if env is not None:
            sizes = (policy.layers[0][0].shape[1], policy.layers[-1][0].shape[0])
            expected = (env.drones * env.observation_size, env.drones * env.action_size)
            self.check_sizes(name, env, sizes, expected)
        return policy

    def weights(self, name: str = "best") -> Mapping[str, torch.Tensor]:
        """The weights of the model `best` or `last`.

        Stable-Baselines3's own `load` also unpickles what else is in the file, which can execute any code; this reads
        tensors alone.

        Raises:
            FileNotFoundError: there is no such model.
            UserError: it is damaged, or has numbers that are not finite.
        """
        file = self.folder / f"{name}.zip"
        content = files.load_bytes(file, self.sidecar(name))
        try:
            with zipfile.ZipFile(io.BytesIO(content)) as parts:
                weights = torch.load(io.BytesIO(parts.read("policy.pth")), map_location="cpu", weights_only=True)
            finite = all(torch.isfinite(x).all() for x in weights.values())
        except Exception as error:  # zip and torch raise errors of several types
            raise UserError(f"{file} cannot be loaded: {files.one_line(error)}; {files.ADVICE}") from error
        if not finite:
            raise UserError(f"{file} holds numbers that are not finite; {files.ADVICE}")
        return weights

    def save_model(self, name: str, model: BaseAlgorithm, **about: Any) -> None:
        """Write `best` or `last`, with entries of its description."""
        content = io.BytesIO()
        model.save(content)
        versions = {"stable_baselines3": stable_baselines3.__version__, "torch": torch.__version__}
        files.save_bytes(self.folder / f"{name}.zip", content.getvalue(), **about, versions=versions)
