# Everything runs in .venv, which any target sets up first.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: fly train rllib sb3 tables betaflight crazyflie test test-slow test-libraries test-rllib test-ros2 lint docs notebooks viewer

fly: .venv/installed  ## four Crazyflies on the circle of gym-pybullet-drones (2021)
	$(BIN)/jaxdrones fly circle --drones 4 --output runs/circle

train: .venv/installed  ## train a policy for hover, and fly it
	@# An earlier run is kept: it moves to runs/hover-DATE-TIME.
	if [ -e runs/hover ]; then mv runs/hover runs/hover-$$(date +%Y%m%d-%H%M%S); fi
	$(BIN)/jaxdrones train hover --output runs/hover
	$(BIN)/jaxdrones fly --policy runs/hover

rllib: .venv-rllib/installed  ## leader and follower of gym-pybullet-drones (2021) by RLlib, three seeds, and a flight of the best
	.venv-rllib/bin/python examples/rllib_leader_follower.py --output runs/leader-follower-rllib
	.venv-rllib/bin/jaxdrones fly --policy runs/leader-follower-rllib

sb3: .venv-libraries/installed  ## one-dimensional hover of gym-pybullet-drones (2021) by Stable-Baselines3, and a flight of the policy
	.venv-libraries/bin/python examples/sb3_hover.py --output runs/hover-2021-sb3
	.venv-libraries/bin/jaxdrones fly --policy runs/hover-2021-sb3

betaflight: .venv/installed  ## build Betaflight (GPL-3.0) in the user's cache, unless it exists, and fly with it; needs gcc and make
	$(BIN)/jaxdrones betaflight --build --if-missing
	$(BIN)/pytest tests/firmware -k betaflight

crazyflie: .venv/installed .venv-crazyflie/installed  ## install cflib (GPL-2.0) in a separate environment, and fly the simulated Crazyflie with it
	$(BIN)/pytest tests/firmware -k "cflib or crazyflie"

tables: .venv/installed  ## measure the tables of the pages again; on idle cores
	$(BIN)/python -m benchmarks.tables

test: .venv/installed
	$(BIN)/pytest -n 2 --dist worksteal -m "not slow"

test-slow: .venv/installed  ## all of them, or a part: make test-slow ONLY="--shard 2/6 --since '3 hours ago'"
	XLA_FLAGS= $(BIN)/pytest -n 2 --dist load -m slow $(ONLY)

test-libraries: .venv-libraries/installed  ## TorchRL, skrl, tianshou, Stable-Baselines3, gymnax, JaxMARL, W&B and MLflow, in a separate environment
	.venv-libraries/bin/pytest tests/learning/test_loggers.py tests/test_examples.py $(patsubst %,tests/adapters/test_%.py,other_libraries gymnasium gymnax jaxmarl sb3)

test-rllib: .venv-rllib/installed
	.venv-rllib/bin/pytest tests/adapters/test_rllib.py tests/test_examples.py -k rllib

test-ros2: .venv-ros2/installed  ## ROS 2 tests with rclpy, in a separate environment
	.venv-ros2/bin/pytest tests/ros2/test_rclpy.py tests/ros2/test_crazyswarm.py tests/ros2/test_serialization.py

lint: .venv/installed
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

docs: .venv/installed  ## the site, into build/site; no network; a warning or a broken link is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

notebooks: .venv/installed  ## notebooks/*.ipynb with outputs, from notebooks/*.py; needs Chromium for pictures of the viewer
	$(BIN)/python notebooks/build.py

viewer:  ## the page of the viewer, from its sources; needs Node.js
	cd viewer && npm ci --no-audit --no-fund && npm run build

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet -c constraints.txt -e ".[dev]"
	touch $@

# gymnax and JaxMARL want an older gymnasium and a jax below 0.12; the newest that fit are taken.
.venv-libraries/installed: pyproject.toml
	$(PYTHON) -m venv .venv-libraries
	.venv-libraries/bin/pip install --quiet torch==2.13.0
	.venv-libraries/bin/pip install --quiet -e ".[cli,pettingzoo,video]" torchrl==0.14.1 skrl==2.1.1 tianshou==2.0.1 stable-baselines3==2.9.2 \
		gymnax==1.0.1 jaxmarl==0.2.0 wandb==0.31.0 mlflow-skinny==3.17.2 six beartype pytest
	touch $@

# RLlib pins an older gymnasium.
.venv-rllib/installed: pyproject.toml constraints-rllib.txt
	$(PYTHON) -m venv .venv-rllib
	.venv-rllib/bin/pip install --quiet -c constraints-rllib.txt -e ".[cli]" torch "ray[rllib]" beartype pytest
	touch $@

# rclpy as wheels, for CPython 3.11; elsewhere it comes with an installed ROS 2.
.venv-ros2/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv-ros2
	.venv-ros2/bin/pip install --quiet -c constraints.txt -e ".[bullet,cli,ros2]" beartype pytest scipy
	.venv-ros2/bin/pip install --quiet $(addprefix ros-,rclpy==9.1.2 rmw-fastrtps-cpp==9.3.3 std-msgs sensor-msgs geometry-msgs nav-msgs std-srvs rosgraph-msgs)
	touch $@

# cflib pins an older packaging.
.venv-crazyflie/installed:
	$(PYTHON) -m venv .venv-crazyflie
	.venv-crazyflie/bin/pip install --quiet cflib==0.1.34
	touch $@
