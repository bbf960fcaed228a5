"""Policies as an ES module in float32, for the browser and Node.js."""

import numpy as np

from jaxdrones.export.calls import Call, Program, Span
from jaxdrones.export.layers import Graph
from jaxdrones.export.text import Description, block_comment, numbers

_FUNCTIONS = {
    "f32": "const f32 = Math.fround;",
    "sigmoid": """
function sigmoid(x) {
  return f32(1 / f32(1 + f32(Math.exp(-x))));
}
""",
    "normalize": """
function normalize(n, x, mean, scale, clip, y) {
  for (let i = 0; i < n; ++i) {
    y[i] = Math.min(Math.max(f32(f32(f32(x[i]) - mean[i]) * scale[i]), -clip), clip);
  }
}
""",
    "dense": """
// y = x kernel + bias for each row of x, with a kernel of n rows and m columns.
function dense(rows, n, m, x, kernel, bias, y) {
  for (let row = 0, from = 0, to = 0; row < rows; ++row, from += n, to += m) {
    for (let j = 0; j < m; ++j) y[to + j] = bias ? bias[j] : 0;
    for (let i = 0; i < n; ++i) {
      for (let j = 0; j < m; ++j) y[to + j] += f32(x[from + i] * kernel[i * m + j]);
    }
  }
}
""",
    "convolution": """
// Kernels of stride x stride x c numbers, on an image of h x w pixels with margins of zeros.
function convolution(h, w, c, rows, columns, m, stride, top, left, x, kernel, bias, y) {
  for (let row = 0, at = 0; row < rows; ++row) {
    for (let column = 0; column < columns; ++column, at += m) {
      for (let j = 0; j < m; ++j) y[at + j] = bias[j];
      for (let k = 0; k < stride * stride * c; ++k) {
        const v = row * stride + Math.floor(k / (stride * c)) - top;
        const u = column * stride + Math.floor(k / c) % stride - left;
        if (v < 0 || v >= h || u < 0 || u >= w) continue;
        const pixel = x[(v * w + u) * c + k % c];
        for (let j = 0; j < m; ++j) y[at + j] += f32(pixel * kernel[k * m + j]);
      }
    }
  }
}
""",
    "gates": """
// Gated recurrent unit, with the gates reset, keep and new.
function gates(n, inputs, states, hidden) {
  for (let i = 0; i < n; ++i) {
    const reset = sigmoid(f32(inputs[i] + states[i]));
    const keep = sigmoid(f32(inputs[n + i] + states[n + i]));
    const value = f32(Math.tanh(f32(inputs[2 * n + i] + f32(reset * states[2 * n + i]))));
    hidden[i] = f32(keep * hidden[i]) + f32(f32(1 - keep) * value);
  }
}
""",
    "add_to_rows": """
function add_to_rows(rows, m, x, y) {
  for (let i = 0; i < rows * m; ++i) y[i] += x[i % m];
}
""",
    "sum_of_rows": """
// Sum of rows of m features, weighted by the length of the first three of n numbers: 0 from the reach on.
function sum_of_rows(rows, m, n, features, x, fade, inverseReach, small, y) {
  for (let j = 0; j < m; ++j) y[j] = 0;
  for (let row = 0; row < rows; ++row) {
    const [a, b, c] = x.subarray(row * n, row * n + 3);
    const away = f32(Math.sqrt(f32(a * a + b * b + c * c + small)));
    const weight = Math.min(Math.max(f32(fade * f32(1 - f32(away * inverseReach))), 0), 1);
    for (let j = 0; j < m; ++j) y[j] += f32(weight * features[row * m + j]);
  }
}
""",
    "nearness": """
// From depths, m, to numbers from 1 at the camera to 0 at infinity.
function nearness(n, x, depthScale, y) {
  for (let i = 0; i < n; ++i) y[i] = depthScale / f32(depthScale + Math.max(f32(x[i]), 0));
}
""",
    "color": """
function color(pixels, x, y) {
  for (let i = 0; i < pixels; ++i) {
    for (let j = 0; j < 3; ++j) y[3 * i + j] = x[4 * i + j] / 255;
  }
}
""",
    "copy": """
function copy(rows, n, stride, x, y) {
  for (let i = 0; i < rows; ++i) {
    for (let j = 0; j < n; ++j) y[i * stride + j] = x[i * n + j];
  }
}
""",
}
_ACTIVATIONS = {
    "tanh": "Math.tanh(y[i])",
    "relu": "Math.max(y[i], 0)",
    "elu": "y[i] > 0 ? y[i] : Math.expm1(y[i])",
    "silu": "y[i] * sigmoid(y[i])",
}
_FUNCTIONS |= {
    f"apply_{name}": f"function apply_{name}(n, y) {{\n  for (let i = 0; i < n; ++i) y[i] = {formula};\n}}"
    for name, formula in _ACTIVATIONS.items()
}


def module(graph: Graph, program: Program, description: Description, name: str = "policy") -> str:
    """ES module of a policy, with `step(obs, ...)`, and for a recurrent policy `initialHiddenState()`.

    `description`, the meaning of inputs and outputs, and the `name` of the file are in the comment at the top.
    """
    names = {"f32"} | {call.function for call in program.calls}
    names |= {"sigmoid"} if names & {"gates", "apply_silu"} else set()
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
        "\n\n".join(text.strip() for name, text in _FUNCTIONS.items() if name in names),
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
