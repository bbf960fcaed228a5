"""MkDocs hooks: generated pages, the flight of the start page, links out of docs/, code beside formulas.

`<!-- code: dynamics/aero.py drag -->` on a page becomes the source of that function.
"""

import ast
import html as html_entities
import logging
import os
import re
from pathlib import Path

import api
import latex2mathml.converter
import tasks
from mkdocs.structure.files import File

from jaxdrones import assets
from jaxdrones.visualization.viewer.page import Page, read_exhibits

ROOT = Path(__file__).parent.parent
COPIED = {  # file of the repository -> page of the site
    "benchmarks/README.md": "benchmarks.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "README.md": "index.md",
}
FLIGHT = "forest.html"  # of the start page
_SOURCE = {page: source for source, page in COPIED.items() if page != "index.md"}

_log = logging.getLogger("mkdocs.website")
_made: dict[str, str] = {}
_FENCE = re.compile(r"(^```.*?^```$)", re.M | re.S)
_LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")
_CODE = re.compile(r"^<!-- code: (\S+) (\w+) -->$", re.M)
_ADDRESS = re.compile(r'<(?:script|img|link|iframe)\b[^>]*\b(?:src|href)="(https?://[^"]+)"')
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.S)


def on_config(config):
    """Generate pages, and add them to the navigation."""
    _made.update(tasks.pages(ROOT) | api.pages(ROOT))
    sections = {title: content for entry in config.nav for title, content in entry.items()}
    sections["Tasks"] += [path for path in _made if path.startswith("tasks/")]
    sections["API"] += [path for path in _made if path.startswith("api/")]
    return config


def on_files(files, config):
    """Add files from outside docs/."""
    for path, text in _made.items():
        files.append(File.generated(config, path, content=text))
    files.append(File.generated(config, FLIGHT, content=_flight()))
    for path, source in _SOURCE.items():
        files.append(File.generated(config, path, abs_src_path=str(ROOT / source)))
    for figure in sorted((ROOT / "benchmarks" / "figures").iterdir()):
        files.append(File.generated(config, f"figures/{figure.name}", abs_src_path=str(figure)))
    return files


def _flight():
    """Viewer page with the flight of the bundled forest policy in the demo."""
    (forest,) = (exhibit for exhibit in read_exhibits(assets.folder() / "demo") if exhibit.name == "forest")
    return Page("The bundled policy of the task forest", forest.payload).html


def on_page_markdown(markdown, page, config, files):
    """Insert the source of functions; resolve links to files of the repository."""
    source = _SOURCE.get(page.file.src_uri, f"docs/{page.file.src_uri}")

    def moved(match):
        image, text, target = match.groups()
        path, _, anchor = target.partition("#")
        if not path or re.match(r"\w+:", target):
            return match[0]
        found = os.path.normpath(os.path.join(os.path.dirname(source), path))
        if found.startswith("benchmarks/figures/"):
            here = found.removeprefix("benchmarks/")
        elif found in COPIED:
            here = COPIED[found]
        elif found.startswith("docs/"):
            here = found.removeprefix("docs/")
        elif (ROOT / found).exists():
            return text
        else:
            _log.warning("%s: there is no %s", source, target)
            return match[0]
        link = os.path.relpath(here, os.path.dirname(page.file.src_uri) or ".")
        return f"{image}[{text}]({link}{'#' * bool(anchor)}{anchor})"

    if page.file.src_uri == "environments.md":
        markdown = re.sub(r"^\| `([\w-]+)` \|", _task_link, markdown, flags=re.M)
    parts = (part if part.startswith("```") else _LINK.sub(moved, part) for part in _FENCE.split(markdown))
    return _CODE.sub(_source_of, "".join(parts))


def _task_link(match):
    """First cell of a row, with a link for a task."""
    path = f"tasks/{match[1]}.md"
    return f"| [`{match[1]}`](../docs/{path}) |" if path in _made else match[0]


def _source_of(match):
    """Source of a function of the package, as a block."""
    path, name = match.groups()
    text = (ROOT / "jaxdrones" / path).read_text()
    found = [node for node in ast.parse(text).body if isinstance(node, ast.FunctionDef) and node.name == name]
    if not found:
        _log.warning("jaxdrones/%s has no function %s", path, name)
        return ""
    return f'```python title="jaxdrones/{path}"\n{ast.get_source_segment(text, found[0])}\n```'


def on_page_content(html, page, config, files):
    """Convert formulas to MathML."""

    def drawn(match):
        display = "block" if match[1] == "div" else "inline"
        formula = latex2mathml.converter.convert(html_entities.unescape(match[2]), display=display)
        return f'<div class="formula">{formula}</div>' if match[1] == "div" else formula

    return _FORMULA.sub(drawn, html)


def on_post_page(output, page, config):
    """Raise for pages with external resources: the site works offline."""
    for address in _ADDRESS.findall(output):
        _log.warning("%s loads %s", page.file.src_uri, address)
    return output
