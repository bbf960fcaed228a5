"""Settings of a training by RLlib's PPO; this file needs no ray, so that what was trained can be flown without it."""

from __future__ import annotations

import dataclasses

from jaxdrones.checks import check_keywords
from jaxdrones.errors import UserError
from jaxdrones.learning.result import annealed
from jaxdrones.learning.settings import (
    BelowOne,
    Count,
    Fraction,
    HiddenSizes,
    NotNegative,
    Positive,
    PositiveFraction,
    PositiveOrInfinite,
    check_settings,
)


@check_keywords
@dataclasses.dataclass(frozen=True)
class Config:
    """Settings under the names that `jaxdrones.learning.ppo.Config` has; RLlib's own name is given where it differs."""

    updates: Count = 200
    worlds: Count = 128
    horizon: Count = 128
    """Control steps of a trajectory (`rollout_fragment_length`)."""
    epochs: Count = 5
    """Passes over each trajectory (`num_epochs`)."""
    minibatches: Count = 8
    """Minibatches of an epoch; `minibatch_size` follows from it."""
    hidden_sizes: HiddenSizes = (64, 64)
    """Hidden layers of each drone's policy and of its critic, with tanh; those of the paper are (256, 256)."""
    obs_stats_window: PositiveOrInfinite = 1e9
    """Number of trajectories whose observations the statistics remember."""
    obs_stats_freeze: Fraction = 0.2
    """Fraction of the updates after which the statistics that normalize observations no longer change."""
    learning_rate: Positive = 1e-3
    """Learning rate (`lr`) at the start; that of each drone then adapts to `target_kl`."""
    target_kl: Positive = 0.02
    """Kullback-Leibler divergence of the updated policy from the one that acted, in the last minibatch. After an update
    the learning rate falls if the divergence was above twice this value and rises if it was below half of it, between
    `min_learning_rate` and `max_learning_rate`."""
    min_learning_rate: Positive = 1e-5
    max_learning_rate: Positive = 6e-3
    anneal_fraction: PositiveFraction = 0.4
    """Fraction of the updates, the last ones, in which the upper bound of the learning rate falls to
    `min_learning_rate`, and that of the standard deviation of actions to `final_std`."""
    gamma: BelowOne = 0.99
    """Discount factor."""
    gae_lambda: Fraction = 1.0
    """Lambda of the generalized advantage estimation (`lambda_`)."""
    clip_epsilon: Positive = 0.2
    """Largest change of an action's probability ratio that the loss rewards (`clip_param`)."""
    entropy_coef: NotNegative = 0.0
    """Weight of the entropy (`entropy_coeff`)."""
    value_coef: NotNegative = 0.5
    """Weight of the error of the values, each times `1 - gamma` (`vf_loss_coeff`)."""
    init_std: Positive = 0.5
    """Standard deviation of actions at the start, and its upper bound before it is annealed."""
    min_std: Positive = 0.2
    """Lower bound of the standard deviation of actions until the upper bound is annealed below it."""
    final_std: Positive = 0.05
    """Upper bound of the standard deviation after the last update."""
    restart_fraction: Fraction = 0.05
    """Fraction of the worlds that start a new episode before an update; the others continue theirs."""
    max_grad_norm: Positive = 0.5
    """Largest norm of the gradient of a drone's policy and critic (`grad_clip`)."""

    def __post_init__(self):
        check_settings(self)
        if self.worlds * self.horizon < self.minibatches:
            raise UserError(f"minibatches is {self.minibatches}; give at most worlds * horizon")

    def std_bounds(self, updates: float) -> tuple[float, float]:
        """Bounds of the standard deviation of actions after so many updates."""
        high = float(annealed(self, updates, self.init_std, self.final_std))
        return min(float(self.min_std), high), high
