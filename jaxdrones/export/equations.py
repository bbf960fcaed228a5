"""Any traceable function as JavaScript: its equations, one operation after the other, in double precision.

CasADi removes common subexpressions and operations with constants of the traced program, see `optimal.interpreter`.
"""

import re
from collections.abc import Callable
from typing import Any

from jaxdrones.optimal.interpreter import on_symbols
from jaxdrones.optimal.primitives import casadi

_OPERATIONS = {
    "ADD": "{} + {}",
    "SUB": "{} - {}",
    "MUL": "{} * {}",
    "DIV": "{} / {}",
    "NEG": "-{}",
    "SQ": "{0} * {0}",
    "TWICE": "2 * {}",
    "INV": "1 / {}",
    "LT": "+({} < {})",
    "LE": "+({} <= {})",
    "EQ": "+({} === {})",
    "NE": "+({} !== {})",
    "NOT": "+!{}",
    "AND": "+({} && {} ? 1 : 0)",
    "OR": "+({} || {} ? 1 : 0)",
    "IF_ELSE_ZERO": "{} ? {} : 0",
    "FMIN": "Math.min({}, {})",
    "FMAX": "Math.max({}, {})",
    "FABS": "Math.abs({})",
    "POW": "Math.pow({}, {})",
    "CONSTPOW": "Math.pow({}, {})",
    "ATAN2": "Math.atan2({}, {})",
    "ASSIGN": "{}",
} | {
    name: f"Math.{name.lower()}({{}})"
    for name in "SQRT SIN COS TAN ASIN ACOS ATAN SINH COSH TANH EXP LOG LOG1P EXPM1 FLOOR CEIL SIGN".split()
}
"""Names of CasADi's operations, without `OP_` -> JavaScript."""
_CODES = {getattr(casadi, f"OP_{name}"): text for name, text in _OPERATIONS.items()}

_NOT_FINITE = {"inf": "Infinity", "-inf": "-Infinity", "nan": "NaN"}


def javascript(name: str, function: Callable, **arguments: Any) -> str:
    """Text of a JavaScript function of arrays of numbers for a traceable function of pytrees of arrays.

    Of the `arguments`, examples in order and by name, only the shapes are used.

    Returns:
        `function name(out, ...)`: writes the entries of the result into the array `out`, leaf after leaf. Each of
        the arguments is the array of the entries of a pytree, in the same order.

    Raises:
        NotImplementedError: an operation without a counterpart.
    """
    symbols, result = on_symbols(function, **arguments)
    program = casadi.Function("f", symbols, [result])
    names = list(arguments)
    lines = [_line(program, k, names) for k in range(program.n_instructions())]
    used = sorted({int(k) for line in lines for k in re.findall(r"\bw(\d+)", line)})
    declared = f"  let {', '.join(f'w{k}' for k in used)};\n" if used else ""
    body = "".join(f"  {line};\n" for line in lines)
    return f"function {name}({', '.join(['out', *names])}) {{\n{declared}{body}}}"


def _line(program: Any, k: int, names: list[str]) -> str:
    code, inputs, outputs = program.instruction_id(k), program.instruction_input(k), program.instruction_output(k)
    if code == casadi.OP_CONST:
        constant = repr(program.instruction_constant(k))
        return f"w{outputs[0]} = {_NOT_FINITE.get(constant, constant)}"
    if code == casadi.OP_INPUT:
        return f"w{outputs[0]} = {names[inputs[0]]}[{inputs[1]}]"
    if code == casadi.OP_OUTPUT:
        return f"out[{outputs[1]}] = w{inputs[0]}"
    if code not in _CODES:
        names_of_codes = {getattr(casadi, x): x for x in dir(casadi) if x.startswith("OP_")}
        raise NotImplementedError(
            f"the operation {names_of_codes[code]} of CasADi has no counterpart in JavaScript here"
        )
    return f"w{outputs[0]} = {_CODES[code].format(*(f'w{i}' for i in inputs))}"
