"""Policies at the shell: of a run of `jaxdrones train`, or of a user's file."""

import sys
from pathlib import Path
from typing import Any

from jaxdrones.errors import UserError
from jaxdrones.user_code import is_reference


def is_user_policy(policy: Path) -> bool:
    """Whether this is a policy of a user's file, `file.py:name`, and no folder of a run."""
    return is_reference(str(policy))


def open_policy(
    policy: Path, task: str | None, realistic: bool | str, options: dict[str, Any], last: bool = False
) -> Any:
    """The run in a folder, or the policy of a user's file, of which the same can be asked.

    Args:
        policy: the folder of a run, or `file.py:name`.
        task: the task that a policy of a file flies; `None` for a run, which says it itself.
        realistic: that of `jaxdrones.make`; false for a run.
        options: options of `jaxdrones.make`; none for a run.
        last: whether the newest policy of a run is meant, not the best.

    Raises:
        ValueError: the task is missing, or something is given that the run says itself.
    """
    from jaxdrones.training.run import Run
    from jaxdrones.training.user_policy import UserPolicy

    if is_user_policy(policy):
        if task is None:
            raise UserError(f"--task is missing; say which task {policy} flies, for example --task hover")
        return UserPolicy(str(policy), task, realistic, options)
    given = {"--task": task, "--realistic": realistic, **{f"--set {name}": x for name, x in options.items()}}
    for name, x in given.items():
        if x not in (None, False):
            raise UserError(f"{name} is given beside the run {policy}, which says what is flown; leave it out")
    run = Run(policy)
    recipe = run.sidecar_entry("last" if last else "best", "recipe")
    names = recipe.get("files", ()) if isinstance(recipe, dict) else ()
    if code := " and ".join(name for name in names if is_reference(name)):
        print(f"jaxdrones: {policy} holds {code}, whose code is executed; open runs you trust alone", file=sys.stderr)
    return run
