import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.learning.normalize import RunningStatistics


def test_statistics_in_pieces_are_those_of_everything():
    x = np.random.default_rng(0).normal(3.0, 2.0, size=(90, 4))

    @jax.jit
    def in_pieces(x):
        running = RunningStatistics.empty(4)
        for piece in (x[:10], x[10:11], x[11:60], x[60:]):
            running = running.update(piece)
        return running

    running = in_pieces(x)
    np.testing.assert_allclose(running.mean, x.mean(0), rtol=1e-12)
    np.testing.assert_allclose(running.var, x.var(0), rtol=1e-12)
    assert running.count == 90


def test_what_was_seen_first_can_be_forgotten():
    running = RunningStatistics.empty(1).update(jnp.zeros((1000, 1))).update(jnp.ones((1000, 1)), window=0.0)
    np.testing.assert_allclose(running.mean, 1.0)


def test_normal_observations_have_zero_mean_and_unit_variance_and_outliers_are_cut():
    x = jnp.asarray(np.random.default_rng(0).normal(3.0, 2.0, size=(500, 4)))
    normalized = jax.jit(lambda y: RunningStatistics.of(x).normalize(y))
    normal = np.asarray(normalized(x))
    np.testing.assert_allclose(np.mean(normal, 0), 0, atol=1e-12)
    np.testing.assert_allclose(np.var(normal, 0), 1, rtol=1e-12)
    assert np.max(normalized(x + 1e6)) == 10


def test_an_entry_that_never_changes_stays_finite():
    constant = jnp.ones((8, 2))
    normalized = jax.jit(lambda x, y: RunningStatistics.of(x).normalize(y))
    assert not np.any(normalized(constant, constant))
    np.testing.assert_allclose(normalized(constant, constant + 1e-3), 0.1)  # as if it had a deviation of 0.01


def test_vectors_that_do_not_count_change_nothing():
    rng = np.random.default_rng(0)
    x, counts = jnp.asarray(rng.normal(3.0, 2.0, size=(20, 5, 4))), rng.random((20, 5)) < 0.4
    expected = RunningStatistics.empty(4).update(x[counts])
    update = jax.jit(RunningStatistics.update)
    masked = update(RunningStatistics.empty(4), jnp.where(counts[..., None], x, 1e6), where=counts)
    none = update(masked, x + 1e6, where=jnp.zeros((20, 5), bool))
    for one in masked, none:
        for name in ("mean", "var", "count"):
            np.testing.assert_allclose(getattr(one, name), getattr(expected, name), rtol=1e-12)
