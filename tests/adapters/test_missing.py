import importlib
import subprocess
import sys

import pytest

from jaxdrones.errors import install


@pytest.mark.parametrize(
    ("adapter", "library", "named"),
    [
        ("brax", "brax", "brax is not installed; " + install("brax")),
        ("pettingzoo", "pettingzoo", "pettingzoo is not installed; " + install("pettingzoo")),
        ("rllib", "ray", 'RLlib is not installed; pip install "ray[rllib]==2.60.0" torch'),
        ("sb3", "stable_baselines3", "stable-baselines3 is not installed; " + install("sb3")),
        ("tianshou", "tianshou", "tianshou is not installed; pip install tianshou torch"),
    ],
)
def test_a_library_that_is_not_installed_is_named_with_what_installs_it(adapter, library, named, monkeypatch):
    for name in list(sys.modules):
        if name.partition(".")[0] == library:
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(sys.modules, f"jaxdrones.adapters.{adapter}", raising=False)
    with pytest.raises(ImportError) as error:
        importlib.import_module(f"jaxdrones.adapters.{adapter}")
    assert str(error.value) == named


@pytest.mark.slow
def test_the_other_adapters_need_no_library():
    code = (
        "import sys; from jaxdrones.adapters import gymnasium, gymnax, jaxmarl; "
        "assert not sys.modules.keys() & set(sys.argv[1:])"
    )
    libraries = ("brax", "gymnax", "jaxmarl", "pettingzoo", "ray", "stable_baselines3", "tianshou", "torch")
    subprocess.run([sys.executable, "-c", code, *libraries], check=True)
