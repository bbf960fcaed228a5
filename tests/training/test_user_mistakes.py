"""Mistakes in the files of users: each is one line that names the file, the field and what to do."""

import re
from pathlib import Path

import jax
import pytest

import jaxdrones as jd
from jaxdrones import user_code
from jaxdrones.cli import main
from jaxdrones.cli.common import print_failure
from jaxdrones.training.user_policy import UserPolicy

TASK = """
import jax, jax.numpy as jnp, jaxdrones as jd
from jaxdrones.control import Setpoint
from jaxdrones.tasks import ObservationTerm, Quantity, Task

def start(key, params):
    return jd.State.at_rest(jnp.ones((2, 3))), {"k": jnp.zeros(2)}

def target(variables, t):
    return Setpoint.at(jnp.ones((2, 3)))

def near(task, world):
    return -world.drones.pos[:, 0]

def low(task, world):
    return world.drones.pos[:, 2] < 0

def kept(task, world):
    return world.variables

def success(metrics, dt):
    return metrics["error"][-1] < 0.1

def height(task, world):
    return world.drones.pos[:, 2:]

def draw(key, params):
    return params

def mine(drones: int = 2):
    return Task(
        name="mine", summary="a task", drones=drones, duration=1.0, start=start, target=target,
        rewards={"near": (1.0, near)}, terminations={"low": low}, truncations={"end": low}, metrics={"near": near},
        advance=kept, success=success, observations={"height": ObservationTerm(height, 5.0)}, randomize=(draw,),
        observation=("height",), camera=None, contact=(),
    )
"""
MISTAKES = [  # (what stands in the file, what a user wrote in its place, what is said)
    ("(drones: int = 2)", "(drones)", "takes drones without a default; give defaults in the file"),
    ("(drones: int = 2)", "(drones, /)", "takes drones without a default"),
    ("(drones: int = 2)", "(drones=2, *, speed)", "takes speed without a default"),
    ("return Task(", "Task(", "mine returned None; return a jaxdrones.tasks.Task"),
    ("return Task(", "return dict(", "mine returned {.*; return a jaxdrones.tasks.Task"),
    ("return Task(", "return 1 / 0\n    Task(", r"\(mine\) raises ZeroDivisionError: division by zero"),
    ("return Task(", "raise OSError(2, 'gone', 'data.csv')\n    Task(", r"\(mine\) raises FileNotFoundError: .*gone"),
    ("return Task(", "raise ValueError('mine alone')\n    Task(", r"\(mine\) raises ValueError: mine alone"),
    ("return Task(", "raise SystemExit\n    Task(", r"\(mine\) raises SystemExit\(None\); .* must not exit"),
    ("return Task(", "assert drones > 5\n    Task(", r"\(mine\) raises AssertionError"),
    ("return Task(", "return mine(drones)\n    Task(", r"\(mine\) raises RecursionError"),
    ("return Task(", "return unknown\n    Task(", r"\(mine\) raises NameError: name 'unknown' is not defined"),
    ("import jax,", "import sys; sys.exit(0)\nimport jax,", r"raises SystemExit\(0\); .* must not exit the program"),
    ("import jax,", "raise SystemExit\nimport jax,", r"raises SystemExit\(None\)"),
    ("import jax,", "import no_such_library\nimport jax,", "No module named 'no_such_library'; your file may"),
    ("import jax,", "from jaxdrones import Stat\nimport jax,", r"cannot import name 'Stat' from 'jaxdrones' \(.*\)\n"),
    ("def start(", "def start(:\ndef start(", "line 6 raises SyntaxError"),
    ("def mine", "def mein", "defines no 'mine'; did you mean 'mein'?"),
    ("drones=drones,", "", "raises TypeError: .*missing .*'drones'"),
    ("drones=drones,", "drones=drones, speed=3,", "unexpected keyword argument 'speed'"),
    ("drones=drones", "drones=0", "number of drones of a task is 0; give a whole number"),
    ("drones=drones", "drones='two'", "number of drones of a task is 'two'; give a whole number"),
    ("drones=drones", "drones=3", r"start returns a state whose pos is an array \(2, 3\).*; give an array \(3, 3\)"),
    ('name="mine"', "name=3", "name of the task is 3; give a string"),
    ('summary="a task"', "summary=None", "summary of the task is None; give a string"),
    ("duration=1.0", "duration=-1", "duration is -1; give a positive number"),
    ("duration=1.0", "duration='long'", "duration is 'long'; give a positive number"),
    ("duration=1.0", "duration=1e-9", "duration is 1e-09 s, .* control steps"),
    ("duration=1.0", "duration=1.0, control_hz=0", "control_hz is 0; give a positive number"),
    ("duration=1.0", "duration=1.0, substeps=2.5", "substeps is 2.5; give a whole number"),
    ("duration=1.0", "duration=1.0, scene=3", r"scene: 3 is not a function; give a function of \(key\)"),
    ("duration=1.0", "duration=1.0, scene=lambda key: 3", "the function that draws the scene returned 3"),
    ("duration=1.0", "duration=1.0, vision=('colour',)", "unknown image 'colour'"),
    ("duration=1.0", "duration=1.0, action='fly'", "unknown action 'fly'"),
    ("duration=1.0", "duration=1.0, obstacles_terminate=1", "obstacles_terminate is 1; give True or False"),
    ("camera=None", "camera=3", "camera of the task is 3; give a Camera"),
    ("contact=()", "contact=('water',)", "unknown contact 'water'"),
    ("contact=()", "contact=3", "contact is 3; give a sequence"),
    ("start=start", "start=None", r"start: None is not a function; give a function of \(key, params\)"),
    ("start=start", "start=lambda key: 3", r"start: .* takes \(key\); give a function of \(key, params\)"),
    ('), {"k": jnp.zeros(2)}', ")", "start returns State.*; return a State of the team and the task's variables"),
    ('{"k": jnp.zeros(2)}', "{'k': 'goal'}", "start returns variables that hold 'goal'; give arrays and numbers"),
    ("at_rest(jnp.ones((2, 3)))", "at_rest(jnp.ones(3))", r"\(start\): pos has shape \(3,\); expected \(n, 3\)"),
    ("at_rest(jnp.ones((2, 3)))", "at_rest(jnp.ones((1, 3)))", r"start returns a state whose pos is an array \(1, 3\)"),
    ("at_rest(jnp.ones((2, 3)))", "rest()", r"\(start\) raises AttributeError: .*rest"),
    (
        "target=target",
        "target=Setpoint.at(jnp.ones((2, 3)))",
        r"target: Setpoint.* is not a function; give a function of \(variables, time\)",
    ),
    ("target=target", "target=lambda: 0", r"target: .* takes \(\); give a function of \(variables, time\)"),
    (
        "return Setpoint.at(jnp.ones((2, 3)))",
        "return jnp.ones((2, 3))",
        r"target returns an array \(2, 3\).*; return Setpoint",
    ),
    (
        "return Setpoint.at(jnp.ones((2, 3)))",
        "return Setpoint.at(jnp.ones(3))",
        r"whose pos is an array \(3,\).*; give an array \(2, 3\)",
    ),
    (
        "return Setpoint.at(jnp.ones((2, 3)))",
        "return Setpoint.at(variables['goal'])",
        r"\(target\) raises KeyError: 'goal'",
    ),
    ('rewards={"near": (1.0, near)}', "rewards=3", "rewards is 3; give a dictionary of names"),
    ('rewards={"near": (1.0, near)}', "rewards=None", "rewards is None; give a dictionary of names"),
    ('rewards={"near": (1.0, near)}', "rewards=near", "rewards is <function near.*; give a dictionary of names"),
    ('rewards={"near": (1.0, near)}', "rewards={}", "rewards is empty; give at least one"),
    ('"near": (1.0, near)', '"near": near', r"rewards\['near'\] is <function near.*; give \(scale, function"),
    ('"near": (1.0, near)', '"near": (near, 1.0)', "scale of the reward 'near' is <function near"),
    ('"near": (1.0, near)', '"near": (1.0, 3)', r"rewards\['near'\]: 3 is not a function; give a function of"),
    ('"near": (1.0, near)', '"near": (1.0, near(1, 2))', r"\(near\) raises AttributeError"),
    ('"near": (1.0, near)', '"near": (float("nan"), near)', "scale of the reward 'near' is nan"),
    ('"near": (1.0, near)', '"near": (1.0, lambda world: 0)', r"rewards\['near'\]: .* takes \(world\)"),
    (
        "-world.drones.pos[:, 0]",
        "0.0",
        r"reward 'near' returns 0.0; return one number for every drone, an array \(2,\)",
    ),
    ("-world.drones.pos[:, 0]", "None", r"reward 'near' returns None; return one number for every drone"),
    ("-world.drones.pos[:, 0]", "world.drones.pos", r"line \d+: reward 'near' returns an array \(2, 3\)"),
    (
        "-world.drones.pos[:, 0]",
        "1 if world.drones.pos[0, 0] > 0 else 2",
        r"\(near\) raises TracerBool.*jax.numpy.where",
    ),
    ("-world.drones.pos[:, 0]", "float(world.time)", r"\(near\) raises ConcretizationTypeError: .*use jax.numpy"),
    (
        "-world.drones.pos[:, 0]",
        "__import__('numpy').sin(world.drones.pos)",
        r"\(near\) raises TracerArray.*use jax.numpy",
    ),
    ("-world.drones.pos[:, 0]", "world.drones.position", r"\(near\) raises AttributeError: .*position"),
    ("-world.drones.pos[:, 0]", "world.drones.pos @ world.drones.pos", r"\(near\) raises TypeError"),
    ("-world.drones.pos[:, 0]", "exit()", r"\(near\) raises (SystemExit|NameError)"),
    ('terminations={"low": low}', "terminations=None", "terminations is None; give a dictionary of names"),
    ('terminations={"low": low}', "terminations=[low]", r"terminations is \[.*; give a dictionary of names"),
    ('terminations={"low": low}', "terminations={'low': True}", r"terminations\['low'\]: True is not a function"),
    ('terminations={"low": low}', "terminations={1: low}", "terminations is {1.*; give a dictionary of names"),
    ('truncations={"end": low}', "truncations=low", "truncations is <function low.*; give a dictionary"),
    ("pos[:, 2] < 0", "pos[:, 2]", r"termination 'low' returns .*float32; return one boolean for every drone"),
    ("pos[:, 2] < 0", "pos < 0", r"termination 'low' returns an array \(2, 3\) of bool"),
    ('metrics={"near": near}', "metrics=('near',)", r"metrics is .*; give a dictionary of names"),
    (
        'metrics={"near": near}',
        "metrics={'near': lambda task, world: 'far'}",
        "metric 'near' returns 'far'; return one number",
    ),
    ("advance=kept", "advance=3", r"advance: 3 is not a function; give a function of \(task, world\)"),
    ("return world.variables", "return None", "advance returns variables PyTreeDef"),
    (
        "return world.variables",
        "return {'k': jnp.zeros(3)}",
        r"advance returns variables with an array \(3,\).*keep its shape",
    ),
    (
        "return world.variables",
        "return {'k': world.step}",
        r"advance returns variables with .*int32.*keep its shape and type",
    ),
    ("return world.variables", "return {**world.variables, 'n': 0}", "advance returns variables PyTreeDef"),
    ("success=success", "success=0.5", r"success: 0.5 is not a function; give a function of \(metrics, dt\)"),
    ("success=success", "success=lambda metrics: True", r"success: .* takes \(metrics\)"),
    ('metrics["error"][-1]', 'metrics["eror"][-1]', r"\(success\) raises KeyError: 'eror'"),
    (
        'metrics["error"][-1] < 0.1',
        'metrics["error"] < 0.1',
        r"success returns an array \(100, 2\) of bool; return one",
    ),
    (
        "ObservationTerm(height, 5.0)",
        "height",
        r"observations\['height'\] is <function height.*; give an ObservationTerm",
    ),
    ("ObservationTerm(height, 5.0)", "ObservationTerm(3, 5.0)", "observe of an ObservationTerm: 3 is not a function"),
    ("ObservationTerm(height, 5.0)", "ObservationTerm(height, -1)", "bound of an observation is -1"),
    ("ObservationTerm(height, 5.0)", "ObservationTerm(height, (1.0, 2.0))", "returns 1 numbers and has 2 in bound"),
    (
        "ObservationTerm(height, 5.0)",
        "ObservationTerm(height, 5.0, entries=(Quantity('a'), Quantity('b')))",
        "returns 1 numbers and has 2 in entries",
    ),
    ('observation=("height",)', 'observation="height"', "observation is 'height'; give a sequence"),
    ('observation=("height",)', "observation=()", "observation is empty"),
    ('observation=("height",)', "observation=('heigth',)", "unknown observation 'heigth'; did you mean 'height'"),
    ("pos[:, 2:]", "pos[:, 2]", r"observation 'height' returns an array \(2,\).*; return an array \(2, d\)"),
    ("pos[:, 2:]", "pos[:1, 2:]", r"observation 'height' returns an array \(1, 1\)"),
    ("randomize=(draw,)", "randomize=draw", "randomize is <function draw.*; give a sequence"),
    ("randomize=(draw,)", "randomize=(3,)", r"randomize: 3 is not a function; give a function of \(key, params\)"),
    ("    return params", "    return params.mass", "a randomization returns an array .*; return params.replace"),
    ("    return params", "    return params.replace(mass=jnp.ones(2))", r"parameters whose mass is an array \(2,\)"),
]
OF_MAKE = "unknown (action|observation)|observation is empty|control steps|the function that draws the scene"
"""Mistakes that `make` finds and that name the field alone, as an argument of `make` may replace it."""
POLICIES = [
    ("def policy(obs, key):\n    return obs[:, :4]", r"takes \(obs, key\); give a function of \(obs\)"),
    ("def policy():\n    return 0", r"takes \(\); give a function of \(obs\)"),
    ("def policy(obs):\n    return None", r"policy returns None; return actions of shape \(1, 4\)"),
    ("def policy(obs):\n    return obs[0, :4]", r"policy returns an array \(4,\).*; return actions of shape \(1, 4\)"),
    ("def policy(obs):\n    return obs[:, :4] > 0", r"policy returns an array \(1, 4\) of bool; return real numbers"),
    ("def policy(obs):\n    return obs[:, :4] * 1j", r"policy returns .* complex.*; return real numbers"),
    ("def policy(obs):\n    return [[0.0] * 4]", r"policy returns \[\[0.0.*; return actions of shape"),
    ("def policy(obs):\n    return 1 / 0", r"line 2 \(policy\) raises ZeroDivisionError"),
    ("def policy(obs):\n    import sys; sys.exit(3)", r"line 2 \(policy\) raises SystemExit\(3\)"),
    ("def policy(obs):\n    return float(obs[0, 0])", r"line 2 \(policy\) raises Concretization.*use jax.numpy"),
    ("policy = 3", "policy is 3; give a function from observations"),
    ("class policy:\n    def __call__(self, obs):\n        return obs", "policy is <class .*; give a function"),
]
MEMORY = """import jax.numpy as jnp
class Policy:
    def initial_hidden_state(self, batch): return jnp.zeros((*batch, 1))
    def act(self, memory, obs): return memory, obs[:, :4]
policy = Policy()
"""
POLICIES += [
    (MEMORY.replace(old, new), said)
    for old, new, said in [
        (
            "return memory, obs",
            "return jnp.tile(memory, 2), obs",
            r"act returns hidden state with an array \(1, 2\).*which was",
        ),
        (
            "return memory, obs",
            "return (memory, memory), obs",
            "act returns hidden state PyTreeDef.*return the same kind",
        ),
        (
            "return memory, obs",
            "return memory > 0, obs",
            r"act returns hidden state with .*bool.*; keep its shape and type",
        ),
        (
            "return memory, obs[:, :4]",
            "return obs[:, :4]",
            "act returns an array .*; return the hidden state and the actions",
        ),
        (
            "act(self, memory, obs)",
            "act(self, obs)",
            r"act: act takes \(obs\); give a function of \(hidden_state, obs\)",
        ),
        ("initial_hidden_state(self, batch)", "initial_hidden_state(self)", r"give a function of \(batch\)"),
        (
            "return jnp.zeros((*batch, 1))",
            "return 'none'",
            "initial_hidden_state returns a hidden state that hold 'none'",
        ),
        ("policy = Policy()", "policy = Policy", "policy is <class .*; give a function"),
    ]
]


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with jax.numpy_rank_promotion("allow"):
        yield


def said(capsys, make) -> str:
    """The line that the command line prints about what a function raises."""
    try:
        make()
    except BaseException as error:
        assert print_failure(error, debug=False) == 2
    else:
        return "nothing"
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and "Traceback" not in line, line
    return line


@pytest.mark.slow
@pytest.mark.float32
def test_a_mistake_in_a_task_is_one_line_that_names_the_file_and_the_field(capsys):
    Path("fine.py").write_text(TASK)
    assert jd.make("fine.py:mine").drones == 2
    wrong = {}
    for k, (old, new, expected) in enumerate(MISTAKES):
        assert old in TASK, old
        Path(f"my_{k}.py").write_text(TASK.replace(old, new))
        line = said(capsys, lambda k=k: jd.make(f"my_{k}.py:mine"))
        if not re.search(expected, line) or not (f"my_{k}.py" in line or re.search(OF_MAKE, expected)):
            wrong[old, new] = line
    assert not wrong, "\n".join(f"{case}: {line}" for case, line in wrong.items())


@pytest.mark.float32
def test_a_mistake_in_a_policy_is_one_line_that_names_the_file(capsys):
    env = jd.make("hover")
    for k, (text, expected) in enumerate(POLICIES):
        Path(f"my_{k}.py").write_text(text)
        line = said(capsys, lambda k=k: UserPolicy(f"my_{k}.py:policy", "hover", False, {}).policy(env))
        assert re.search(expected, line) and f"my_{k}.py" in line, (text, line)
    Path("fine.py").write_text(MEMORY)
    UserPolicy("fine.py:policy", "hover", False, {}).policy(env)


@pytest.mark.parametrize("command", ["explain", "train"])
def test_an_error_in_a_users_file_is_not_blamed_on_settings_and_debug_shows_its_traceback(command, capsys):
    text = TASK.replace("-world.drones.pos[:, 0]", "world.drones.pos[:, 0] / task.wind")
    Path("my.py").write_text(text)
    line = text.splitlines().index("    return world.drones.pos[:, 0] / task.wind") + 1
    options = ["--set", "drones=2"] + ["--set", "worlds=8", "--no-figure"] * (command == "train")
    assert main([command, "my.py:mine", *options]) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"jaxdrones: error: my.py: line {line} (near) raises AttributeError: 'Task' object has no")
    assert err.count("\n") == 1 and "--set" not in err and "--debug" in err
    for where in (["--debug", command], [command, "--debug"]):
        assert main([*where, "my.py:mine", *options]) == 2
        err = capsys.readouterr().err
        assert "Traceback (most recent call last)" in err and f'"my.py", line {line}, in near' in err
        assert err.splitlines()[-1].startswith(f"jaxdrones: error: my.py: line {line} (near) raises AttributeError")


@pytest.mark.parametrize("error", [ValueError("of numpy"), KeyError("x"), TypeError("of jax"), AssertionError()])
def test_a_fault_of_the_library_shows_its_traceback_and_ends_with_70(error, capsys, monkeypatch):
    def broken(*_, **__):
        raise error

    monkeypatch.setattr("jaxdrones.cli.explain.explain", broken)
    assert main(["explain", "hover", "--set", "duration=2.5"]) == 70
    err = capsys.readouterr().err
    assert "Traceback (most recent call last)" in err and "in broken" in err
    assert "this is a fault of jaxdrones, please report it" in err.splitlines()[-1]


@pytest.mark.parametrize("compiled", [True, False])
def test_nan_that_jax_was_asked_to_find_is_no_fault_of_the_library(compiled, capsys, monkeypatch):
    monkeypatch.setenv("JAX_DEBUG_NANS", "1")
    program = jax.jit(lambda x: x / x)
    zero = jax.numpy.zeros(())
    program = program.lower(zero).compile() if compiled else program
    with jax.debug_nans(True):
        assert re.search("nan.*JAX_DEBUG_NANS made this an error", said(capsys, lambda: program(zero)))


@pytest.mark.float32
def test_an_integer_that_overflows_is_blamed_on_its_setting(capsys):
    assert main(["explain", "tracking", "--set", "period=100000000000"]) == 2
    assert "--set period=100000000000 does not fit tracking: An overflow" in capsys.readouterr().err


@pytest.mark.parametrize("command", [[], ["fly"], ["ros2", "replay"]])
def test_exit_codes_are_in_the_help(command, capsys):
    with pytest.raises(SystemExit) as stop:
        main([*command, "--help"])
    assert stop.value.code == 0
    assert re.search(r"\n +2  invalid arguments.*\n +70  internal error", capsys.readouterr().out)
    with pytest.raises(SystemExit) as stop:
        main(["soar"])
    assert stop.value.code == 2


def test_an_error_elsewhere_is_not_blamed_on_a_users_file():
    try:
        int("x")
    except ValueError as error:
        assert user_code.blame(error) is None
