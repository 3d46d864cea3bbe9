"""Formulas in a job: text with arithmetic and a few functions becomes a Python function, and no other code is run."""

import ast
import math
from collections.abc import Callable
from functools import cache
from typing import Any

from pgfmd.options.rules import Rule, text

FUNCTIONS = ("exp", "expm1", "log", "log1p", "sqrt", "sinh", "cosh", "tanh", "atan", "erf", "erfc")
NAMES = {name: getattr(math, name) for name in FUNCTIONS} | {"abs": abs, "min": min, "max": max, "pi": math.pi}
_ALLOWED = (
    ast.Expression, ast.BinOp, ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Pow, ast.UnaryOp, ast.USub, ast.UAdd,
    ast.Call, ast.Name, ast.Load, ast.Constant, ast.IfExp, ast.Compare, ast.Lt, ast.LtE, ast.Gt, ast.GtE,
)  # fmt: skip
LONGEST = 1000  # letters
MOST_FACTORS = 1000  # whole exponents up to this stay integers: compiled code multiplies in place of calling pow


def formula(variable: str) -> Rule:
    """A text that is a formula of one variable."""

    def convert(value: object) -> str:
        written = text().convert(value)
        function(written, variable)
        return written

    return Rule(f"a formula of {variable} with numbers, + - * / **, a if b < c else d, {', '.join(NAMES)}", convert)


@cache
def function(written: str, variable: str) -> Callable[[float], float]:
    """A formula as a function of one real number, for Python and numba; raises ValueError for what is no formula."""
    made = ast.parse(f"lambda {variable}: 0", mode="eval")
    made.body.body = tree(written, variable)  # type: ignore[attr-defined]
    try:
        return eval(compile(made, "<formula>", "eval"), dict(NAMES))
    except RecursionError:
        raise ValueError from None


def value(of: Callable[[float], float], at: float) -> float:
    """of(at) as compiled code gives it: infinite or NaN where Python raises an error or leaves the real numbers."""
    try:
        result = of(at)
        return float(result) if isinstance(result, int | float) else math.nan
    except (OverflowError, ZeroDivisionError):
        return math.inf
    except (ValueError, TypeError):
        return math.nan


def tree(written: str, variable: str) -> ast.expr:
    """The syntax tree; raises ValueError for what is no formula."""
    if len(written) > LONGEST:
        raise ValueError
    try:
        parsed = ast.parse(written.strip(), mode="eval")
    except (SyntaxError, RecursionError, MemoryError):
        raise ValueError from None
    called = {id(node.func) for node in ast.walk(parsed) if isinstance(node, ast.Call)}
    operations = [node for node in ast.walk(parsed) if isinstance(node, ast.BinOp)]
    exponents = {id(_unsigned(node.right)) for node in operations if isinstance(node.op, ast.Pow)}
    for node in ast.walk(parsed):
        if not _is_allowed(node, variable, id(node) in called):
            raise ValueError
        if isinstance(node, ast.Constant):
            node.value = _number(node.value, id(node) in exponents)
    return parsed.body


def _unsigned(node: ast.AST) -> ast.AST:
    """An operand without the signs before it."""
    while isinstance(node, ast.UnaryOp):
        node = node.operand
    return node


def _number(constant: Any, is_exponent: bool) -> int | float:
    """The constant as a float, so that powers overflow instead of growing without limit as Python's integers do; an
    exponent that is a whole number up to `MOST_FACTORS` stays one.  Raises ValueError beyond the largest float.
    """
    if is_exponent and isinstance(constant, int) and constant <= MOST_FACTORS:
        return constant
    try:
        return float(constant)
    except OverflowError:
        raise ValueError from None


def _is_allowed(node: ast.AST, variable: str, called: bool) -> bool:
    """Whether a formula may contain that: a name either stands for a number or is called."""
    if isinstance(node, ast.Name):
        return node.id == variable and not called or node.id in NAMES and called == callable(NAMES[node.id])
    if isinstance(node, ast.Constant):
        return type(node.value) in (int, float)
    if isinstance(node, ast.Call):
        many = isinstance(node.func, ast.Name) and node.func.id in ("min", "max")
        return not node.keywords and (len(node.args) >= 2 if many else len(node.args) == 1)
    return isinstance(node, _ALLOWED)
