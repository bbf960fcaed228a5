"""What a computer cannot hold is refused before it is computed."""

import pytest

from jaxdrones import arguments, limits


def test_more_memory_than_there_is_is_refused():
    held = limits.memory()
    assert held > 1e8
    limits.check_memory("a flight", held, "fly less")
    with pytest.raises(ValueError, match=r"a flight needs about .* GB of memory, and there are .* GB; fly less"):
        limits.check_memory("a flight", held + 1, "fly less")
    with pytest.raises(ValueError, match="more than a million GB"):
        limits.check_memory("a flight", 10**400, "fly less")


def test_the_memory_of_a_container_counts(tmp_path, monkeypatch):
    file = tmp_path / "memory.max"
    monkeypatch.setattr(limits, "_CGROUPS", (str(file),))
    without = limits.memory()
    file.write_text("max\n")
    assert limits.memory() == without
    file.write_text("1000000\n")
    assert limits.memory() == 1_000_000


@pytest.mark.parametrize("seed", [0, 2**31 - 1])
def test_a_seed_that_jax_tells_from_others_passes(seed):
    arguments.seed("seed", seed)


@pytest.mark.parametrize("seed", [-1, 2**31, 2**70, 0.5, "1", None])
def test_a_seed_that_jax_takes_for_another_is_refused(seed):
    with pytest.raises(ValueError, match="seed is"):
        arguments.seed("seed", seed)
