"""Files of an exported policy."""

import contextlib
import dataclasses
import json
import os
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np

from jaxdrones import writing
from jaxdrones.arguments import checked, choice
from jaxdrones.checks import check_finite, short_repr
from jaxdrones.envs import Env, explain
from jaxdrones.errors import UserError
from jaxdrones.export import c, js, onnx, stablehlo
from jaxdrones.export.calls import program_of
from jaxdrones.export.layers import Tensor
from jaxdrones.export.network import layers_of
from jaxdrones.export.text import Description
from jaxdrones.learning.networks import Policy

TARGETS = ("c", "onnx", "stablehlo", "js")
"""Names of the targets."""


@dataclasses.dataclass(frozen=True)
class Exported:
    """Files of the policy of one drone, and what a call of it costs."""

    files: tuple[Path, ...]
    multiply_adds: int | None
    """Multiply-adds of one call; `None` for unknown layers."""
    flash: int | None
    """Bytes of the weights; `None` for unknown layers."""
    ram: int | None
    """Bytes of working memory and hidden state, for C and JavaScript."""


@checked
def save(
    policy: Any,
    env: Env,
    to: Annotated[str, choice("target", TARGETS)],
    folder: str | os.PathLike,
    name: str = "policy",
    title: str = "",
) -> list[Exported]:
    """Write the deterministic policy of a drone, with its normalization, for use without this library.

    Args:
        policy: policy of `jaxdrones.learning`; the drones of a team share one file, or with `per_agent` have one each.
        env: environment of the policy, which describes its inputs and outputs.
        to: `c`, `onnx`, `stablehlo` or `js`.
        folder: folder of the files; it is created.
        name: name of the files, and prefix of the names in C, where it has no capital letters.
        title: origin of the policy, for the descriptions; by default the name of the task.

    Returns:
        Result of each file, in the order of the drones.

    Raises:
        ValueError: an unknown target, a policy that it cannot express, numbers that are not finite, or a missing
            library.
        OSError: a file that cannot be written.
    """
    if not (name.isidentifier() and name.isascii() and name[0] != "_"):
        raise UserError(f"name is {name!r}; give a letter, then letters, digits and underscores")
    if to == "c" and name in c.INCLUDED:
        raise UserError(f"name is {name!r}, and the header includes <{name}.h>; give another name")
    if to == "c" and name != name.lower():
        raise UserError(
            f"name is {name!r}; give lower case letters, as names that differ in case have the same macros in C"
        )
    if not isinstance(policy, Policy):
        raise UserError(
            f"the policy is {short_repr(policy)}; give one of jaxdrones.learning (Policy), because the layers of a "
            "function are unknown, and `jax.export` saves any function"
        )
    check_finite("policy", policy)
    explanation = explain(env)
    sizes = policy.obs_stats.mean.size, policy.network.output_size
    if sizes != (env.observation_size, env.action_size):
        raise UserError(
            f"observations and actions of the policy have {sizes} numbers, those of {env.task.name} "
            f"{(env.observation_size, env.action_size)}; give the environment of the policy"
        )
    images = tuple(Tensor(x, space.shape, np.dtype(space.dtype).name) for x, space in sorted(env.image_spaces.items()))
    policies = [policy]
    if policy.per_agent:
        if (networks := len(jax.tree.leaves(policy.params)[0])) != env.drones:
            raise UserError(
                f"the policy has a network for each of {networks} drones, and {env.task.name} has {env.drones}; give "
                "the environment of the policy"
            )
        policies = [
            policy.replace(params=jax.tree.map(lambda x: x[i], policy.params), per_agent=False)  # noqa: B023
            for i in range(env.drones)
        ]
    folder, results = Path(folder), []
    for i, one in enumerate(policies):
        own_name = f"{name}_{i}" if policy.per_agent else name
        own_title = (title or env.task.name) + f", drone {i}" * policy.per_agent
        description = Description(own_title, explanation, env.dt)
        contents, description = _contents(to, one, images, description, own_name)
        folder.mkdir(parents=True, exist_ok=True)
        for file, content in contents.items():
            writing.write(folder / file, content)
        files = tuple(folder / file for file in contents)
        multiply_adds = None if description.graph is None else description.graph.multiply_adds
        results.append(Exported(files, multiply_adds, description.flash, description.ram))
    return results


def _contents(
    to: str, policy: Policy, images: tuple[Tensor, ...], description: Description, name: str
) -> tuple[dict[str, bytes], Description]:
    """Files of the policy of one drone, and its description with its costs."""
    if to == "stablehlo":
        with contextlib.suppress(UserError):  # unknown layers, whose costs are unknown too
            description = dataclasses.replace(description, graph=layers_of(policy, images))
        about = json.dumps(description.as_dict(), indent=2)
        return {f"{name}.stablehlo": stablehlo.program(policy, images), f"{name}.json": about.encode()}, description
    graph = layers_of(policy, images)
    description = dataclasses.replace(description, graph=graph)
    if to == "onnx":
        return {f"{name}.onnx": onnx.model(graph, description)}, description
    program = program_of(graph)
    description = dataclasses.replace(description, ram=program.ram)
    text = (c.header if to == "c" else js.module)(graph, program, description, name)
    return {f"{name}.{'h' if to == 'c' else 'js'}": text.encode()}, description
