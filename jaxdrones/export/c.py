"""Policies as a C99 header without memory allocation, for a flight controller."""

from jaxdrones.export.calls import Call, Program, Span
from jaxdrones.export.layers import Graph, Tensor
from jaxdrones.export.text import Description, block_comment, number, numbers

INCLUDED = ("math", "stddef", "stdint")
"""Names of included headers."""
_FUNCTIONS = {
    "sigmoid": """
static inline float NAME_sigmoid(float x)
{
    return 1.0f / (1.0f + expf(-x));
}
""",
    "normalize": """
static inline void NAME_normalize(int n, const float x[], const float mean[], const float scale[], float clip,
                                  float y[])
{
    for (int i = 0; i < n; ++i) {
        const float z = (x[i] - mean[i]) * scale[i];
        y[i] = z < -clip ? -clip : z > clip ? clip : z;
    }
}
""",
    "dense": """
/* y = x kernel + bias for each row of x, with a kernel of n rows and m columns. */
static inline void NAME_dense(int rows, int n, int m, const float x[], const float kernel[], const float bias[],
                              float y[])
{
    for (int row = 0; row < rows; ++row, x += n, y += m) {
        for (int j = 0; j < m; ++j)
            y[j] = bias ? bias[j] : 0.0f;
        for (int i = 0; i < n; ++i)
            for (int j = 0; j < m; ++j)
                y[j] += x[i] * kernel[i * m + j];
    }
}
""",
    "convolution": """
/* Kernels of stride x stride x c numbers, on an image of h x w pixels with margins of zeros. */
static inline void NAME_convolution(int h, int w, int c, int rows, int columns, int m, int stride, int top, int left,
                                    const float x[], const float kernel[], const float bias[], float y[])
{
    for (int row = 0; row < rows; ++row)
        for (int column = 0; column < columns; ++column, y += m) {
            for (int j = 0; j < m; ++j)
                y[j] = bias[j];
            for (int k = 0; k < stride * stride * c; ++k) {
                const int v = row * stride + k / (stride * c) - top;
                const int u = column * stride + k / c % stride - left;
                if (v < 0 || v >= h || u < 0 || u >= w)
                    continue;
                for (int j = 0; j < m; ++j)
                    y[j] += x[(v * w + u) * c + k % c] * kernel[k * m + j];
            }
        }
}
""",
    "gates": """
/* Gated recurrent unit, with the gates reset, keep and new. */
static inline void NAME_gates(int n, const float inputs[], const float states[], float hidden[])
{
    for (int i = 0; i < n; ++i) {
        const float reset = NAME_sigmoid(inputs[i] + states[i]);
        const float keep = NAME_sigmoid(inputs[n + i] + states[n + i]);
        const float new_value = tanhf(inputs[2 * n + i] + reset * states[2 * n + i]);
        hidden[i] = keep * hidden[i] + (1.0f - keep) * new_value;
    }
}
""",
    "add_to_rows": """
static inline void NAME_add_to_rows(int rows, int m, const float x[], float y[])
{
    for (int i = 0; i < rows * m; ++i)
        y[i] += x[i % m];
}
""",
    "sum_of_rows": """
/* Sum of rows of m features, weighted by the length of the first three of n numbers: 0 from the reach on. */
static inline void NAME_sum_of_rows(int rows, int m, int n, const float features[], const float x[], float fade,
                                    float inverse_reach, float small, float y[])
{
    for (int j = 0; j < m; ++j)
        y[j] = 0.0f;
    for (int row = 0; row < rows; ++row, features += m, x += n) {
        const float away = sqrtf(x[0] * x[0] + x[1] * x[1] + x[2] * x[2] + small);
        const float nearness = fade * (1.0f - away * inverse_reach);
        const float weight = nearness < 0.0f ? 0.0f : nearness > 1.0f ? 1.0f : nearness;
        for (int j = 0; j < m; ++j)
            y[j] += weight * features[j];
    }
}
""",
    "nearness": """
/* From depths, m, to numbers from 1 at the camera to 0 at infinity. */
static inline void NAME_nearness(int n, const float x[], float depth_scale, float y[])
{
    for (int i = 0; i < n; ++i)
        y[i] = depth_scale / (depth_scale + (x[i] < 0.0f ? 0.0f : x[i]));
}
""",
    "color": """
static inline void NAME_color(int pixels, const uint8_t x[], float y[])
{
    for (int i = 0; i < pixels; ++i)
        for (int j = 0; j < 3; ++j)
            y[3 * i + j] = (float)x[4 * i + j] / 255.0f;
}
""",
    "copy": """
static inline void NAME_copy(int rows, int n, int stride, const float x[], float y[])
{
    for (int i = 0; i < rows; ++i)
        for (int j = 0; j < n; ++j)
            y[i * stride + j] = x[i * n + j];
}
""",
}
_ACTIVATIONS = {
    "tanh": "tanhf(y[i])",
    "relu": "y[i] < 0.0f ? 0.0f : y[i]",
    "elu": "y[i] > 0.0f ? y[i] : expm1f(y[i])",
    "silu": "y[i] * NAME_sigmoid(y[i])",
}
_FUNCTIONS |= {
    f"apply_{name}": f"""
static inline void NAME_apply_{name}(int n, float y[])
{{
    for (int i = 0; i < n; ++i)
        y[i] = {formula};
}}
"""
    for name, formula in _ACTIVATIONS.items()
}


def header(graph: Graph, program: Program, description: Description, name: str = "policy") -> str:
    """C99 header of a policy: its weights, `NAME_step(obs, ..., act)`, and for a recurrent policy `NAME_reset`.

    `name` is the prefix of all names; `description`, the meaning of inputs and outputs, is the comment at the top.
    """
    upper = name.upper()
    used = {call.function for call in program.calls}
    used |= {"sigmoid"} if used & {"gates", "apply_silu"} else set()
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
        "\n\n".join(text.strip().replace("NAME", name) for key, text in _FUNCTIONS.items() if key in used),
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
