# Everything runs in .venv, which any target sets up first.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: fly train test test-slow lint

fly: .venv/installed  ## four Crazyflies on the paper's circle
	$(BIN)/jaxdrones fly circle --drones 4 --output runs/circle

train: .venv/installed  ## full four-motor hover, by the gradient of the simulation; then one flight of it
	@# An earlier run is kept: it moves to runs/hover-DATE-TIME.
	if [ -e runs/hover ]; then mv runs/hover runs/hover-$$(date +%Y%m%d-%H%M%S); fi
	$(BIN)/jaxdrones train hover --output runs/hover
	$(BIN)/jaxdrones fly --policy runs/hover

test: .venv/installed
	$(BIN)/pytest -n 2 -m "not slow"

test-slow: .venv/installed
	$(BIN)/pytest -n 2 -m slow

lint: .venv/installed
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet -c constraints.txt -e ".[dev]"
	touch $@
