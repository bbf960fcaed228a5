"""The page about environments names what there is."""

from pathlib import Path

import pytest

from jaxdrones.envs import ACTIONS, OBSERVATIONS, TASKS

PAGE = (Path(__file__).parent.parent / "docs" / "environments.md").read_text()


@pytest.mark.parametrize("name", [*TASKS, *ACTIONS, *OBSERVATIONS])
def test_everything_with_a_name_is_on_the_page(name):
    assert f"`{name}`" in PAGE
