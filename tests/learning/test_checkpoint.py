import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdrones import envs
from jaxdrones.learning import bptt, checkpoint, files
from jaxdrones.learning.networks import Policy
from jaxdrones.state import State


@pytest.fixture(scope="module")
def env():
    return envs.make("hover-2021")


CONFIG = bptt.Config(updates=4, worlds=3, horizon=2, hidden_sizes=(4,))


@pytest.mark.slow
def test_a_policy_flies_on_as_it_was_saved(env, tmp_path):
    policy = Policy.init(jax.random.key(0), env, (8, 8))
    checkpoint.save(tmp_path / "new" / "policy", policy, env="hover-2021", config=CONFIG)
    loaded = checkpoint.load(tmp_path / "new" / "policy")
    obs = jax.random.normal(jax.random.key(1), (1, 12))
    np.testing.assert_array_equal(loaded(obs), policy(obs))
    assert jax.tree.structure(loaded) == jax.tree.structure(policy)
    kept = files.read_sidecar(tmp_path / "new" / "policy")
    assert kept["env"] == "hover-2021" and kept["config"]["horizon"] == 2 and "jax" in kept["versions"]


def test_a_sidecar_holds_numbers_of_any_library_as_numbers_and_refuses_what_it_would_change(tmp_path):
    about = {"options": {"reach": np.float32(0.5), "drones": np.int64(2), "place": jnp.array([1, 2])}, "of": tmp_path}
    checkpoint.save_tree(tmp_path / "tree", jnp.zeros(1), **about)
    kept = files.read_sidecar(tmp_path / "tree")
    assert kept["options"] == {"reach": 0.5, "drones": 2, "place": [1, 2]} and kept["of"] == str(tmp_path)
    with pytest.raises(ValueError, match=r"State\(.* cannot be saved beside a policy; give numbers, strings"):
        checkpoint.save_tree(tmp_path / "other", jnp.zeros(1), options={"start": State.at_rest(jnp.zeros((1, 3)))})
    assert not (tmp_path / "other.json").exists()


@pytest.mark.slow
@pytest.mark.float32
def test_training_goes_on_bit_for_bit(tmp_path):
    env = envs.make("hover-2021")
    step = jax.jit(lambda state: bptt.update(env, CONFIG, state)[0])
    state = step(bptt.init(jax.random.key(3), env, CONFIG))
    checkpoint.save_tree(tmp_path / "state", state)
    like = jax.eval_shape(lambda: bptt.init(jax.random.key(0), env, CONFIG))
    again = checkpoint.load_tree(tmp_path / "state", like)
    for a, b in zip(jax.tree.leaves(step(again)), jax.tree.leaves(step(state)), strict=True):
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(a, b)


def test_a_network_beside_a_built_in_one_is_refused(env, tmp_path):
    """It was ignored."""
    checkpoint.save(tmp_path / "policy", Policy.init(jax.random.key(0), env, (8,)))
    with pytest.raises(ValueError, match=r"holds a built-in network, not Dense; give load\(path\)"):
        checkpoint.load(tmp_path / "policy", network=nn.Dense(4))


@pytest.mark.slow
def test_errors_say_what_is_wrong(env, tmp_path):
    path = tmp_path / "policy"
    with pytest.raises(FileNotFoundError, match="no checkpoint at"):
        checkpoint.load(path)
    policy = Policy.init(jax.random.key(0), env, (8, 8))
    checkpoint.save(path, policy)
    with pytest.raises(ValueError, match=r"Dense_0.* is float..\[.*8\], expected float..\[.*4\]"):
        checkpoint.load_tree(path, Policy.init(jax.random.key(0), env, (4, 8)))
    (tmp_path / "policy.msgpack").write_bytes(b"nonsense")
    with pytest.raises(ValueError, match="damaged"):
        checkpoint.load(path)
    (tmp_path / "policy.msgpack").unlink()
    with pytest.raises(FileNotFoundError, match=r"policy\.msgpack does not exist"):
        checkpoint.load(path)
    (tmp_path / "policy.json").write_text("{}")
    with pytest.raises(ValueError, match="format None"):
        checkpoint.load(path)
