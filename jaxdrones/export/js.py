"""Policies as an ES module in float32, for the browser and Node.js."""

import numpy as np

from jaxdrones.export.calls import Call, Program, Span
from jaxdrones.export.layers import Graph
from jaxdrones.export.text import Description, block_comment, functions, numbers


def module(graph: Graph, program: Program, description: Description, name: str = "policy") -> str:
    """ES module of a policy, with `step(obs, ...)`, and for a recurrent policy `initialHiddenState()`.

    `description`, the meaning of inputs and outputs, and the `name` of the file are in the comment at the top.
    """
    names = {"f32"} | {call.function for call in program.calls}
    spans = {x: _view(x) for call in program.calls for x in call.arguments if isinstance(x, Span) and x.array == "work"}
    parts = [
        block_comment([*description.lines(), "", *_usage(graph, name)]),
        "\n".join(f"const {key} = new Float32Array([\n{numbers(x)}\n]);" for key, x in program.constants.items()),
        "\n".join(
            [
                f"const work = new Float32Array({program.work_size});",
                *(f"const {name} = work.subarray({span.start});" for span, name in spans.items()),
            ]
        ),
        "\n\n".join(functions("functions.js", names)),
        *([_initial_hidden_state(graph.hidden_size)] if graph.hidden_size else []),
        _step(graph, program),
    ]
    return "\n\n".join(parts) + "\n"


def _usage(graph: Graph, name: str) -> list[str]:
    names = ["step", *(["initialHiddenState"] if graph.hidden_size else [])]
    hidden = ["const hidden = initialHiddenState(); // before each flight"] if graph.hidden_size else []
    lines = [
        f'import {{ {", ".join(names)} }} from "./{name}.js";',
        *hidden,
        f"const act = step({', '.join(graph.arguments)});",
    ]
    return ["To use it:", "", *(f"    {line}" for line in lines)]


def _initial_hidden_state(size: int) -> str:
    return f"""// Hidden state at the start of a flight.
export function initialHiddenState() {{
  return new Float32Array({size});
}}"""


def _step(graph: Graph, program: Program) -> str:
    checks = [
        f"if ({name}.length !== {x.size}) throw new RangeError(`{name} has ${{{name}.length}} numbers, not {x.size}`);"
        for name, x in zip(graph.arguments, graph.inputs, strict=True)
    ]
    lines = [
        *checks,
        f"const act = new Float32Array({graph.action.size});",
        *(_text(call) for call in program.calls),
        "return act;",
    ]
    about = "// Action of an observation" + ("; updates the hidden state." if graph.hidden_size else ".")
    body = "\n".join(f"  {line}" for line in lines)
    return f"{about}\nexport function step({', '.join(graph.arguments)}) {{\n{body}\n}}"


def _view(span: Span) -> str:
    return f"work_{span.start}"


def _text(call: Call) -> str:
    def argument(x: int | float | str | Span | None) -> str:
        match x:
            case Span("work"):
                return _view(x)
            case Span(array, start):
                return f"{array}.subarray({start})" if start else array
            case None:
                return "null"
            case float():
                return str(float(np.float32(x)))
        return str(x)

    return f"{call.function}({', '.join(map(argument, call.arguments))});"
