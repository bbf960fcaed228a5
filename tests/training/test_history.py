"""Policies of all evaluations of a training, and the page that shows them."""

import re
import shutil

import jax
import numpy as np
import pytest
from documents import ROOT
from helpers import SMALL_OPTIONS
from PIL import Image
from viewer_payload import decode

from jaxdrones.cli import main
from jaxdrones.training.episode import fly_history
from jaxdrones.training.run import Run
from jaxdrones.visualization import browser

SHORT = f"{' '.join(SMALL_OPTIONS)} --budget 4 --episodes 8 --no-figure"
pytestmark = pytest.mark.float32
EVALUATED = "(s, k) => { s.value = k; s.dispatchEvent(new Event('input')); }"


def train(folder, more=""):
    assert main(f"train hover --output {folder} {SHORT} {more}".split()) == 0
    return Run(folder)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Run with its history, and the same training without."""
    folder = tmp_path_factory.mktemp("runs")
    with jax.enable_x64(False):
        return train(folder / "kept", "--keep-history"), train(folder / "plain")


@pytest.mark.slow
def test_the_policy_of_every_evaluation_is_kept(runs):
    kept, _ = runs
    updates = [kept.sidecar_entry(name, "update") for name in kept.kept]
    assert updates == [int(row["update"]) for row in kept.history() if "evaluated_return" in row] and updates[0] == 0
    for row in kept.history():
        results = kept.sidecar_entry(f"history/{int(row['update']):08}", "evaluation")
        assert results["evaluated_return"] == pytest.approx(row["evaluated_return"])
    best = kept.policy(f"history/{kept.sidecar_entry('best', 'update'):08}")
    for one, other in zip(jax.tree.leaves(best), jax.tree.leaves(kept.policy("best")), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
def test_a_training_learns_the_same_without_its_history_and_writes_nothing_more(runs):
    kept, plain = runs
    assert plain.kept == [] and not (plain.folder / "history").exists()
    for one, other in zip(jax.tree.leaves(kept.policy("last")), jax.tree.leaves(plain.policy("last")), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
def test_a_continued_training_goes_on_keeping_and_a_replaced_one_begins_anew(runs, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(runs[0].folder, folder)
    assert main(f"train hover --output {folder} --resume --budget 2 --no-figure".split()) == 0
    updates = [Run(folder).sidecar_entry(name, "update") for name in Run(folder).kept]
    assert updates[0] == 0 and updates[-1] == 6
    assert train(folder, "--overwrite").kept == []


@pytest.mark.slow
def test_the_flights_of_a_history_begin_alike(runs):
    run, _ = runs
    with run.recipe().env() as env:
        evaluated = fly_history(run, env)
    assert [policy.update for policy in evaluated] == [run.sidecar_entry(name, "update") for name in run.kept]
    for policy in evaluated[1:]:
        np.testing.assert_array_equal(policy.flight.target[0], evaluated[0].flight.target[0])
        np.testing.assert_allclose(policy.flight.drones.pos[0], evaluated[0].flight.drones.pos[0], atol=0.02)  # a step


@pytest.mark.slow
def test_a_run_without_history_is_refused_in_one_line(runs, capsys):
    assert main(["view", str(runs[1].folder), "--history"]) == 2
    assert "train with --keep-history" in capsys.readouterr().err
    assert main(["view", str(runs[0].folder), "--history", "--video", "film.avi"]) == 2
    assert "film.avi" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.skipif(browser.find_browser() is None, reason="there is no Chromium")
def test_the_page_plays_every_policy_and_can_be_scrubbed_by_update(runs, tmp_path):
    run, _ = runs
    page = tmp_path / "history.html"
    assert main(["view", str(run.folder), "--history", "--output", str(page)]) == 0
    header = decode(re.search(r'id="payload" type="text/plain">(.*?)</script>', page.read_text(), re.S)[1])
    updates = [run.sidecar_entry(name, "update") for name in run.kept]
    assert [x for x, _ in header["history"]["points"]] == updates
    assert header["history"]["best"] == run.sidecar_entry("best", "update")
    with browser.open_tab() as tab:
        tab.open(page)
        assert tab.run("jaxdrones.player.playing")
        for k in (len(updates) - 1, 1):
            tab.run(f"({EVALUATED})(document.getElementById('update'), {k})")
            assert f"update {updates[k]}:" in tab.run("document.getElementById('title').textContent")
            shown = tab.run("jaxdrones.positionsAt(0.1)")[k]
            world = header["worlds"][k]
            row = int(np.abs(np.asarray(world["t"]) - 0.1).argmin())
            np.testing.assert_allclose(shown, world["pos"][row], atol=1e-4)
        tab.run("jaxdrones.player.seek(Infinity); jaxdrones.player.toggle()")
        tab.run("jaxdrones.player.time = jaxdrones.player.end - 0.01")
        tab.wait("jaxdrones.player.panel.world === 2")  # the next one, after the end
        assert tab.problems == []


@pytest.mark.slow
@pytest.mark.needs("imageio_ffmpeg")
@pytest.mark.skipif(browser.find_browser() is None, reason="there is no Chromium")
def test_a_film_of_a_training_shows_every_policy_in_full(runs, tmp_path):
    run, _ = runs
    film, page = tmp_path / "history.gif", tmp_path / "history.html"
    small = ["--size", "320x240", "--fps", "20", "--output", str(page)]
    assert main(["view", str(run.folder), "--history", "--video", str(film), *small]) == 0
    worlds = decode(re.search(r'id="payload" type="text/plain">(.*?)</script>', page.read_text(), re.S)[1])["worlds"]
    with Image.open(film) as frames:
        assert frames.n_frames == sum(max(1, round(20 * float(world["t"][-1]))) for world in worlds)


@pytest.mark.slow
@pytest.mark.needs("imageio_ffmpeg")
@pytest.mark.skipif(browser.find_browser() is None, reason="there is no Chromium")
def test_the_commands_of_the_page_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs" / "viewer.md").read_text().split("## Films of a training run")[1].split("\n## ")[0]
    for command in re.findall(r"^jaxdrones ([^#\n]*)", text, re.M):
        more = SHORT if command.startswith("train") else "--fps 1" if "--video" in command else ""
        assert main([*command.split(), *more.split()]) == 0
    assert {"history.html", "history.mp4"} <= {file.name for file in (tmp_path / "runs" / "film").iterdir()}
