"""Policies on the command line: of a run of `jaxdrones train`, of a user's file, bundled or published ones."""

import argparse
import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxdrones import assets
from jaxdrones.checks import hint
from jaxdrones.cli.common import folder, run_folder
from jaxdrones.cli.options import add_set, add_task, add_vehicle, option
from jaxdrones.cli.report import described
from jaxdrones.cli.settings import add_realistic
from jaxdrones.errors import UserError
from jaxdrones.learning.policies import POLICIES
from jaxdrones.training.run import Run
from jaxdrones.training.user_policy import UserPolicy
from jaxdrones.user_code import is_reference


def is_user_policy(policy: Path) -> bool:
    """Whether this is a policy of a user's file, `file.py:name`, or a published one, not the folder of a run."""
    return is_reference(str(policy)) or (str(policy) in POLICIES and not policy.exists())


def is_bundled(policy: Path) -> bool:
    """Whether this is the name of a bundled policy; a folder of the same name goes first."""
    return str(policy) in assets.policies() and not policy.exists()


def output_folder(policy: Path, what: str) -> Path:
    """Default folder of what is made with a policy, such as `flight`: in its run, or under runs/ by its name."""
    if is_bundled(policy):
        return Path("runs") / f"bundled-{policy}" / what
    return run_folder(str(policy)) if is_user_policy(policy) else policy / what


def add_policy(parser: argparse.ArgumentParser, others: str = "") -> argparse._ArgumentGroup:
    """Add the argument RUN, which may be `others`, too; return the group of options for a policy that is no run."""
    option(
        parser,
        "policy RUN",
        "folder of `jaxdrones train`, for example runs/hover; a task with a bundled policy (`jaxdrones list`); "
        f"{others}or file.py:name, whose code is executed",
        folder,
    )
    own = parser.add_argument_group("your own policy", "only for a policy that is not a run")
    add_task(own, "task of the policy, as for `jaxdrones train`")
    add_vehicle(own)
    add_realistic(own)
    add_set(own, "option of the environment (action, observation, ...)")
    return own


def policy_of(run: Any, options: argparse.Namespace) -> tuple[Any, str, Callable[[Any], Any], dict[str, Any]]:
    """Recipe and title of an opened policy, a function of its environment that returns it, and its place in a run."""
    if is_user_policy(options.policy):
        return run.recipe(), described(run.recipe()), run.policy, {}
    name = "last" if options.last else "best"
    recipe, update = run.recipe(name), run.sidecar_entry(name, "update")
    title = f"{described(recipe)}: policy of update {update}"
    return recipe, title, functools.partial(run.policy, name), {"policy": name, "update": update}


def team_of_run(options: argparse.Namespace, settings: dict[str, Any]) -> dict[str, Any]:
    """Options of `jaxdrones.make` for --drones beside a run: the size of the team. They are removed from `settings`."""
    if is_user_policy(options.policy) or options.drones is None:
        return {}
    settings.pop("drones", None)
    return {"drones": options.drones}


def open_policy(
    policy: Path, task: str | None, realistic: bool | str, options: dict[str, Any], last: bool = False
) -> Any:
    """Open the run in a folder, the policy of a user's file, a bundled or a published one, with a common interface.

    A run and a bundled policy have their own task and options: for them `task` is `None`, `realistic` false and
    `options`, those of `jaxdrones.make`, are empty. `last` opens the newest policy of a run, not the best.
    """
    if is_user_policy(policy):
        if last:
            raise UserError(f"--last is given, and {policy} is no run, which has a newest policy; leave it out")
        if task is None:
            raise UserError(f"--task is missing; give the task for {policy}, for example --task hover")
        return UserPolicy(str(policy), task, realistic, options)
    given = {"--task": task, "--realistic": realistic, **{f"--set {name}": x for name, x in options.items()}}
    given["--vehicle"] = given.pop("--set vehicle", None)
    for name, x in given.items():
        if x not in (None, False):
            raise UserError(f"{name} is given beside the run {policy}, which determines it; leave it out")
    if not policy.exists() and not is_bundled(policy) and (close := hint(str(policy), assets.policies())):
        raise UserError(f"{policy}/best.json does not exist, and {policy} is not a bundled policy{close}")
    run = Run(assets.policies()[str(policy)] if is_bundled(policy) else policy)
    warn_of_code(run, "last" if last else "best")
    return run


def warn_of_code(run: Any, name: str) -> None:
    """Write to stderr that the recipe of a checkpoint of a run has code, before it is executed."""
    recipe = run.sidecar_entry(name, "recipe")
    names = recipe.get("files", ()) if isinstance(recipe, dict) else ()
    if code := " and ".join(name for name in names if is_reference(name)):
        said = f"jaxdrones: {run.folder} holds {code}, which is executed; open only runs that you trust"
        print(said, file=sys.stderr)
