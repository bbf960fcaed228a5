"""Runs of W&B and MLflow, by the libraries themselves; `make test-libraries` installs both."""

import contextlib

import pytest

from jaxdrones.learning import loggers

REWARDS = {"seed-0": (1234.25, 2345.25), "seed-1": (3456.25, 4567.25)}
"""Run -> rewards of two updates."""


def log_two_seeds(library: str) -> None:
    """Two updates of each seed, which is then interrupted."""
    for name, (first, second) in REWARDS.items():
        with contextlib.suppress(KeyboardInterrupt), loggers.named_loggers(library, name) as (logger,):
            logger(1, {"reward": first, "return": float("nan")})
            logger(2, {"reward": second})
            raise KeyboardInterrupt


@pytest.mark.needs("wandb")
def test_each_seed_is_a_run_of_wandb(tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.chdir(tmp_path)
    log_two_seeds("wandb")
    import wandb

    wandb.teardown()  # ends the process that writes the files, which may still do so when a run has finished
    runs = [file.read_bytes() for file in tmp_path.glob("wandb/offline-run-*/*.wandb")]
    assert len(runs) == 2
    for name, rewards in REWARDS.items():
        (own,) = (run for run in runs if name.encode() in run)
        logged = {reward for both in REWARDS.values() for reward in both if str(reward).encode() in own}
        assert logged == set(rewards)


@pytest.mark.needs("mlflow")
def test_each_seed_is_a_finished_run_of_mlflow(tmp_path, monkeypatch):
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", (tmp_path / "runs").as_uri())
    log_two_seeds("mlflow")
    from mlflow import MlflowClient

    client = MlflowClient()
    runs = {run.info.run_name: run for run in client.search_runs(["0"])}
    assert {name: run.info.status for name, run in runs.items()} == dict.fromkeys(REWARDS, "FINISHED")
    for name, run in runs.items():
        history = client.get_metric_history(run.info.run_id, "reward")
        assert [(one.step, one.value) for one in history] == list(enumerate(REWARDS[name], 1))
