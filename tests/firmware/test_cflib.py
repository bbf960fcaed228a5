"""A simulated Crazyflie and the real cflib, in two processes; `make crazyflie` installs cflib."""

import json
import os
import subprocess
import threading
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxdrones.firmware.crazyflie import Crazyflie, Server, Vehicle
from jaxdrones.firmware.crazyflie.variables import VARIABLES

ROOT = Path(__file__).parents[2]
PYTHON = Path(os.environ.get("CFLIB_PYTHON", ROOT / ".venv-crazyflie" / "bin" / "python"))
CLIENT = Path(__file__).parent / "crazyflie_client.py"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.float32,
    pytest.mark.skipif(not PYTHON.is_file(), reason=f"cflib is not installed in {PYTHON}: run `make crazyflie`"),
]


class Flying:
    """Server in a thread, and what it flew."""

    def __init__(self):
        self.crazyflie, self.rows = Crazyflie(Vehicle()), []
        self.server = Server(self.crazyflie, 0)
        self.ends = threading.Event()
        self.thread = threading.Thread(target=self.run)

    def run(self):
        with jax.enable_x64(False):  # which is a setting of each thread
            while not self.ends.is_set():
                self.server.run(0.2, on_row=lambda t, now, target: self.rows.append((now.pos, now.rpy)))

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.ends.set()
        self.thread.join()
        self.server.__exit__()

    @property
    def pos(self):
        return np.array([row[0] for row in self.rows])

    @property
    def uri(self):
        return f"udp://127.0.0.1:{self.server.port}"

    def client(self, name):
        return ran([str(CLIENT), name, self.uri])


def ran(arguments, tmp=None, **environment):
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | environment
    done = subprocess.run(
        [PYTHON, *arguments], capture_output=True, text=True, timeout=60, env=environment, cwd=tmp, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr, done.stderr
    return json.loads(done.stdout.splitlines()[-1]) if "{" in done.stdout else done.stdout


@pytest.fixture
def flying():
    with Flying() as flying:
        yield flying


def test_tables_are_read_and_a_parameter_is_set(flying):
    found = flying.client("read_and_set")
    assert found["parameters"] == len(flying.crazyflie.parameters.toc.names)
    assert found["variables"] == len(VARIABLES)
    assert (found["before"], found["after"], found["default"]) == ("250.0", "240.5", [250.0])
    assert flying.crazyflie.vehicle.gains.rate_p[0] == 240.5
    assert {"Is armed", "Can fly"} <= set(found["states"]) and found["protocol"] == 12


def test_log_blocks_come_at_their_rates(flying):
    for rows, period in zip(flying.client("log")["rows"], (20, 100), strict=True):
        t, z, acc, voltage = np.array(rows).T
        np.testing.assert_array_equal(np.diff(t), period)  # of simulated time, without a gap
        assert abs(len(t) - 3000 / period) <= 0.3 * 3000 / period + 2
        assert np.median(acc) == pytest.approx(1, abs=2e-3)
        assert (voltage == 4000).all() and np.ptp(z) < 1e-3


def test_the_motion_commander_flies_a_square(flying):
    flying.client("square")
    pos = flying.pos
    corners = [(0, 0), (0.5, 0), (0.5, 0.5), (0, 0.5)]
    passed = [int(np.argmin(np.linalg.norm(pos[:, :2] - corner, axis=1))) for corner in corners[1:]]
    assert passed == sorted(passed)  # to the left: counter-clockwise
    for corner in corners:
        assert np.linalg.norm(pos[pos[:, 2] > 0.2, :2] - corner, axis=1).min() < 0.15
    inside = (np.abs(pos[:, :2] - 0.25) < 0.1).all(axis=1)
    assert not inside.any()  # along the sides
    assert np.linalg.norm(pos[-1, :2]) < 0.2 and pos[-1, 2] < 0.05
    assert 0.35 < np.median(pos[pos[:, 2] > 0.2, 2]) < 0.45


def test_the_high_level_commander_takes_off_goes_and_lands(flying):
    states = flying.client("high_level")
    pos = flying.pos
    for place in ([0, 0, 1.0], [0.5, -0.5, 1.2], [0.9, -0.5, 1.2]):
        assert np.linalg.norm(pos - place, axis=1).min() < 0.06
    assert {"Is flying", "HL control is active"} <= set(states["flying"])
    assert "Is flying" not in states["landed"]
    np.testing.assert_allclose(pos[-1], [0.9, -0.5, 0.01], atol=0.06)


def test_the_example_of_cflib_runs_unchanged(flying, tmp_path):
    """It goes forward by 0.8 m and back, up by 0.5 m, and at last up again, after a turn."""
    where = "import pathlib, cflib; print(pathlib.Path(cflib.__file__).parents[1] / 'examples' / 'autonomy')"
    folder = subprocess.run([PYTHON, "-c", where], capture_output=True, text=True, check=True).stdout.strip()
    example = Path(folder) / "motion_commander_demo.py"
    if not example.is_file():
        pytest.skip(f"this cflib has no example {example}")
    ran([str(example)], tmp_path, CFLIB_URI=flying.uri)
    time.sleep(1)  # it falls from the height at which the script stops the motors
    pos = flying.pos
    assert abs(pos[:, 0].max() - 0.8) < 0.1 and abs(pos[:, 2].max() - 0.8) < 0.1
    assert pos[-1, 2] < 0.05


def test_a_second_client_and_a_script_that_died_disturb_nobody(flying):
    first = subprocess.Popen(
        [PYTHON, str(CLIENT), "log", flying.uri], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    dies = subprocess.Popen(
        [PYTHON, str(CLIENT), "log", flying.uri], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        dies.wait(2.5)
    except subprocess.TimeoutExpired:
        dies.kill()
        dies.wait()
    out, err = first.communicate(timeout=60)
    assert first.returncode == 0, err
    assert [np.unique(np.diff([row[0] for row in rows])).tolist() for rows in json.loads(out)["rows"]] == [[20], [100]]
    assert flying.thread.is_alive()
