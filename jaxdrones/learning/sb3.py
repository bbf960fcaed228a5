"""The paper's single-agent workflow: Stable-Baselines3's learners on our tasks. Needs the extra `sb3`.

A run's folder has the models as .zip, which `stable_baselines3` loads, where our own learners leave .msgpack.
"""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import io
import math
import time
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones.adapters.sb3 import VecEnv  # says which extra to install, so it comes before what follows
from jaxdrones.checks import check_choice, check_whole
from jaxdrones.envs import TASKS, Env
from jaxdrones.learning import checkpoint, runs
from jaxdrones.learning.evaluation import Report, evaluate
from jaxdrones.learning.runs import Progress, as_dict, checked, divided, fitting_preset
from jaxdrones.learning.training import Diverged, Tell

# isort: split
import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

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

_EVALUATIONS = 20  # in the course of training
_PROBE = 6  # times the size of the model that must fit on the disk: two checkpoints, each with Adam's moments
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
        """What `as_dict` gave."""
        check_choice("algorithm", kept["algorithm"], ALGORITHMS)
        return cls(**kept)

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

    def recipe(self) -> Recipe:
        """What was trained here."""
        return Recipe.from_dict(self.about()["recipe"])

    def policy(self, name: str = "best", env: Env | None = None) -> Actor:
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
            ValueError: it is damaged.
        """
        file = self.folder / f"{name}.zip"
        algorithm = ALGORITHMS[Recipe.from_dict(self.about(name)["recipe"]).algorithm]
        try:
            return algorithm.load(file, device="cpu")
        except FileNotFoundError:
            raise FileNotFoundError(f"no checkpoint at {self.folder / name}: {file} does not exist") from None
        except Exception as error:  # zip, pickle and torch have several of their own
            raise ValueError(f"{file} is damaged: {error}; take another checkpoint") from error

    def save_model(self, name: str, model: BaseAlgorithm, **about) -> None:
        """Write `best` or `last`."""
        content = io.BytesIO()
        model.save(content)
        versions = {"stable_baselines3": stable_baselines3.__version__, "torch": torch.__version__}
        checkpoint.save_bytes(self.folder / f"{name}.zip", content.getvalue(), **about, versions=versions)


class Trainer:
    """A recipe's worlds, compiled, and SB3's model of them."""

    def __init__(self, recipe: Recipe, seed: int = 0, episodes: int = 100):
        """Prepare and compile.

        Args:
            recipe: what to train.
            seed: of all that is random.
            episodes: of an evaluation.

        Raises:
            ValueError: settings that SB3 refuses.
        """
        self.recipe, self.seed, self.episodes = recipe, seed, episodes
        start = time.perf_counter()
        self.env = recipe.env()
        self.worlds = VecEnv(self.env, recipe.config["worlds"])
        self.model = recipe.model(self.worlds, seed)
        self.worlds.reset()
        self.worlds.step(np.zeros((self.worlds.num_envs, *self.worlds.action_space.shape), np.float32))
        self.worlds.seed(seed)
        self.compile_seconds = time.perf_counter() - start

    def prepare(self, run: Run) -> None:
        """See that a run can be written.

        Raises:
            OSError: it cannot.
        """
        run.prepare(_PROBE * sum(x.nbytes for x in self.model.policy.parameters()))

    def train(self, run: Run, tell: Tell, deadline: float | None = None) -> None:
        """Train to the end, and evaluate the best model.

        Args:
            run: a folder that was prepared.
            tell: progress, by control steps.
            deadline: when to stop, s of `time.perf_counter`; else after the `steps` of the recipe.

        Raises:
            Diverged: numbers that are not finite; the best model so far is kept.
            KeyboardInterrupt: as it came; the newest model is saved.
        """
        steps = self.recipe.config["steps"] if deadline is None else np.iinfo(np.int64).max
        with _one_thread(), Progress(run, _COLUMNS, 0) as progress:
            course = _Course(self, run, tell, progress, deadline)
            try:
                self.model.learn(steps, callback=course)
            except KeyboardInterrupt:
                course.save()
                raise
            except ValueError as error:  # torch's of a distribution, or the environment's of an action
                raise Diverged(f"numbers that are not finite at update {course.update}, or shortly before") from error
            course.finish()


@contextlib.contextmanager
def _one_thread():
    """Of torch: with batches this small, more of them wait for each other and for JAX's."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


_COLUMNS = ["update", "steps", "seconds", "reward", "success", "evaluated_return", "evaluated_error"]


class _Course(BaseCallback):
    """One training: where it is, and what it has come to."""

    def __init__(self, trainer: Trainer, run: Run, tell: Tell, progress: Progress, deadline: float | None):
        super().__init__()
        self.trainer, self.run, self.tell, self.progress, self.deadline = trainer, run, tell, progress, deadline
        self.about = {"recipe": trainer.recipe.as_dict(), "seed": trainer.seed, "episodes": trainer.episodes}
        self.choice, self.report = jax.random.split(jax.random.key(trainer.seed))
        self.best = None  # score
        self.update = 0
        self.due = 0.0  # share of the budget, of the next evaluation
        self.evaluating = 0.0  # s
        self.reward, self.counted = 0.0, 0  # sum since the last evaluation, and of how many steps
        self.begun = time.perf_counter()

    def _on_rollout_start(self) -> None:
        """The model is as the last update left it."""
        if self._share() >= self.due:
            self.judge()

    def _on_step(self) -> bool:
        self.reward += float(self.locals["rewards"].sum())
        self.counted += self.trainer.worlds.num_envs * self.trainer.env.drones
        return self.deadline is None or self.update == 0 or self._share() < 1

    def _on_rollout_end(self) -> None:
        self.update += 1
        self.tell(self.num_timesteps, self._now())

    def _on_training_end(self) -> None:
        self.judge()
        self.save()

    def judge(self) -> None:
        """Evaluate the model, always on the same episodes; keep it if its return is the best, as the paper does."""
        self.due = self._share() + 1 / _EVALUATIONS
        now = self._now()
        report = self._evaluate(Actor.of(self.model), self.choice)
        score = report.returned if math.isfinite(report.returned) else -math.inf
        if self.best is None or score > self.best:
            self.best = score
            self.run.save_model("best", self.model, **self.about, update=self.update, score=score)
        now |= {"success": report.success, "evaluated_return": report.returned}
        now |= {"evaluated_error": report.error_percentiles[50]}
        steps = self.num_timesteps * self.trainer.env.drones
        self.progress.add([{"update": self.update, "steps": steps} | {k: now[k] for k in _COLUMNS if k in now}])
        self.reward, self.counted = 0.0, 0
        self.tell(self.num_timesteps, now)

    def save(self) -> None:
        """Write the newest model."""
        self.run.save_model("last", self.model, **self.about, update=self.update)

    def finish(self) -> None:
        """Evaluate the best model on other episodes than it was chosen by, and write the report."""
        seconds = {"training": self._seconds(), "compiling": self.trainer.compile_seconds}
        report = self._evaluate(self.run.policy(), self.report)
        self.run.save_report(
            self.about
            | {"best_update": self.run.about()["update"], "updates": self.update, "steps": self.num_timesteps}
            | {"seconds": seconds | {"evaluating": self.evaluating}, "evaluation": as_dict(report)}
        )

    def _share(self) -> float:
        """Of the budget that is spent."""
        if self.deadline is not None:
            return (time.perf_counter() - self.begun) / max(self.deadline - self.begun, 1e-9)
        return self.num_timesteps / self.trainer.recipe.config["steps"]

    def _seconds(self) -> float:
        """Of training alone."""
        return time.perf_counter() - self.begun - self.evaluating

    def _now(self) -> dict[str, float]:
        seconds = self._seconds()
        steps = self.num_timesteps * self.trainer.env.drones
        reward = self.reward / self.counted if self.counted else math.nan
        return {"seconds": seconds, "steps_per_s": steps / seconds, "reward": reward}

    def _evaluate(self, actor: Actor, key: jax.Array) -> Report:
        start = time.perf_counter()
        report = evaluate(self.trainer.env, actor, key, self.trainer.episodes)
        self.evaluating += time.perf_counter() - start
        return report
