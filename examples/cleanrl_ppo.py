"""PPO in PyTorch, in the style of CleanRL: one file, on `gymnasium.make_vec`, that learns to hover from any start.

Observations, rewards and actions pass between JAX and PyTorch by DLPack, on the CPU without a copy.

    pip install jaxdrones torch
    python examples/cleanrl_ppo.py                    # 10 million steps, then 1,000 episodes of evaluation
    python examples/cleanrl_ppo.py --steps 500000 --seed 2
"""

import argparse
import time

import gymnasium
import jax
import jax.numpy as jnp
import torch
from torch import nn

import jaxdrones as jd
import jaxdrones.adapters.gymnasium  # registers jaxdrones/Hover-v0
from jaxdrones.learning import evaluate


def to_torch(x: jax.Array) -> torch.Tensor:
    """Convert to a tensor that shares memory."""
    return torch.from_dlpack(x)


def to_jax(x: torch.Tensor) -> jax.Array:
    """Convert to a JAX array that shares memory."""
    return jnp.from_dlpack(x.contiguous())


def network(inputs: int, outputs: int, output_scale: float) -> nn.Sequential:
    """An MLP with orthogonal weights."""

    def layer(m, n, scale):
        linear = nn.Linear(m, n)
        nn.init.orthogonal_(linear.weight, scale)
        nn.init.zeros_(linear.bias)
        return linear

    hidden = layer(inputs, 64, 2**0.5), nn.Tanh(), layer(64, 64, 2**0.5), nn.Tanh()
    return nn.Sequential(*hidden, layer(64, outputs, output_scale))


class Agent(nn.Module):
    """Gaussian policy and value function of normalized observations."""

    def __init__(self, observation_size: int, action_size: int, init_std: float):
        super().__init__()
        self.actor, self.critic = network(observation_size, action_size, 0.01), network(observation_size, 1, 1.0)
        self.log_std = nn.Parameter(torch.full((action_size,), init_std).log())
        self.register_buffer("mean", torch.zeros(observation_size))
        self.register_buffer("var", torch.ones(observation_size))
        self.register_buffer("count", torch.tensor(1e-4))

    @torch.no_grad()
    def update_statistics(self, obs: torch.Tensor) -> None:
        """Add observations to the running mean and variance."""
        n, total, delta = len(obs), self.count + len(obs), obs.mean(0) - self.mean
        self.var = (self.var * self.count + obs.var(0) * n + delta**2 * self.count * n / total) / total
        self.mean, self.count = self.mean + delta * n / total, total

    def normalized(self, obs: torch.Tensor) -> torch.Tensor:
        """Observations with a mean of zero and a standard deviation of one."""
        return (obs - self.mean) / (self.var + 1e-6).sqrt()

    def value(self, obs: torch.Tensor) -> torch.Tensor:
        """Value of observations (*batch, d)."""
        return self.critic(self.normalized(obs))[..., 0]

    def distribution(self, obs: torch.Tensor) -> torch.distributions.Normal:
        """Distribution of actions."""
        return torch.distributions.Normal(self.actor(self.normalized(obs)), self.log_std.exp())


def train(
    steps: int = 10_000_000,
    *,
    seed: int = 1,
    num_envs: int = 256,
    horizon: int = 96,
    epochs: int = 4,
    minibatches: int = 8,
    learning_rate: float = 2e-3,
    target_kl: float = 0.02,
    gamma: float = 0.99,
    gae_lambda: float = 0.98,
    clip_epsilon: float = 0.2,
    value_coef: float = 0.5,
    max_grad_norm: float = 0.5,
    init_std: float = 0.4,
    final_std: float = 0.02,
) -> tuple[Agent, list[float]]:
    """Train an agent; return it and the mean return of the finished episodes of each update."""
    torch.set_num_threads(1)  # more threads are slower with networks of this size
    torch.manual_seed(seed)
    envs = gymnasium.make_vec("jaxdrones/Hover-v0", num_envs=num_envs, numpy=False)
    (d,), (a,) = envs.single_observation_space.shape, envs.single_action_space.shape
    agent = Agent(d, a, init_std)
    optimizer = torch.optim.Adam(agent.parameters(), lr=learning_rate, eps=1e-5)

    obs = torch.zeros(horizon, num_envs, d)
    actions = torch.zeros(horizon, num_envs, a)
    log_probs, rewards, values, ended = (torch.zeros(horizon, num_envs) for _ in range(4))
    next_obs = to_torch(envs.reset(seed=seed)[0])
    updates = max(steps // (num_envs * horizon), 1)
    returns, start = [], time.perf_counter()
    for update in range(updates):
        episode_returns = []
        with torch.no_grad():
            for t in range(horizon):
                distribution = agent.distribution(next_obs)
                action = distribution.sample()
                obs[t], actions[t] = next_obs, action
                values[t], log_probs[t] = agent.value(next_obs), distribution.log_prob(action).sum(-1)
                step = envs.step(to_jax(action))
                next_obs, reward, terminated, truncated = (to_torch(x) for x in step[:4])
                done = terminated | truncated
                rewards[t], ended[t] = reward, done.float()
                if done.any():
                    last = step[4]
                    episode_returns.append(to_torch(last["final_info"]["episode"]["r"])[done])
                    # The last state of a truncated episode has a value.
                    cut = truncated & ~terminated
                    rewards[t, cut] += gamma * agent.value(to_torch(last["final_obs"])[cut])
            advantages = torch.zeros_like(rewards)
            next_value, advantage = agent.value(next_obs), torch.zeros(num_envs)
            for t in reversed(range(horizon)):
                not_ended = 1 - ended[t]
                delta = rewards[t] + gamma * not_ended * next_value - values[t]
                advantage = delta + gamma * gae_lambda * not_ended * advantage
                advantages[t], next_value = advantage, values[t]

        flat = [x.flatten(0, 1) for x in (obs, actions, log_probs, advantages, advantages + values)]
        for _ in range(epochs):
            for chosen in torch.randperm(num_envs * horizon).chunk(minibatches):
                o, u, old_log_prob, advantage, target = (x[chosen] for x in flat)
                distribution = agent.distribution(o)
                log_ratio = distribution.log_prob(u).sum(-1) - old_log_prob
                ratio = log_ratio.exp()
                advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
                surrogate = torch.min(ratio * advantage, ratio.clamp(1 - clip_epsilon, 1 + clip_epsilon) * advantage)
                value_loss = 0.5 * (agent.value(o) - target).square().mean()
                loss = -surrogate.mean() + value_coef * value_loss
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), max_grad_norm)
                optimizer.step()

        with torch.no_grad():
            # The learning rate adapts to the divergence of the new policy from the old one.
            log_ratio = agent.distribution(flat[0]).log_prob(flat[1]).sum(-1) - flat[2]
            kl = (log_ratio.exp() - 1 - log_ratio).mean().item()
            left = 1 - update / updates
            highest = 5e-3 * min(left / 0.3, 1)
            group = optimizer.param_groups[0]
            factor = 1 / 1.2 if kl > 2 * target_kl else 1.2 if kl < target_kl / 2 else 1
            group["lr"] = min(max(group["lr"] * factor, 1e-5), highest)
            # Exploration ends in the last updates: fluctuating rotors produce more thrust than steady ones.
            largest = final_std * (init_std / final_std) ** min(left / 0.3, 1)
            agent.log_std.clamp_(
                max=torch.tensor(largest).log().item(), min=torch.tensor(min(0.1, largest)).log().item()
            )
            if update < max(updates // 10, 1):
                agent.update_statistics(flat[0])
        if episode_returns:
            returns.append(torch.cat(episode_returns).mean().item())
        if update % 20 == 19 or update == updates - 1:
            speed = (update + 1) * num_envs * horizon / (time.perf_counter() - start)
            mean_return = f"{returns[-1]:.1f}" if returns else "of no episode yet"
            print(f"update {update + 1}/{updates}: return {mean_return}, kl {kl:.3f}, {speed:,.0f} steps/s", flush=True)
    envs.close()
    return agent, returns


def jax_policy(agent: Agent):
    """Mean action of an agent as a function of JAX arrays, for a compiled evaluation."""
    layers = [(to_jax(x.weight.detach()), to_jax(x.bias.detach())) for x in agent.actor if isinstance(x, nn.Linear)]
    mean, std = to_jax(agent.mean), to_jax((agent.var + 1e-6).sqrt())

    def policy(obs):
        x = (obs - mean[None]) / std[None]
        for i, (weight, bias) in enumerate(layers):
            x = x @ weight.T + bias[None]
            x = jnp.tanh(x) if i < len(layers) - 1 else x
        return x

    return policy


def main() -> None:
    """Train and evaluate."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--steps", type=int, default=10_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--episodes", type=int, default=1000, help="episodes of the evaluation")
    arguments = parser.parse_args()
    start = time.perf_counter()
    agent, _ = train(arguments.steps, seed=arguments.seed)
    seconds = time.perf_counter() - start
    report = evaluate(jd.make("hover"), jax_policy(agent), jax.random.key(arguments.seed), arguments.episodes)
    interval = "({:.1%} to {:.1%})".format(*report.success_interval) if report.success_interval else "(no interval)"
    print(f"{seconds:.0f} s; success {report.success:.1%} {interval} of {arguments.episodes} episodes")


if __name__ == "__main__":
    main()
