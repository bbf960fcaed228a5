"""TorchRL's PPO on many worlds in one compiled step: hover from starts near the goal.

`DroneEnv` is a TorchRL environment with a batch of worlds. Tensors and JAX arrays share their memory (DLPack), and the
last observation of an episode is returned before the reset, for bootstrapping of truncated episodes.

    pip install jaxdrones torch torchrl
    python examples/torchrl_ppo.py
"""

import argparse

import jax
import jax.numpy as jnp
import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, ObservationNorm, RewardSum, TransformedEnv
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import jaxdrones as jd


class DroneEnv(EnvBase):
    """Many worlds of a task with one drone."""

    def __init__(self, env: jd.envs.Env, num_envs: int, seed: int = 0):
        super().__init__(batch_size=[num_envs])
        self.env, n = env, num_envs
        bound = torch.tensor(env.observation_bound.tolist()).expand(n, -1)
        self.observation_spec = Composite(observation=Bounded(-bound, bound), shape=[n])
        self.action_spec = Bounded(-1, 1, shape=(n, env.action_size))
        self.reward_spec = Unbounded(shape=(n, 1))
        flag = Binary(1, shape=(n, 1), dtype=torch.bool)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=[n])
        self._compiled_reset = jax.jit(self._renewed, donate_argnums=1)
        self._compiled_step = jax.jit(self._stepped, donate_argnums=1)
        self._key, self._worlds = jax.random.key(seed), None
        self._obs, self._worlds = jax.jit(jax.vmap(env.reset))(jax.random.split(self._next_key(), n))

    def _set_seed(self, seed: int | None) -> None:
        self._key = jax.random.key(seed or 0)

    def _next_key(self) -> jax.Array:
        self._key, key = jax.random.split(self._key)
        return key

    def _renewed(self, key, worlds, obs, chosen):
        fresh_obs, fresh = jax.vmap(self.env.reset)(jax.random.split(key, len(chosen)))

        def select(new, old):
            return jnp.where(chosen.reshape(-1, *[1] * (new.ndim - 1)), new, old)

        return select(fresh_obs, obs), jax.tree.map(select, fresh, worlds)

    def _stepped(self, key, worlds, action):
        keys = jax.random.split(key, len(action))
        obs, worlds, reward, terminated, truncated, _ = jax.vmap(self.env.step)(keys, worlds, action[:, None])
        return obs, worlds, reward, terminated[:, None], truncated[:, None]

    def _reset(self, tensordict: TensorDict | None) -> TensorDict:
        everything = torch.ones(*self.batch_size, 1, dtype=torch.bool)
        chosen = everything if tensordict is None else tensordict.get("_reset", everything)
        chosen = jnp.from_dlpack(chosen[:, 0].contiguous())
        self._obs, self._worlds = self._compiled_reset(self._next_key(), self._worlds, self._obs, chosen)
        return TensorDict({"observation": torch.from_dlpack(self._obs[:, 0])}, self.batch_size)

    def _step(self, tensordict: TensorDict) -> TensorDict:
        action = jnp.from_dlpack(tensordict["action"].contiguous())
        self._obs, self._worlds, *rest = self._compiled_step(self._next_key(), self._worlds, action)
        reward, terminated, truncated = (torch.from_dlpack(x) for x in rest)
        ends = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
        return TensorDict(
            {"observation": torch.from_dlpack(self._obs[:, 0]), "reward": reward, **ends}, self.batch_size
        )


def network(inputs: int, outputs: int) -> nn.Sequential:
    """An MLP."""
    return nn.Sequential(nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs))


def train(steps: int = 2_000_000, num_envs: int = 128, horizon: int = 64, seed: int = 1) -> list[float]:
    """Train; return the mean return of the finished episodes of each tenth of the training."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    task = jd.make("hover", action="thrust_and_rates", reach=0.5, speed=0.3, omega=0.3, tilt=15.0)
    norm = ObservationNorm(in_keys=["observation"], standard_normal=True)
    env = TransformedEnv(DroneEnv(task, num_envs, seed), norm)
    norm.init_stats(num_iter=50, reduce_dim=(0, 1), cat_dim=1)
    env.append_transform(RewardSum())

    d, a = task.observation_size, task.action_size
    body = nn.Sequential(network(d, 2 * a), NormalParamExtractor(scale_mapping="biased_softplus_0.4"))
    policy = ProbabilisticActor(
        TensorDictModule(body, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    value = ValueOperator(network(d, 1), in_keys=["observation"])
    advantage = GAE(gamma=0.99, lmbda=0.97, value_network=value, average_gae=True)
    loss = ClipPPOLoss(policy, value, clip_epsilon=0.2, entropy_coeff=1e-4, critic_coeff=0.5)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)

    returns, frames = [], num_envs * horizon
    for data in Collector(env, policy, frames_per_batch=frames, total_frames=steps // frames * frames):
        ended = data["next", "done"]
        returns.append(data["next", "episode_reward"][ended])
        data["next", "reward"] = 0.1 * data["next", "reward"]
        for _ in range(4):
            with torch.no_grad():
                advantage(data)
            flat = data.reshape(-1)
            for chosen in torch.randperm(frames).chunk(8):
                terms = loss(flat[chosen])
                total = terms["loss_objective"] + terms["loss_critic"] + terms["loss_entropy"]
                optimizer.zero_grad()
                total.backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimizer.step()
    return [part.mean().item() for part in torch.cat(returns).chunk(10)]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--steps", type=int, default=2_000_000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    print("mean return in each tenth:", [round(x, 1) for x in train(arguments.steps, seed=arguments.seed)])
