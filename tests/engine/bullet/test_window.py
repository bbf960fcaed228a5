"""Bullet's window, on a virtual display."""

import os
import shutil
import subprocess
import sys

import pytest

from jaxdrones.engine import bullet

pytestmark = pytest.mark.needs("pybullet")

SCRIPT = """
import time, numpy as np, jaxdrones
from jaxdrones.engine import bullet
params = jaxdrones.repeat(jaxdrones.load_params("cf2x"), 1)
state = jaxdrones.State.at_rest([[0, 0, 0.5]])
with bullet.make_step(dt=1 / 240, substeps=2, gui=True) as step:
    window = bullet.Window(step, params, 1 / 120)
    rpm = np.full((1, 4), float(params.hover_rpm[0]))
    start = time.monotonic()
    for _ in range(60):
        state = window(params, state, rpm)
    took = time.monotonic() - start
print(took, float(state.pos[0, 2]))
"""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("xvfb-run") is None, reason="needs a virtual display: apt install xvfb")
def test_the_window_runs_in_real_time():
    done = subprocess.run(
        ["xvfb-run", "-a", sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=300, check=True
    )
    took, height = map(float, done.stdout.split()[-2:])
    assert took >= 0.49  # 60 control steps of 1/120 s, never faster
    assert abs(height - 0.5) < 1e-3


@pytest.mark.skipif("DISPLAY" in os.environ, reason="there is a display")
def test_without_a_display_the_error_says_so():
    with pytest.raises(OSError, match=r"no window .* display"):
        bullet.make_step(gui=True)
