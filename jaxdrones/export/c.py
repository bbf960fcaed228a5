"""Policies as a C99 header without memory allocation, for a flight controller."""

from jaxdrones.export.calls import Call, Program, Span
from jaxdrones.export.layers import Graph, Tensor
from jaxdrones.export.text import Description, block_comment, functions, number, numbers

INCLUDED = ("math", "stddef", "stdint")
"""Names of included headers."""


def header(graph: Graph, program: Program, description: Description, name: str = "policy") -> str:
    """C99 header of a policy: its weights, `NAME_step(obs, ..., act)`, and for a recurrent policy `NAME_reset`.

    `name` is the prefix of all names; `description`, the meaning of inputs and outputs, is the comment at the top.
    """
    upper = name.upper()
    used = {call.function for call in program.calls}
    sizes = {f"{x.name.upper()}_SIZE": x.size for x in graph.inputs if x.name != "hidden_state"}
    sizes |= {"ACT_SIZE": graph.action.size} | ({"HIDDEN_SIZE": graph.hidden_size} if graph.hidden_size else {})
    constants = [
        f"static const float {name}_{key}[{x.size}] = {{\n{numbers(x, 'f')}\n}};"
        for key, x in program.constants.items()
    ]
    includes = ["math.h", "stddef.h"] + ["stdint.h"] * any(x.dtype == "uint8" for x in graph.inputs)
    parts = [
        block_comment([*description.lines(), "", *_usage(graph, name)]),
        f"#ifndef {upper}_H\n#define {upper}_H",
        "\n".join(f"#include <{file}>" for file in includes),
        "\n".join(f"#define {upper}_{key} {size}" for key, size in sizes.items()),
        "\n\n".join(constants),
        "\n\n".join(functions("functions.c", used)).replace("NAME", name),
        *([_reset(name)] if graph.hidden_size else []),
        _step(graph, program, name),
        f"#endif /* {upper}_H */",
    ]
    return "\n\n".join(parts) + "\n"


def _usage(graph: Graph, name: str) -> list[str]:
    lines = [f"float act[{name.upper()}_ACT_SIZE];", f"{name}_step({', '.join([*graph.arguments, 'act'])});"]
    if graph.hidden_size:
        hidden = [f"float hidden[{name.upper()}_HIDDEN_SIZE];", f"{name}_reset(hidden); /* before each flight */"]
        lines = [*hidden, *lines]
    return ["To use it, link with -lm:", "", *(f"    {line}" for line in lines)]


def _reset(name: str) -> str:
    return f"""/* Hidden state at the start of a flight. */
static inline void {name}_reset(float hidden[{name.upper()}_HIDDEN_SIZE])
{{
    for (int i = 0; i < {name.upper()}_HIDDEN_SIZE; ++i)
        hidden[i] = 0.0f;
}}"""


def _step(graph: Graph, program: Program, name: str) -> str:
    parameters = [_parameter(x, name) for x in graph.inputs] + [f"float act[{name.upper()}_ACT_SIZE]"]
    lines = [f"float work[{program.work_size}];", "", *(_text(call, name) for call in program.calls)]
    body = "\n".join(f"    {line}".rstrip() for line in lines)
    return f"/* Action of an observation. */\nstatic inline void {name}_step({', '.join(parameters)})\n{{\n{body}\n}}"


def _parameter(x: Tensor, name: str) -> str:
    if x.name == "hidden_state":
        return f"float hidden[{name.upper()}_HIDDEN_SIZE]"
    kind = "uint8_t" if x.dtype == "uint8" else "float"
    return f"const {kind} {x.name}[{name.upper()}_{x.name.upper()}_SIZE]"


def _text(call: Call, name: str) -> str:
    def argument(x: int | float | str | Span | None) -> str:
        match x:
            case Span(array, start):
                return f"{array} + {start}" if start else array
            case None:
                return "NULL"
            case float():
                return f"{number(x)}f"
            case str():
                return f"{name}_{x}"
        return str(x)

    return f"{name}_{call.function}({', '.join(map(argument, call.arguments))});"
