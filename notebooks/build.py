"""Makes the .ipynb of this folder from the .py, their source, and executes them: `make notebooks`.

`python notebooks/build.py 03 06` makes only those whose names begin so. Pictures of the viewer need Chromium.
"""

import base64
import html
import io
import re
import sys
import tempfile
import time
from pathlib import Path

import jupytext
import nbformat
from jupyter_client import AsyncKernelManager
from nbclient import NotebookClient
from PIL import Image

from jaxdrones.visualization.browser import find_browser, open_tab

FOLDER = Path(__file__).parent
LARGEST = 60_000  # bytes of a picture
PAGE = re.compile(r'<iframe srcdoc="([^"]*)"')
DRAWN = re.compile(r"\[?(?:<matplotlib|Text\()")  # what functions of axes return
SIZE = (880, 520)  # pixels of a picture of the viewer
MOMENT = 0.6  # of a flight, which the picture shows


def unexecuted(source: Path) -> nbformat.NotebookNode:
    """The notebook of a .py in cells, without outputs."""
    notebook = jupytext.read(source)
    language = {"name": "python", "pygments_lexer": "ipython3"}
    kernel = {"name": "python3", "language": "python", "display_name": "Python 3"}
    notebook.metadata = nbformat.from_dict({"kernelspec": kernel, "language_info": language})
    for i, cell in enumerate(notebook.cells):
        cell.id, cell.metadata = f"cell-{i}", nbformat.from_dict({})  # the same every time
    return notebook


def smaller(picture: bytes) -> bytes:
    """A PNG that is small enough, with as many colors as that allows.

    Raises:
        ValueError: it is too large with 16 colors.
    """
    with Image.open(io.BytesIO(picture)) as image:
        for colors in (None, 256, 128, 64, 32, 16):
            written, reduced = io.BytesIO(), image.convert("RGB")
            if colors is not None:
                reduced = reduced.quantize(colors, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
            reduced.save(written, "png", optimize=True)
            if len(written.getvalue()) <= LARGEST:
                return written.getvalue()
    raise ValueError(f"a picture has more than {LARGEST:,} bytes; make it smaller")


def photographed(page: str) -> bytes:
    """A picture, PNG, of a page of the viewer, as a reader sees it."""
    with open_tab() as tab, tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "page.html"
        file.write_text(page, encoding="utf-8")
        tab.open(file, *SIZE)
        tab.run("jaxdrones.player.playing = false")
        for k in range(20):  # which draws the trails
            tab.run(f"jaxdrones.frameAt({MOMENT * k / 19} * jaxdrones.player.end, 0.05)")
        return tab.screenshot()


def slim(notebook: nbformat.NotebookNode) -> None:
    """Make the outputs small: fewer colors, a picture for each page of the viewer, nothing of `axis.legend()`."""
    for cell in notebook.cells:
        if "outputs" in cell:
            cell.outputs = [x for x in cell.outputs if not DRAWN.match(x.get("data", {}).get("text/plain", ""))]
    outputs = (output for cell in notebook.cells for output in cell.get("outputs", ()))
    for data in (output.data for output in outputs if "data" in output):
        if page := PAGE.match(data.get("text/html", "")):
            del data["text/html"]
            data["image/png"] = base64.b64encode(photographed(html.unescape(page[1]))).decode()
        if "image/png" in data:
            data["image/png"] = base64.b64encode(smaller(base64.b64decode(data["image/png"]))).decode()


def build(source: Path) -> None:
    """Write the executed notebook of a .py in cells beside it."""
    notebook, began = unexecuted(source), time.perf_counter()
    kernel = AsyncKernelManager(kernel_name="python3", transport="ipc")
    NotebookClient(notebook, km=kernel, timeout=600, record_timing=False, coalesce_streams=True).execute()
    print(f"{source.stem}: executed in {time.perf_counter() - began:.0f} s", flush=True)
    slim(notebook)
    nbformat.write(notebook, source.with_suffix(".ipynb"))


if __name__ == "__main__":
    if find_browser() is None:
        sys.exit("there is no Chromium, of which pictures of the viewer are taken; install it")
    for source in sorted(FOLDER.glob("[0-9]*.py")):
        if len(sys.argv) == 1 or source.name.startswith(tuple(sys.argv[1:])):
            build(source)
