"""Training at the shell: what it writes, how it stops, how it goes on."""

import argparse
import contextlib
import csv
import io
import json
import re
import shlex
import shutil
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from helpers import SMALL_OPTIONS

from jaxdrones.cli import main, make_parser, train_output, train_request
from jaxdrones.cli.policies import team_of_run
from jaxdrones.cli.report import percent, success
from jaxdrones.cli.settings import parse_settings, with_config
from jaxdrones.cli.train_request import Request
from jaxdrones.learning import checkpoint, loggers
from jaxdrones.learning.evaluation import wilson_interval
from jaxdrones.training import trainer
from jaxdrones.training.recipe import Recipe
from jaxdrones.training.run import Run, report_as_dict

pytestmark = pytest.mark.float32

TRAIN = ["train", "hover", *SMALL_OPTIONS, "--budget", "4", "--episodes", "8"]
HOSTS = ["train", "hover", "--hosts", "2", "--host", "0", "--coordinator"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The folder of a short training, and what it printed."""
    folder = tmp_path_factory.mktemp("runs") / "hover"
    with jax.enable_x64(False), contextlib.redirect_stdout(io.StringIO()) as out:
        assert main([*TRAIN, "--output", str(folder), "--json"]) == 0
    return folder, json.loads(out.getvalue())


@pytest.mark.slow
def test_training_writes_policies_state_progress_figure_and_report(trained):
    folder, printed = trained
    run = Run(folder)
    assert run.policy("best")(np.zeros((1, 22), np.float32)).shape == (1, 4)
    assert run.policy("last").network.hidden_sizes == (8,)
    assert run.recipe().config.worlds == 4 and run.recipe().options == {"duration": 0.2}
    rows = run.history()
    assert [row["update"] for row in rows] == [0, 1, 2, 3, 4]
    assert "evaluated_return" in rows[0] and "reward" not in rows[0] and rows[0]["steps"] == 0
    assert rows[-1]["steps"] == 4 * 4 * 4 and "evaluated_return" in rows[-1] and rows[-1]["seconds"] > 0
    assert (folder / "curve.png").read_bytes().startswith(b"\x89PNG")
    (report,) = printed["seeds"]
    assert report == json.loads((folder / "report.json").read_text())
    assert report["evaluation"]["episodes"] == 8 and report["evaluation"]["success"] is None  # too short to succeed
    assert report["seconds"]["training"] > 0 and report["seconds"]["compiling"] > 0


def test_the_learning_curve_says_what_was_trained(monkeypatch, tmp_path):
    drawn = []
    monkeypatch.setattr(train_output.learning_curves, "save_curves", lambda *arguments: drawn.append(arguments))
    recipe = SimpleNamespace(task="hover", algorithm="ppo", realistic=True, options={"vehicle": "racer"})
    run = SimpleNamespace(recipe=lambda: recipe, history=list, sidecar=dict, sidecar_entry=lambda *_: 7)
    train_output.draw_curves(SimpleNamespace(no_figure=False), {0: run}, tmp_path)
    assert drawn[0][2] == "training hover by ppo, realistic, vehicle racer" and drawn[0][4] == {"seed 0": 7}


@pytest.mark.slow
@pytest.mark.needs("tensorboardX")
def test_a_logger_of_the_command_line_gets_every_update(monkeypatch, tmp_path):
    logged = []
    monkeypatch.setattr(loggers.TensorBoard, "__call__", lambda self, update, metrics, state: logged.append(update))
    assert main([*TRAIN, "--no-figure", "--json", "--log", "tensorboard", "--output", str(tmp_path)]) == 0
    assert logged == [0, 1, 2, 3, 4] and list(tmp_path.glob("events.out.tfevents.*"))


@pytest.mark.slow
def test_an_interrupted_training_keeps_the_best_and_goes_on_bit_for_bit(trained, tmp_path, capsys, monkeypatch):
    advance, calls = trainer.Trainer.advance, []

    def interrupted(self, state, updates):
        calls.append(updates)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return advance(self, state, updates)

    monkeypatch.setattr(trainer.Trainer, "advance", interrupted)
    folder = tmp_path / "hover"
    assert main([*TRAIN, "--output", str(folder)]) == 130
    said = capsys.readouterr().err
    assert "interrupted at update 2" in said and f"jaxdrones train hover --output {folder} --resume" in said
    assert said.count("\n") == 1
    Run(folder).policy("best")

    assert main([*TRAIN, "--output", str(folder)]) == 2
    assert "continue it with --resume" in capsys.readouterr().err
    assert main(["train", "hover", "--output", str(folder), "--resume", "--algo", "ppo"]) == 2
    assert "was started with algo bptt, not ppo" in capsys.readouterr().err

    assert main(["train", "hover", "--output", str(folder), "--resume"]) == 0
    whole, _ = trained
    for name in ("state", "last", "best"):
        file = f"{name}.msgpack"
        assert (folder / file).read_bytes() == (whole / file).read_bytes()
    assert without_seconds(folder) == without_seconds(whole)
    capsys.readouterr()
    assert main(["train", "hover", "--output", str(folder), "--resume"]) == 2
    assert "is complete" in capsys.readouterr().err


def test_the_command_that_continues_a_training_can_be_pasted_whatever_its_names_are():
    request = Request(task="my tasks.py:box", output=Path("runs/hidden_sizes=(8,8)/a b"), seed=4, seeds=2)
    words = ["train", "my tasks.py:box", "--output", "runs/hidden_sizes=(8,8)/a b", "--resume", "--seeds", "2"]
    assert shlex.split(request.again) == ["jaxdrones", *words, "--seed", "4"]


def contents(folder):
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}


@pytest.fixture
def nothing_compiles(monkeypatch):
    def compile(self):
        raise AssertionError("compiled")

    monkeypatch.setattr(trainer.Trainer, "compile", compile)


@pytest.mark.slow
@pytest.mark.parametrize("more", [[], ["--seed", "3"], ["--seeds", "2"], ["--algo", "shac"], ["--budget", "1s"]])
def test_a_finished_training_is_not_replaced_unasked(more, trained, nothing_compiles, capsys):
    folder, _ = trained
    before = contents(folder)
    assert main([*TRAIN[:-4], *more, "--output", str(folder)]) == 2
    said = capsys.readouterr().err
    assert f"{folder} holds a finished training; train it longer with --resume --budget N, replace it with" in said
    assert said.count("\n") == 1 and contents(folder) == before


@pytest.mark.slow
def test_the_default_folder_and_those_of_seeds_are_not_replaced_unasked(
    trained, tmp_path, nothing_compiles, capsys, monkeypatch
):
    folder, _ = trained
    monkeypatch.chdir(tmp_path)
    shutil.copytree(folder, "runs/hover/seed-1")
    before = contents(tmp_path / "runs/hover/seed-1")
    assert main(["train", "hover", "--seeds", "2"]) == 2
    assert "seed-1 holds a finished training" in capsys.readouterr().err
    assert main(["train", "hover", "--resume"]) == 2
    assert "holds no training to continue; give --seeds N, or leave out --resume" in capsys.readouterr().err
    shutil.move("runs/hover/seed-1", "runs/moved")
    shutil.rmtree("runs/hover")
    shutil.move("runs/moved", "runs/hover")
    assert main(["train", "hover"]) == 2
    assert main(["train", "hover", "--seeds", "2", "--resume"]) == 2
    assert "holds the training of one seed; leave out --seeds" in capsys.readouterr().err
    assert contents(tmp_path / "runs/hover") == before


@pytest.mark.parametrize("name", ["best.json", "last.msgpack", "state.msgpack", "progress.csv", "report.json"])
def test_whatever_is_left_of_a_run_is_not_replaced_unasked(name, nothing_compiles, tmp_path, capsys):
    (tmp_path / name).write_text("mine")
    assert main([*TRAIN, "--output", str(tmp_path)]) == 2
    assert "replace it with --overwrite, or choose another --output" in capsys.readouterr().err
    assert contents(tmp_path) == {name: b"mine"}


@pytest.mark.slow
def test_overwrite_loses_nothing_until_there_is_something_in_its_place(trained, tmp_path, monkeypatch, capsys):
    folder = shutil.copytree(trained[0], tmp_path / "hover")
    (folder / "notes.txt").write_text("of other people")
    before = contents(folder)
    overwrite = [*TRAIN, "--output", str(folder), "--overwrite", "--no-figure"]

    def interrupted(self):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(trainer.Trainer, "compile", interrupted)
        assert main(overwrite) == 130
    for wrong in (["--set", "horizon=0"], ["--set", "gradient=steep"], ["--resume"]):
        assert main([*overwrite, *wrong]) == 2
    assert contents(folder) == before
    assert main([*overwrite, "--seed", "5"]) == 0
    after = contents(folder)
    assert after["notes.txt"] == b"of other people" and after["best.msgpack"] != before["best.msgpack"]
    assert Run(folder).sidecar_entry("state", "seed") == 5 and Run(folder).report()["updates"] == 4
    assert [row["update"] for row in Run(folder).history()] == [0, 1, 2, 3, 4]


def test_a_policy_of_another_vehicle_than_that_of_the_training_is_named(capsys, monkeypatch, tmp_path):
    """--from keeps its parameters only."""
    run = argparse.Namespace(recipe=lambda: Recipe.of("hover", vehicle="racer"), policy=lambda env: None)
    monkeypatch.setattr(train_request, "open_policy", lambda *_: run)
    for options, warned in ([], True), (["--vehicle", "racer"], False), (["--vehicle", "hb"], False):
        options = make_parser().parse_args(
            ["train", "hover", "--from", "runs/racer", "--output", str(tmp_path / "run"), *options]
        )
        request = Request.of(options)
        request.first_policy(request.recipe({}))
        warning = "runs/racer was trained with the vehicle racer, .* this training is with cf2x; give --vehicle racer"
        assert bool(re.search(warning, capsys.readouterr().err)) == warned


@pytest.mark.slow
def test_a_training_from_a_policy_starts_with_its_parameters(trained, tmp_path, capsys):
    first = jax.tree.leaves(Run(trained[0]).policy())
    command = [*TRAIN, "--seed", "5", "--output", str(tmp_path), "--no-figure"]
    assert main([*command, "--from", str(trained[0]), "--keep-history"]) == 0
    run = Run(tmp_path)
    assert run.recipe().start_from == str(trained[0])
    for name, same in ((run.kept[0], True), (run.kept[-1], False)):
        assert all(np.array_equal(x, y) for x, y in zip(first, jax.tree.leaves(run.policy(name)), strict=True)) == same
    assert main([*command, "--resume"]) == 0 and run.history()[-1]["update"] == 8


@pytest.mark.slow
def test_a_finished_training_goes_on_with_a_budget_and_keeps_its_best(trained, tmp_path, capsys, monkeypatch):
    folder = shutil.copytree(trained[0], tmp_path / "hover")
    resume = ["train", "hover", "--output", str(folder), "--resume", "--no-figure"]
    before, best = contents(folder), tuple(Run(folder).sidecar_entry("best", "score"))
    for wrong, message in [
        ([], "is complete (updates=4); train longer with --budget N or 60s"),
        (["--set", "updates=4"], "is complete (updates=4)"),
        (["--set", "updates=3"], "was started with updates 4, not 3"),
        (["--budget", "2147483647"], "updates is 2147483651; give at most"),
        (["--budget", "2", "--episodes", "9"], "was started with episodes 8, not 9"),
        (["--budget", "2", "--set", "worlds=8"], "was started with worlds 4, not 8"),
        (["--budget", "2", "--seed", "1"], "was started with seed 0, not 1"),
    ]:
        assert main([*resume, *wrong]) == 2
        assert message in capsys.readouterr().err
    assert contents(folder) == before

    assert main([*resume, "--budget", "2", "--set", "hidden_sizes=[8]"]) == 0  # a list or a tuple is the same
    assert "updates: 6, 4 of them made" in capsys.readouterr().out
    assert Run(folder).report()["updates"] == 6 == Run(folder).sidecar_entry("state", "update")
    assert rewards(folder)[:4] == rewards(trained[0]) and len(rewards(folder)) == 6
    assert at_least(Run(folder).sidecar_entry("best", "score"), best)

    advance, calls = trainer.Trainer.advance, []

    def interrupted(self, state, updates):
        calls.append(updates)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return advance(self, state, updates)

    with monkeypatch.context() as patch:
        patch.setattr(trainer.Trainer, "advance", interrupted)
        assert main([*resume, "--set", "updates=12"]) == 130
    assert Run(folder).report() is None
    made = Run(folder).sidecar_entry("state", "update")
    assert 6 < made < 12
    assert main([*resume, "--budget", "5"]) == 2
    assert "was started with updates 12, not 5" in capsys.readouterr().err
    assert main([*resume, "--budget", "0.001s"]) == 0
    assert made < Run(folder).report()["updates"] == len(rewards(folder))
    assert at_least(Run(folder).sidecar_entry("best", "score"), best)


def rewards(folder):
    return [row["reward"] for row in Run(folder).history()[1:]]


def at_least(score, before):
    return score[0] > before[0] or score[1] >= before[1]


def without_seconds(folder):
    with (folder / "progress.csv").open() as file:
        return [{name: x for name, x in row.items() if name != "seconds"} for row in csv.DictReader(file)]


@pytest.mark.slow
def test_numbers_that_are_not_finite_stop_training_and_the_best_policy_stays(tmp_path, capsys):
    overflowing = "learning_rate=3.3e38"  # beyond the largest float32 after two updates
    wild = [*TRAIN, "--set", overflowing, "--no-figure", "--output", str(tmp_path)]
    assert main(wild) == 1
    said = capsys.readouterr().err
    assert "training diverged" in said and "best.msgpack is the best policy" in said and "learning_rate" in said
    for leaf in jax.tree.leaves(Run(tmp_path).policy()):
        assert np.isfinite(leaf).all()


@pytest.mark.slow
def test_gradients_that_are_not_finite_stop_training_though_nothing_else_shows_them(tmp_path, capsys):
    steep = ["--algo", "ppo", "--set", "minibatches=2", "--set", "value_coef=1e38", "--no-figure"]
    assert main([*TRAIN, *steep, "--output", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert "training diverged: gradients were not finite in 4 updates in a row" in said and said.count("\n") == 1
    assert "best.msgpack is the best policy" in said
    assert main([*TRAIN, "--no-figure", "--overwrite", "--output", str(tmp_path)]) == 0
    assert all(row["nonfinite_gradients"] == 0 for row in Run(tmp_path).history()[1:])


@pytest.mark.slow
def test_every_seed_is_logged_as_a_run_of_its_own(monkeypatch, tmp_path):
    """By a logger that, as W&B and MLflow, has one active run."""
    active, logged = [], {}

    class Logger:
        def __init__(self, folder):
            assert not active
            active.append(folder.name)

        def __call__(self, update, metrics, state):
            logged.setdefault(active[0], []).append(update)

        def close(self):
            active.clear()

    monkeypatch.setitem(loggers._NAMED, "tensorboard", Logger)
    monkeypatch.setitem(loggers._LIBRARIES, "tensorboard", "json")
    command = [*TRAIN, "--seeds", "2", "--no-figure", "--json", "--log", "tensorboard", "--output", str(tmp_path)]
    assert main(command) == 0 and not active
    assert logged == {"seed-0": [0, 1, 2, 3, 4], "seed-1": [0, 1, 2, 3, 4]}


@pytest.mark.slow
def test_seeds_share_a_program_and_the_best_of_them_is_flown(tmp_path, capsys):
    arguments = [
        "train",
        "hover",
        *SMALL_OPTIONS,
        "--algo",
        "shac",
        "--budget",
        "0.001s",
        "--episodes",
        "8",
        "--seeds",
        "2",
    ]
    assert main([*arguments, "--seed", "3", "--json", "--output", str(tmp_path)]) == 0
    captured = capsys.readouterr()
    assert "warning: compilation took all of --budget 0.001s; one update is made, --resume adds more" in captured.err
    printed = json.loads(captured.out)
    assert [report["seed"] for report in printed["seeds"]] == [3, 4] and printed["best_seed"] in (3, 4)
    assert all(report["updates"] == 1 for report in printed["seeds"])  # the least, when there is no time
    best = checkpoint.load(tmp_path / "best")
    same = checkpoint.load(tmp_path / f"seed-{printed['best_seed']}" / "best")
    jax.tree.map(np.testing.assert_array_equal, best, same)
    assert main(["eval", str(tmp_path), "--episodes", "4"]) == 0
    assert "hover by shac" in capsys.readouterr().out


def configured(*words):
    """Words of a command line with those of its --config file."""
    return with_config(list(words), make_parser().commands["train"])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("budgt = 3", "unknown option in --config options.toml: 'budgt'; did you mean 'budget'? (known: algo, "),
        ("seeds = true", "--config options.toml: seeds is true; give its value"),
        ("task = 3", "--config options.toml: task is 3; give a name in quotation marks"),
        ("task = ['hover']", "--config options.toml: task is ['hover']; give a name"),
    ],
)
def test_a_wrong_entry_of_a_file_of_options_is_named_with_the_file(content, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("options.toml").write_text(content)
    assert main(["train", "--config", "options.toml"]) == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1


def test_names_of_a_setting_are_separated_by_commas():
    for text in ("omega,gravity", "omega, gravity,", "('omega', 'gravity')", "['omega', 'gravity']"):
        assert tuple(parse_settings([f"observation={text}"])["observation"]) == ("omega", "gravity")
    assert parse_settings(["effects=drag", "action=rpm"]) == {"effects": ("drag",), "action": "rpm"}


def test_a_file_of_options_is_read_however_it_is_given(tmp_path):
    file = tmp_path / "options.toml"
    file.write_text("seeds = 3\n[set]\nhidden_sizes = [8]\n[sweep]\nhorizon = 5\ngamma = [0.9, 0.99]\n")
    read = ["train", "hover", "--seeds=3", "--set=hidden_sizes=[8]", "--sweep=horizon=5", "--sweep=gamma=0.9,0.99"]
    for words in (["--config", str(file)], [f"--config={file}"]):
        assert configured("train", "hover", *words) == read


@pytest.mark.parametrize(
    ("given", "sweep", "settings"),
    [
        (["--sweep", "horizon=2,3"], ["horizon=2,3"], {"gamma": 0.5}),  # also in place of a value of [sweep]
        (["--sweep=gamma=0.1,0.2"], ["horizon=5,6", "gamma=0.1,0.2"], {}),
        (["--set", "horizon=7"], [], {"gamma": 0.5, "horizon": 7}),
        (["--set=gamma=0.3"], ["horizon=5,6"], {"gamma": 0.3}),
    ],
)
def test_settings_of_the_command_line_override_those_of_a_file(given, sweep, settings, tmp_path):
    (tmp_path / "options.toml").write_text("[set]\ngamma = 0.5\n[sweep]\nhorizon = [5, 6]\n")
    words = configured("train", "hover", "--config", str(tmp_path / "options.toml"), *given)
    request = Request.of(make_parser().parse_args(words))
    assert request.sweep == sweep and request.settings == settings
    assert request.swept()


def test_a_task_of_the_command_line_overrides_that_of_a_file(tmp_path):
    file = tmp_path / "options.toml"
    file.write_text('task = "hover"\nseeds = 2\n')
    assert configured("train", "--config", str(file)) == ["train", "hover", "--seeds=2"]
    assert configured("train", "--from", "hover", "--config", str(file))[:2] == ["train", "hover"]
    for words in ["tracking", "--seed", "1"], ["--seed", "1", "tracking"], ["--seed=1", "tracking"]:
        read = configured("train", *words, "--config", str(file))
        assert read.count("tracking") == 1 and "hover" not in read and "--seeds=2" in read


def test_the_table_of_a_sweep_shows_the_best_seed_of_each_run():
    def seed(number, success):
        interval = [success, 1.0]
        evaluation = dict(success=success, success_interval=interval, episodes=100, mean_return=100 * success)
        return {"seed": number, "evaluation": evaluation}

    results = [
        {"output": "runs/a", "best_seed": 1, "seeds": [seed(0, 0.5), seed(1, 0.75)]},
        {"output": "runs/b", "best_seed": 0, "seeds": [seed(0, 0.25), seed(1, 0.0)]},
    ]
    assert train_output.sweep_table(results).splitlines()[2:] == [
        "  runs/a  75.00   75.0 %, 75 of 100, 95 % interval 75.00 to 100.00 %",
        "  runs/b  25.00   25.0 %, 25 of 100, 95 % interval 25.00 to 100.00 %",
    ]


@pytest.mark.slow
def test_a_sweep_of_a_file_trains_a_run_for_each_value(tmp_path, capsys):
    """Options of the command line override those of the file."""
    (tmp_path / "sweep.toml").write_text(
        'task = "hover"\nbudget = 2\nepisodes = 4\nno-figure = true\n[sweep]\nhorizon = [2, 4]\n'
        "[set]\nworlds = 4\nhidden_sizes = [8]\nduration = 0.2\n"
    )
    command = ["train", "--config", str(tmp_path / "sweep.toml"), "--budget", "1", "--output", str(tmp_path / "run")]
    assert main(command) == 0
    for horizon in (2, 4):
        run = Run(tmp_path / "run" / f"horizon={horizon}")
        assert run.recipe().config.horizon == horizon and run.recipe().config.hidden_sizes == (8,)
        assert [row["update"] for row in run.history()] == [0, 1]
    out = capsys.readouterr().out
    assert "hover by bptt, duration 0.2, horizon=2: 4 worlds x 2 control steps" in out
    assert re.search(r"all runs of the sweep.*\n +run +return +success\n.*horizon=2 .*\n.*horizon=4 .*\n$", out)
    assert main(command) == 2 and "horizon=2 holds a finished training" in capsys.readouterr().err
    assert main([*command, "--overwrite", "--json"]) == 0
    results = json.loads(capsys.readouterr().out)["runs"]
    assert [Path(result["output"]).name for result in results] == ["horizon=2", "horizon=4"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "hover", "--sweep", "horizon"], "give NAME=VALUE,VALUE"),
        (["train", "hover", "--log", "tensorboard,csv"], "give names of tensorboard, wandb, mlflow"),
        (["train", "hover", "--sweep", "horizon=2,3", "--set", "horizon=2"], "given by --set and by --sweep"),
        (["train", "hover", "--sweep", "updates=2,4", "--budget", "9s"], "--sweep updates is given beside --budget 9s"),
        (["train", "hover", "--sweep", "horizon=2", "--sweep", "horizon=3"], "--sweep horizon is given twice"),
        (["train", "hover", "--sweep", "gamma=0.9,0.99,0.90"], "--sweep has gamma=0.9 twice"),
        (["train", "hover", "--sweep", "gamma=0.9,2"], "gamma is 2.0; give a number of at least 0 and at most 1"),
        (["train", "hover", "--sweep", "worlds=8,many"], "worlds is 'many'; give a value such as 256"),
        (["train", "hover", "--config", "none.toml"], "--config none.toml cannot be read"),
        (["train", "hover", "--config=none.toml"], "--config none.toml cannot be read"),
        (["train", "hover", "--config", "none.toml", "--config=none.toml"], "--config is given twice"),
        (["train", "hoover"], "unknown task 'hoover'; did you mean 'hover'"),
        (["train", "hover", "--algo", "pppo"], "unknown algorithm 'pppo'; did you mean 'ppo'"),
        (["train", "hover", "--set", "wrlds=3"], "unknown setting 'wrlds'; did you mean 'worlds'"),
        (["train", "hover", "--set", "worlds=2.5"], "worlds is 2.5; give a value such as 256"),
        (["train", "hover", "--set", "worlds=0"], "worlds is 0"),
        (["train", "hover", "--set", "worlds"], "give NAME=VALUE"),
        (["train", "hover", "--algo", "ppo", "--set", "worlds=6"], "give a multiple of minibatches, 8"),
        (["train", "hover", "--budget", "long"], "--budget is 'long'; give updates"),
        (["train", "hover", "--seeds", "0"], "seeds is 0"),
        (["train", "hover", "--resume"], "holds no training to continue"),
        (["train", "hover", "--resume", "--overwrite"], "--resume and --overwrite are given"),
        (["train", "hover", "--resume", "--from", "hover"], "--resume and --from are given"),
        (["train", "hover", "--from", "nowhere"], "no checkpoint at nowhere/best"),
        (["train", "hover", "--from", "hovr"], "hovr is not a bundled policy; did you mean 'hover'"),
        (["train", "hover", "--from", "raptor"], "give the folder of a run or the name of a bundled policy"),
        (["train", "tracking", "--from", "hover"], "the environment tracking"),
        (
            ["train", "hover", "--from", "hover", "--set", "action=thrust_and_rates"],
            "the policy of hover was trained with observation=position_error,rotation_matrix,velocity_error,omega,"
            "last_action action=rpm, the environment hover has observation=position_error,rotation_matrix,"
            "velocity_error,omega,last_action action=thrust_and_rates; give those of the policy",
        ),
        (["train", "hover", "--from", "hover", "--set", "hidden_sizes=8,"], "-> 8 -> 4, tanh, 220 parameters"),
        (["train", "hover", "--algo", ""], "unknown algorithm ''"),
        (["train", "hover", "--seed", "-1"], "seed is -1"),
        (["train", "hover", "--seed", str(2**70)], "give at most 2147483647"),
        (["train", "hover", "--seeds", "2", "--seed", str(2**31 - 1)], "the last seed is 2147483648"),
        (["train", "hover", "--seeds", "1000000000"], "seeds is 1000000000; give at most 1000"),
        (["train", "hover", "--episodes", "1000000000000"], "episodes is 1000000000000; give at most"),
        (["train", "hover", "--episodes", "2000000000"], "2,000,000,000 episodes needs about 256 GB of memory"),
        (["train", "hover", "--set", "worlds=1000000000000"], "worlds is 1000000000000; give at most"),
        (
            ["train", "hover", "--set", "worlds=2000000000"],
            "2000000000 worlds x 64 control steps x 1 drones needs about",
        ),
        (["train", "hover", "--set", "hidden_sizes=1000000000,"], "smaller networks"),
        (["train", "hover", "--set", "drones=1000000000000"], "a team of 1,000,000,000,000 drones needs about"),
        (["train", "hover", "--set", "updates=3000000000"], "updates is 3000000000; give at most"),
        (["train", "hover", "--set", "surrogate=3"], "unknown setting 'surrogate'"),
        (["train", "hover", "--set", "task=x"], "--set task is not a setting"),
        (["train", "hover", "--set", "updates=3", "--budget", "4"], "--set updates=3 is given beside --budget"),
        (["train", "hover", "--set", "disturbance=3"], "disturbance"),
        (["train", "hover", "--set", "worlds=" + "9" * 5000], "worlds is"),
        (["train", "hover", "--budget", "1e30s"], "or a time up to 1000h"),
        (["train", "hover", "--budget", "99999999999"], "--budget is '99999999999'; give updates"),
        (["train", "hover", "--output", ""], "the path is empty"),
        (["train", "hover", "--hosts", "2"], "give all of --hosts, --host and --coordinator"),
        ([*HOSTS, "127.0.0.1:99999"], "coordinator is '127.0.0.1:99999'; give ADDRESS:PORT"),
        ([*HOSTS, "127.0.0.1:0"], "coordinator is '127.0.0.1:0'; give ADDRESS:PORT"),
        ([*HOSTS, "x" * 300 + ":80"], "did not reach all others"),
        (["eval", ""], "the path is empty"),
        (["eval", "file"], "file/best.json cannot be read: Not a directory"),
        (["eval", "raptor", "--task", "hover", "--last"], "--last is given, and raptor is no run"),
        (["eval", "nowhere", "--seed", "-1"], "seed is -1"),
        (["eval", "nowhere", "--episodes", "1000000000000"], "episodes is 1000000000000"),
        (["eval", "nowhere", "--backend", "gazebo"], "unknown backend 'gazebo'"),
        (["train", "hover", "--output", "file"], "choose another --output"),
        (["eval", "nowhere"], "no checkpoint at nowhere/best"),
        (["fly", "--policy", "nowhere"], "no checkpoint at nowhere/best"),
        (["fly", "--policy", "nowhere", "--vehicle", "hb"], "vehicle hb is given beside --policy"),
        (["fly", "--policy", "nowhere", "--backend", "gazebo"], "unknown backend 'gazebo'"),
    ],
)
def test_a_mistake_is_one_line_before_anything_is_trained(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("jaxdrones.limits.memory", lambda: 10**10)
    (tmp_path / "file").touch()
    try:
        code = main(arguments)
    except SystemExit as stop:
        code = stop.code
    captured = capsys.readouterr()
    assert code == 2 and captured.out == "" and message in captured.err and captured.err.count("\n") == 1
    assert len(captured.err) < 1200
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file"]


@pytest.mark.parametrize(
    ("successes", "episodes", "text"),
    [
        (9_999, 10_000, "99.99 %, 9,999 of 10,000, 95 % interval 99.943 to 99.998 %"),
        (10_000, 10_000, "100.00 %, 10,000 of 10,000, 95 % interval 99.962 to 100.000 %"),
        (999, 1000, "99.9 %, 999 of 1,000, 95 % interval 99.44 to 99.98 %"),
        (1, 3, "33.3 %, 1 of 3, 95 % interval 6.15 to 79.23 %"),
        (0, 1, "0.0 %, 0 of 1, 95 % interval 0.00 to 79.35 %"),
    ],
)
def test_eval_counts_the_successes(successes, episodes, text):
    assert (
        success(
            {
                "success": successes / episodes,
                "episodes": episodes,
                "success_interval": wilson_interval(successes, episodes),
            }
        )
        == text
    )


@pytest.mark.parametrize("episodes", [2, 7, 199, 201, 1000, 1001, 5000, 10_000, 10_001, 123_456_789])
def test_all_episodes_but_one_never_read_as_all_and_one_never_as_none(episodes):
    assert float(percent((episodes - 1) / episodes, episodes).split()[0]) < 100
    assert float(percent(1 / episodes, episodes).split()[0]) > 0


@pytest.mark.slow
def test_eval_prints_one_object(trained, capsys):
    folder, _ = trained
    assert main(["eval", str(folder), "--episodes", "8", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["evaluation"]["episodes"] == 8 and printed["recipe"]["task"] == "hover"
    assert printed["backend"] == "explicit"
    assert printed["evaluation"]["successes"] is None
    assert set(printed["evaluation"]["final_error_percentiles"]) == {"50", "95", "99"}


@pytest.mark.slow
def test_eval_fails_below_the_success_rate_that_is_given(trained, capsys, monkeypatch):
    folder, _ = trained
    command = ["eval", str(folder), "--episodes", "8", "--fail-below"]
    assert main([*command, "0.9"]) == 2 and "has no criterion of success" in capsys.readouterr().err
    assert main([*command, "2"]) == 2 and "fail-below is 2" in capsys.readouterr().err
    report = report_as_dict
    measured = {"success": 0.875, "success_interval": (0.5, 0.98)}
    monkeypatch.setattr("jaxdrones.cli.evaluate.report_as_dict", lambda result: report(result) | measured)
    command[1] = "hover"  # the bundled policy, whose episodes are long enough to succeed
    assert main([*command, "0.9"]) == 1 and "87.5 %, below --fail-below 0.9" in capsys.readouterr().err
    assert main([*command, "0.875"]) == 0


@pytest.mark.slow
@pytest.mark.needs("pybullet")
def test_a_policy_is_evaluated_from_the_same_starts_on_either_backend(trained, capsys):
    folder, _ = trained
    reports = []
    for backend in ("explicit", "bullet"):
        assert main(["eval", str(folder), "--episodes", "2", "--backend", backend, "--json"]) == 0
        printed = json.loads(capsys.readouterr().out)
        assert printed["backend"] == backend
        reports.append(printed["evaluation"])
    assert reports[0]["mean_return"] == pytest.approx(reports[1]["mean_return"], rel=1e-2)  # in free flight
    assert main(["eval", str(folder), "--episodes", "1", "--backend", "bullet"]) == 0
    assert "on the bullet backend" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.needs("pybullet")
def test_a_policy_is_flown_on_either_backend(trained, tmp_path, capsys):
    folder, _ = trained
    logs = []
    for backend in ("explicit", "bullet"):
        output = tmp_path / backend
        arguments = ["fly", "--policy", str(folder), "--backend", backend, "--output", str(output), "--json"]
        assert main([*arguments, *([] if backend == "bullet" else ["--no-figure"])]) == 0
        printed = json.loads(capsys.readouterr().out)
        assert printed["task"] == "hover" and printed["success"] is None and printed["duration"] == pytest.approx(0.2)
        logs.append(np.load(output / "log.npz"))
    assert (tmp_path / "bullet" / "flight.png").read_bytes().startswith(b"\x89PNG")
    assert logs[0]["pos"].shape == (20, 1, 3)
    np.testing.assert_allclose(logs[0]["pos"], logs[1]["pos"], atol=1e-4)  # float32, and no contact
    assert json.loads(str(logs[0]["conditions"]))["run"] == str(folder)


@pytest.mark.slow
@pytest.mark.needs("pybullet", "imageio_ffmpeg")
@pytest.mark.filterwarnings("ignore::ResourceWarning")  # of imageio-ffmpeg's pipes
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_policy_is_filmed(trained, tmp_path, capsys):
    folder, _ = trained
    film = tmp_path / "film.mp4"
    arguments = ["fly", "--policy", str(folder), "--video", str(film), "--renderer", "bullet", "--no-figure"]
    assert main([*arguments, "--output", str(tmp_path)]) == 0
    assert film.stat().st_size > 1000
    assert "done: return" in capsys.readouterr().out


def test_drones_beside_a_run_are_the_size_of_the_team_and_beside_a_policy_of_a_file_an_option():
    settings = {"drones": 4, "density": 2.0}
    run = argparse.Namespace(policy=Path("runs/crowd"), drones=4)
    assert team_of_run(run, settings) == {"drones": 4} and settings == {"density": 2.0}
    own = argparse.Namespace(policy=Path("mine.py:policy"), drones=4)
    assert team_of_run(own, {"drones": 4}) == {} == team_of_run(argparse.Namespace(policy=run.policy, drones=None), {})


@pytest.mark.slow
def test_a_policy_of_a_run_flies_teams_of_other_sizes_unless_each_drone_has_its_own(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    small = ["--set", "updates=1", "--set", "worlds=2", "--set", "horizon=2", "--no-figure"]
    assert main(["train", "crowd", "--drones", "2", *small]) == 0
    capsys.readouterr()
    assert main(["eval", "runs/crowd", "--drones", "5", "--episodes", "2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["evaluation"]["episodes"] == 2
    assert main(["fly", "--policy", "runs/crowd", "--drones", "3", "--no-figure"]) == 0
    with np.load("runs/crowd/flight/log.npz") as log:
        assert log["pos"].shape[1] == 3
    assert main(["train", "flock", *small]) == 0
    capsys.readouterr()
    assert main(["eval", "runs/flock", "--drones", "3", "--episodes", "2"]) == 2
    assert "has a network for each of 2 drones; give as many, not 3" in capsys.readouterr().err
