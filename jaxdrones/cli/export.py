"""`jaxdrones export`."""

import argparse

from jaxdrones.arguments import choice
from jaxdrones.cli.common import run_folder
from jaxdrones.cli.options import Once, add_drones, add_output, option, switch
from jaxdrones.cli.policies import add_policy, is_user_policy, open_policy, output_folder, policy_of
from jaxdrones.cli.report import print_results
from jaxdrones.cli.settings import given_settings
from jaxdrones.errors import UserError
from jaxdrones.export import TARGETS, save


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "export",
        help="write a trained policy as C, ONNX, StableHLO or JavaScript",
        description="Write the best policy of a run, with its normalization, for use without jaxdrones: a C99 header "
        "for a flight controller, an ONNX model, a program of jax.export, or an ES module. Each describes its inputs "
        "and outputs: order, unit, frame and range.",
    )
    add_drones(add_policy(parser))
    option(parser, "--to TARGET", "{}", check=choice("target", TARGETS), known=TARGETS, required=True, action=Once)
    add_output(parser, "folder of the files (RUN/export, or runs/TASK/export for a policy of your own)")
    parser.add_argument("--name", default="policy", help="name of the files, and prefix of the names in C (policy)")
    switch(parser, "--last", "export the newest policy instead of the best")
    parser.set_defaults(run=_export)


def _export(options: argparse.Namespace) -> int:
    own = is_user_policy(options.policy)
    if options.drones is not None and not own:
        raise UserError(f"--drones is given beside the run {options.policy}, which determines it; leave it out")
    run = open_policy(options.policy, options.task, options.realistic, given_settings(options), options.last)
    recipe, title, make_policy, _ = policy_of(run, options)
    place = run_folder(options.task, "/export") if own else output_folder(options.policy, "export")
    with recipe.env() as env:
        exported = save(make_policy(env), env, options.to, options.output or place, options.name, title)
    files = [vars(x) | {"files": [*map(str, x.files)]} for x in exported]
    lines = [title]
    for one in exported:
        lines.append(f"  wrote {', '.join(map(str, one.files))}")
        costs = {"multiply-adds": one.multiply_adds, "bytes of weights (flash)": one.flash, "bytes of RAM": one.ram}
        if shown := [f"{x:,} {what}" for what, x in costs.items() if x is not None]:
            lines.append(f"    one call: {', '.join(shown)}")
    results = {"policy": str(options.policy), "to": options.to, "title": title, "exported": files}
    print_results(options, results, *lines)
    return 0
