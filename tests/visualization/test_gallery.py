"""`jaxdrones demo` and its page."""

import json
import re

import numpy as np
import pytest
from documents import ROOT
from viewer_payload import decode

from jaxdrones import assets
from jaxdrones.cli import live, main
from jaxdrones.visualization import browser
from jaxdrones.visualization.viewer.page import Exhibit, gallery, read_exhibits

CHOSEN = "document.querySelector('[aria-current]')"
OWN = """
import jax.numpy as jnp

def straight(obs):
    return jnp.clip(obs[:, :3] / 0.1, -1, 1)

def sorting(obs):
    return jnp.sort(obs[:, :3], axis=1)

class _Remembering:
    def initial_hidden_state(self, batch):
        return jnp.zeros((*batch, 3))

    def act(self, hidden_state, obs):
        return hidden_state, obs[..., :3]

remembering = _Remembering()
"""
EXHIBITS = read_exhibits(assets.folder() / "demo")


@pytest.fixture
def page(tmp_path, capsys, monkeypatch):
    """The page, on a computer without a browser, which is no part of the JSON."""
    monkeypatch.setattr("webbrowser.open", lambda url: False)
    file = tmp_path / "demo.html"
    assert main(["demo", "recovery", "--json", "--output", str(file)]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["files"] == [str(file)] and "no browser was found" in printed.err
    return file


def test_every_bundled_policy_has_a_flight_that_can_be_shown():
    names = [exhibit.name for exhibit in EXHIBITS]
    assert set(assets.policies()) <= set(names)
    for exhibit in EXHIBITS:
        for world in decode(exhibit.payload)["worlds"]:
            assert len(world["pos"]) > 40 or exhibit.name in ("fly it yourself", "fly twenty")
        assert exhibit.command.startswith(("jaxdrones ", "python examples/word.py "))


def test_a_thousand_drones_and_a_real_flight_beside_its_simulation_are_shown():
    worlds = {exhibit.name: decode(exhibit.payload)["worlds"] for exhibit in EXHIBITS}
    (swarm,) = worlds["thousand drones"]
    assert swarm["pos"].shape[1] == 1000
    real, simulated = worlds["real flight"]
    assert (real["name"], simulated["name"]) == ("real", "simulated")
    apart = np.linalg.norm(real["pos"] - simulated["pos"], axis=-1)
    assert 0.01 < np.sqrt(np.mean(apart**2)) < 0.1  # m


def test_the_page_begins_with_the_flight_that_was_asked_for(page):
    data = json.loads(re.search(r'<script id="data" type="application/json">(.*)</script>', page.read_text())[1])
    names = [exhibit["name"] for exhibit in data["exhibits"]]
    shown = ["fly it yourself", "fly twenty", "gates", "race", "swap-goals", "thousand drones", "real flight"]
    assert names[:8] == ["recovery", *shown] and names[8:] == sorted(names[8:])
    assert len(data["exhibits"]) == len(EXHIBITS)


def test_an_unknown_flight_is_named(tmp_path, capsys):
    assert main(["demo", "forrest", "--no-open", "--output", str(tmp_path / "demo.html")]) == 2
    assert "unknown flight 'forrest'; did you mean 'forest'?" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["real flight", "--live"], "'real flight' has no bundled policy for --live"),
        (["forest", "--live", "--output", "page.html"], "leave out --policy and --output"),
        (["--drones", "20"], "without --policy"),
        (["--task", "hover"], "--task or --set is given without --policy file.py:name"),
        (["--policy", "runs/hover", "--set", "reach=1"], "--task or --set is given without --policy file.py:name"),
    ],
)
def test_options_that_contradict_each_other_are_named(arguments, message, capsys):
    assert main(["demo", *arguments]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.float32
def test_a_flight_of_the_gallery_is_flown_now(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(live, "WAIT", 0.1)
    assert main(["demo", "hover", "--live"]) == 0
    said = capsys.readouterr().out
    assert "open http://127.0.0.1:" in said and "success" in said
    assert list(tmp_path.rglob("log.npz")) != []


@pytest.mark.slow
@pytest.mark.float32
@pytest.mark.needs("casadi")
@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("straight", "wrote demo.html"),
        ("sorting", "'sort', which has no .*; `jaxdrones fly --policy own.py:sorting --task hover --set"),
        ("remembering", "the page cannot fly this policy: it has a memory"),
    ],
)
def test_a_policy_of_a_file_flies_in_the_page_or_the_reason_is_named(name, says, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text(OWN)
    made = main(["demo", "--policy", f"own.py:{name}", "--set", "action=position", "--no-open", "-o", "demo.html"])
    said = capsys.readouterr()
    assert re.search(says, said.out + said.err) and made == (0 if name == "straight" else 2)
    if made == 0:
        assert "jaxdrones fly --policy own.py:straight --task hover" in (tmp_path / "demo.html").read_text()


@pytest.mark.slow
@pytest.mark.float32
@pytest.mark.needs("casadi")
def test_the_commands_of_the_page_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    more = {"demo": "--no-open", "eval": "--episodes 4", "train": "--set worlds=8 --set horizon=4 --budget 2"}
    text = (ROOT / "docs" / "viewer.md").read_text().split("## The demo")[1].split("\n## ")[0]
    lines = re.findall(r"^jaxdrones .*", text, re.M)
    for command in (part.strip() for line in lines for part in line.partition("#")[0].split("&&")):
        arguments = command.removeprefix("jaxdrones ").removesuffix(" --live").split()
        assert main([*arguments, *more.get(arguments[0], "").split()]) == 0
    assert "runs/hover" in (tmp_path / "runs" / "demo.html").read_text()


@pytest.mark.slow
@pytest.mark.skipif(browser.find_browser() is None, reason="there is no Chromium")
@pytest.mark.parametrize("width", [390, 1400])
def test_every_flight_plays_without_a_message_and_fits(page, width):
    with browser.open_tab() as tab:
        tab.open(page, width, 800)
        frame = "document.querySelector('iframe')"
        for exhibit in EXHIBITS:
            tab.run(f"location.hash = {exhibit.name!r}")
            tab.wait(f"document.querySelector('[aria-current]').textContent === {exhibit.name!r}")
            left, right = tab.run(f"(({{ left, right }}) => [left, right])({CHOSEN}.getBoundingClientRect())")
            assert 0 <= left < right <= width  # in view, also in a list that scrolls
            tab.wait(f"{frame}.srcdoc.includes({exhibit.payload[:200]!r})")
        assert tab.run("document.documentElement.scrollWidth") <= width
        assert tab.problems == []


def test_no_text_of_a_flight_ends_the_script_of_the_page():
    assert "</script>a" not in gallery([Exhibit("</script>a", "", "", "")])
