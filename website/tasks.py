"""Task pages, from `jd.explain`, the table of results in docs/training.md, and the results of the leaderboard."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import records

import jaxdrones as jd
from jaxdrones import assets
from jaxdrones.envs import TASKS
from jaxdrones.envs.explanation import Entry, Part, number
from jaxdrones.training.presets import default_algorithm, settings_known
from jaxdrones.training.run import Run

_NUMBERS = "Entries are in their unit, unless the last columns have the values at -1, 0 and 1."
_ONE_DRONE = "The table has the entries of one drone."


def pages(root: Path) -> dict[str, str]:
    """Path -> Markdown."""
    results = (root / "docs" / "training.md").read_text()
    pictures = {path.stem: path.name for path in (root / "docs" / "images" / "tasks").iterdir()}
    return {
        f"tasks/{name}.md": _page(name, pictures.get(name), _measured(name, results), records.section(root, name))
        for name in TASKS
    }


def _page(name: str, picture: str | None, measured: str, record: str) -> str:
    with jd.make(name) as env:
        table = jd.explain(env)
    team = [(key, text) for key, text in table.task.items() if key not in ("name", "summary") and text]
    observation, action = (_count(x) for x in (table.observation, table.action))
    sections = [
        f"# {name}",
        table.task["summary"].capitalize() + ".",
        *([f"![{_shown(picture)}](../images/tasks/{picture})"] if picture else []),
        _table(["", ""], team),
        f"```sh\njaxdrones explain {name}\n{_training(name)}\n{_flight(name)}```",
        f"## Results\n\n{_bundled(name)}{measured}",
        *([f"## Records\n\n{record}"] if record else []),
        f"## Observation: {observation}\n\n{_ONE_DRONE} {_NUMBERS}\n\n{_entries(table.observation)}",
        *([f"## Images\n\n{_table(['image', ''], table.images.items())}"] if table.images else []),
        f"## Action: {action}\n\n{_ONE_DRONE}\n\n{_entries(table.action)}",
        "## Reward\n\nThe reward of a drone in a control step is the sum of weight times term.\n\n"
        f"{_parts(table.rewards)}",
        "## Terminations and truncations\n\nA termination ends an episode in a state without future reward; "
        "a truncation cuts it off."
        f"\n\n{_parts(table.terminations, 'termination')}\n\n{_parts(table.truncations, 'truncation')}",
        f"## Metrics\n\nMetrics are reported and have no reward.\n\n{_parts(table.metrics, 'metric')}",
        f"## Physics\n\n{_table(['', ''], table.physics.items())}",
    ]
    return "\n\n".join(sections) + "\n"


def _shown(picture: str) -> str:
    return "A flight of the bundled policy" if picture.endswith(".webp") else "The start of an episode"


def _training(name: str) -> str:
    algorithm = default_algorithm(name)
    known = settings_known(name, algorithm)
    return f"jaxdrones train {name}{'' if known else '   # there are no tuned settings'}"


def _flight(name: str) -> str:
    return f"jaxdrones fly --policy {name} --live   # the bundled policy\n" if name in assets.policies() else ""


def _bundled(name: str) -> str:
    """Results of the bundled policy from its report."""
    if name not in assets.policies():
        return ""
    report = Run(assets.policies()[name]).report() or {}
    evaluation, seconds = report["evaluation"], sum(report["seconds"].values())
    interval = evaluation["success_interval"]
    bound = f"lower bound {100 * interval[0]:.1f} %" if interval else "all from the same start"
    success = f"{100 * evaluation['success']:.1f} % of {evaluation['episodes']:,} episodes succeed, {bound}"
    return (
        f"The bundled policy (`jaxdrones train {name} --seed 0`, {seconds:.0f} s in all, commit "
        f"{report['commit']}): {success}.\n\n"
    )


def _measured(name: str, results: str) -> str:
    """Rows of a task in the table of results."""
    head, rows = re.search(r"^(\| task, learner .*\n\|[-|: ]+\n)((?:\|.*\n)+)", results, re.M).groups()
    own = [row for row in rows.splitlines(keepends=True) if re.match(rf"\| `{name}`[ ,]", row)]
    if not own:
        return "" if name in assets.policies() else "Not measured."
    return f"Measured on 2 shared CPU cores ([Train a policy](../training.md#results)):\n\n{head}{''.join(own)}"


def _entries(entries: Sequence[Entry]) -> str:
    scaled = any(entry.quantity.values for entry in entries)
    head = ["", "term", "what", "unit", "frame", "range", *(["-1 is", "0 is", "1 is"] if scaled else [])]
    rows = []
    for i, entry in enumerate(entries):
        what = entry.quantity
        values = [number(x) for x in what.values] if what.values else [""] * 3
        span = f"{number(entry.low)} to {number(entry.high)}"
        rows.append([str(i), f"`{entry.term}`", what.name, what.unit, what.frame, span, *(values if scaled else [])])
    return _table(head, rows)


def _count(entries: Sequence[Entry]) -> str:
    return "1 number" if len(entries) == 1 else f"{len(entries)} numbers"


def _parts(parts: Sequence[Part], kind: str = "term") -> str:
    if not parts:
        return f"There is no {kind}."
    weighted = parts[0].weight is not None
    rows = ([f"`{part.name}`", *([number(part.weight)] if weighted else []), part.meaning] for part in parts)
    return _table([kind, *(["weight"] if weighted else []), "meaning"], rows)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
