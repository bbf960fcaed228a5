"""What the README says runs."""

import re
from pathlib import Path

import jax
import numpy as np

README = (Path(__file__).parent.parent / "README.md").read_text()


def test_the_python_of_the_readme_runs_from_top_to_bottom():
    names = {}
    with jax.numpy_rank_promotion("allow"):  # as users have it
        for block in re.findall(r"```python\n(.*?)```", README, re.DOTALL):
            exec(compile(block, "README.md", "exec"), names)
    assert names["trajectory"].pos.shape == (1440, 4, 3)
    assert names["many"][1].pos.shape == (100, 1440, 4, 3)
    assert np.isfinite(names["d_mass"])
    assert np.isfinite(names["hovering"].pos).all()


def test_the_commands_of_the_readme_are_known_to_the_command_line():
    from jaxdrones.tasks.examples import FLIGHTS

    named = set(re.findall(r"jaxdrones fly ([a-z][a-z-]*)", README))
    assert named == set(FLIGHTS)
