"""API pages from docstrings, one per subpackage, after those of the most used names."""

from pathlib import Path

_LEFT_OUT = ("cli", "_assets", "__pycache__")
_HEAD = "# {name}\n\n{link}::: {name}\n    options:\n      members: false\n"
_MODULE = "\n## {name}\n\n::: {name}\n    options:\n      heading_level: 3\n"
_WITHOUT = "      filters: ['!^_', '!^{name}$']\n"  # what has a page of its own
_FIRST = {  # with a page of their own, before the rooms
    "make": "jaxdrones.envs.registry.make",
    "State": "jaxdrones.state.State",
    "make_step": "jaxdrones.engine.explicit.make_step",
}
_ONE = (
    "# {name}\n\n`jaxdrones.{name}`, from [`{module}`]({room}.md).\n\n::: {path}\n    options:\n"
    "      show_root_heading: true\n"
)
_ROOT = (
    "The names in `jaxdrones` itself come from the modules on this page and in the subpackages: `jaxdrones.make_step`, "
    "for example, comes from `jaxdrones.engine.explicit`.\n\n"
)


def pages(root: Path) -> dict[str, str]:
    """Path -> Markdown, in the order of the navigation."""
    package = root / "jaxdrones"
    rooms = [package, *(f for f in sorted(package.iterdir()) if f.is_dir() and f.name not in _LEFT_OUT)]
    first = {f"api/{name}.md": _one(name, path) for name, path in _FIRST.items()}
    return first | {f"api/{room.name}.md": _page(root, room) for room in rooms}


def _one(name: str, path: str) -> str:
    module = path.rpartition(".")[0]
    room = module.split(".")[1] if module.count(".") > 1 else "jaxdrones"
    return _ONE.format(name=name, path=path, module=module, room=room)


def _page(root: Path, room: Path) -> str:
    name = ".".join(room.relative_to(root).parts)
    inner = room.glob("*.py") if room.name == "jaxdrones" else room.rglob("*.py")
    modules = [".".join(f.relative_to(root).with_suffix("").parts) for f in sorted(inner)]
    shown = [module for module in modules if "__" not in module]
    head = _HEAD.format(name=name, link=_ROOT if room.name == "jaxdrones" else "")
    apart = {path.rpartition(".")[0]: _WITHOUT.format(name=name) for name, path in _FIRST.items()}
    return head + "".join(_MODULE.format(name=module) + apart.get(module, "") for module in shown)
