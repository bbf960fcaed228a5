import importlib
import sys

import pytest


@pytest.mark.parametrize(
    ("adapter", "library"), [("brax", "brax"), ("pettingzoo", "pettingzoo"), ("sb3", "stable_baselines3")]
)
def test_a_library_that_is_not_installed_is_named_with_its_extra(adapter, library, monkeypatch):
    for name in list(sys.modules):
        if name.partition(".")[0] == library:
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(sys.modules, f"jaxdrones.adapters.{adapter}", raising=False)
    with pytest.raises(ImportError, match=rf'not installed; pip install "jaxdrones\[{adapter}\]"'):
        importlib.import_module(f"jaxdrones.adapters.{adapter}")
