"""Environments are shared by tests, and with them what was compiled for them."""

import functools

import pytest

from jaxdrones.envs import make


@pytest.fixture(scope="session")
def env_of():
    """`make`, once for the same arguments; to be called in a test, whose precision it takes."""
    return functools.cache(make)
