"""Who may import whom, and what `import jaxdrones` costs."""

import ast
import functools
import re
import subprocess
import sys
from pathlib import Path

from documents import ROOT

import jaxdrones

PACKAGE = Path(jaxdrones.__file__).parent

NOUNS = (
    "arguments",
    "assets",
    "checks",
    "errors",
    "limits",
    "params",
    "pytree",
    "quantity",
    "rotation",
    "state",
    "status",
    "thrust_curves",
    "urdf",
    "urdf_writer",
    "user_code",
    "vector",
    "vehicles",
    "wrench",
    "writing",
)
LAYERS = (  # from the bottom; the groups of a layer are peers, and none imports another
    (NOUNS,),
    (("dynamics",), ("control",), ("sensing",), ("accelerate",)),
    (("engine",), ("tasks",)),
    (("optimal",),),
    (("envs",), ("flights",)),
    (("adapters",), ("firmware",), ("learning",), ("ros2",), ("visualization",)),
    (("training",), ("export",)),
    (("cli",),),
    (("",), ("__main__",)),  # the package itself, which re-exports, and `python -m jaxdrones`
)
PLACE = {
    module: (layer, peer) for layer, peers in enumerate(LAYERS) for peer, group in enumerate(peers) for module in group
}
OPTIONAL = ("gymnasium", "pettingzoo", "brax", "stable_baselines3", "torch", "pybullet", "matplotlib", "tqdm", "casadi")
OPTIONAL += ("onnx", "rosbags", "rclpy", "ray", "shtab", "tianshou")

FILES = sorted(PACKAGE.rglob("*.py"))


def top(file: Path) -> str:
    """`dynamics` for jaxdrones/dynamics/aero.py, the empty name for jaxdrones/__init__.py."""
    first = file.relative_to(PACKAGE).parts[0].removesuffix(".py")
    return "" if first == "__init__" else first


@functools.cache
def paths(file: Path) -> set[str]:
    """Dotted names of the package that a file imports, wherever in the file it does: modules, or what is in them."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative import; write the full name"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {path for path in found if path.partition(".")[0] == "jaxdrones"}


def imports(file: Path) -> set[str]:
    """Top-level names of the package that a file imports."""
    tops = {path.split(".")[1] for path in paths(file)}
    return {name if name in PLACE else "" for name in tops}


def imported_files(file: Path) -> set[Path]:
    """Files of the package that a file imports: of `jaxdrones.a.b.c` that of b if c is a name in it."""
    found = set()
    for path in paths(file):
        parts = path.split(".")[1:]
        candidates = [PACKAGE.joinpath(*parts[:end]) for end in range(len(parts), 0, -1)]
        named = (f for c in candidates for f in (c.with_suffix(".py"), c / "__init__.py") if f.is_file())
        found.add(next(named, PACKAGE / "__init__.py"))
    return found - {file}


def test_imports_point_to_lower_layers():
    assert {top(file) for file in FILES} <= PLACE.keys()  # say in LAYERS where a new room belongs
    upward = []
    for file in FILES:
        layer, peer = PLACE[top(file)]
        for module in imports(file):
            other_layer, other_peer = PLACE[module]
            if not (other_layer < layer or (other_layer, other_peer) == (layer, peer)):
                upward.append(f"{file.relative_to(PACKAGE)} imports jaxdrones.{module or '__init__'}")
    assert upward == []


def test_no_file_imports_itself_by_way_of_others():
    graph = {file: imported_files(file) for file in FILES}
    cycles = []

    def visit(file: Path, way: tuple[Path, ...]) -> None:
        if file in way:
            cycles.append(" -> ".join(str(f.relative_to(PACKAGE)) for f in (*way[way.index(file) :], file)))
        elif file not in done:
            for other in sorted(graph[file]):
                visit(other, (*way, file))
            done.add(file)

    done: set[Path] = set()
    for file in FILES:
        visit(file, ())
    assert cycles == []


def test_every_file_is_short_enough_to_be_read_at_once():
    assert [str(f.relative_to(PACKAGE)) for f in FILES if len(f.read_text().splitlines()) > 300] == []


def test_what_jax_does_not_promise_to_keep_is_touched_in_one_file():
    inner = ("jax._src", "jax.extend", "jax.interpreters", "jax.experimental.xla_metadata")
    assert [f.name for f in FILES if any(name in f.read_text() for name in inner)] == ["compiler.py"]


PHYSICS = [f for f in FILES if top(f) in ("dynamics", "control", "rotation", "vector", "state", "params", "wrench")]


def test_physics_knows_no_compiler():
    words = ("XLA", "jaxpr", "fusion", "kernel", "stored", "nanosecond", "optimization_barrier", "compiler")
    assert [(file.name, word) for file in PHYSICS for word in words if word in file.read_text()] == []


def test_the_imports_of_a_file_are_found():
    assert imports(PACKAGE / "engine" / "explicit.py") >= {"engine", "arguments", "dynamics", "params", "state"}
    assert imports(PACKAGE / "dynamics" / "aero.py") >= {"rotation", "dynamics", "wrench"}


def test_package_and_command_line_load_no_optional_library_and_start_no_device():
    code = """
import sys, jax, jaxdrones.cli, jaxdrones.learning
loaded = [name for name in sys.argv[1:] if name in sys.modules]
jax.config.update("jax_num_cpu_devices", 3)
print(len(jax.devices()), *loaded)
"""
    done = subprocess.run([sys.executable, "-c", code, *OPTIONAL], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["3"]


def test_a_mistake_of_a_user_has_its_own_error():
    for file in FILES:
        raised = [node.exc for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.Raise)]
        names = {getattr(getattr(exc, "func", exc), "id", None) for exc in raised}
        assert "ValueError" not in names, f"{file}: raise UserError, which the command line prints as one line"


def test_the_map_for_contributors_names_every_module_and_none_that_is_gone():
    layout = re.search(r"```text\n(.*?)```", (ROOT / "CONTRIBUTING.md").read_text(), re.S)
    words = set(re.findall(r"\w+", layout[1]))
    modules = {file.parent.name if file.stem == "__init__" else file.stem for file in FILES}
    one_command_a_file = {file.stem for file in PACKAGE.glob("cli/*.py")}
    assert modules - one_command_a_file - {"__main__"} - words == set()
    functions = {"check_env", "make_step", "over_worlds"}
    assert {word for word in words if "_" in word} - modules - functions == set()
