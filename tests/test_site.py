"""The built site in a real browser, opened as files: `make docs` builds it."""

import io
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from documents import ROOT
from PIL import Image

from jaxdrones.visualization import browser

pytestmark = [
    pytest.mark.slow,
    pytest.mark.needs("material"),
    pytest.mark.skipif(browser.find_browser() is None, reason="there is no Chromium"),
]

PHONE = (390, 844)
READY = "document.querySelector('article') && document.readyState !== 'loading'"
WIDER = "document.documentElement.scrollWidth - document.documentElement.clientWidth"


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Folder of a new build."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"})
    return folder


@pytest.fixture
def tab():
    with browser.open_tab() as tab:
        yield tab
        tab.run("1")
        assert tab.problems == []


def pages(site: Path) -> list[Path]:
    return sorted(page for page in site.rglob("*.html") if page.name not in ("404.html", "forest.html"))


def test_no_page_is_wider_than_a_phone_and_none_asks_the_network_for_anything(site, tab):
    assert len(pages(site)) > 60
    wide = {}
    for page in pages(site):
        tab.open(page, *PHONE, ready=READY)
        if wider := tab.run(WIDER):
            wide[str(page.relative_to(site))] = wider
    assert wide == {}


def test_names_of_tasks_are_not_broken_on_a_phone(site, tab):
    names = "[...document.querySelectorAll('td:first-child code')].filter((name) => /^[\\w-]+$/.test(name.textContent))"
    for page in ("environments.html", "how-to-choose.html", "training.html"):
        tab.open(site / page, *PHONE, ready=READY)
        assert tab.run(f"{names}.length") > 5
        assert (
            tab.run(f"{names}.filter((name) => name.getClientRects().length > 1).map((name) => name.textContent)") == []
        )


def test_the_start_page_shows_a_flight_that_moves(site, tab):
    tab.open(site / "index.html", 1400, 900, ready=READY)
    tab.run("frame = document.querySelector('.flight').getBoundingClientRect(), null")
    box = tab.run("[frame.left, frame.top, frame.right, frame.bottom]")
    assert box[3] < 900  # without scrolling

    def flight():
        with Image.open(io.BytesIO(tab.screenshot())) as picture:
            return np.asarray(picture.convert("L").crop([round(x) for x in box]), float)

    end = time.monotonic() + 60
    while np.abs(flight() - flight()).max() < 60:  # the drone is elsewhere
        assert time.monotonic() < end


def test_the_search_of_a_page_that_is_opened_as_a_file_finds_words(site, tab):
    tab.open(site / "index.html", 1400, 900, ready=READY)
    tab.run("document.querySelector('.md-search__input').focus()")
    tab.call("Input.insertText", text="downwash")
    tab.wait("document.querySelectorAll('.md-search-result__item').length > 3", 30)
    assert "Physics" in tab.run("document.querySelector('.md-search-result__list').innerText")


def test_the_navigation_of_the_api_begins_with_what_most_programs_call(site):
    text = (site / "api" / "make.html").read_text()
    found = [text.index(f'href="{page}"') for page in ("State.html", "make_step.html", "accelerate.html")]
    assert found == sorted(found)
