"""A formula and its derivative as one compiled loop: dual numbers on its syntax tree, each term computed once."""

from __future__ import annotations

import ast
import math
from functools import cache
from typing import Any

import numba
import numpy as np

from pgfmd.options import expressions
from pgfmd.physics.laws.exponential_law import exponential

_DERIVATIVES = {
    "exp": "{v}", "expm1": "{v} + 1.0", "log": "1.0 / {x}", "log1p": "1.0 / (1.0 + {x})", "sqrt": "0.5 / {v}",
    "sinh": "cosh({x})", "cosh": "sinh({x})", "tanh": "1.0 - {v} * {v}", "atan": "1.0 / (1.0 + {x} * {x})",
    "erf": "two_over_root_pi * exp(-{x} * {x})", "erfc": "-two_over_root_pi * exp(-{x} * {x})",
    "abs": "copysign(1.0, {x})",
}  # fmt: skip
_NAMES = expressions.NAMES | {
    "exp": exponential, "copysign": math.copysign, "two_over_root_pi": 2 / math.sqrt(math.pi),
    "inf": math.inf, "u": np.uintp,
}  # fmt: skip
_LOOP = """
def loop(x, scales, value, derivative):
    height, unit, offset = scales
    for i in range(x.size):
        gap = offset + height * x[u(i)]
        {lines}
        value[u(i)] = {value} / unit
        derivative[u(i)] = {derivative} * (height / unit)
"""

Dual = tuple[str, str]  # the names of a value and of its derivative, which is "0.0" for a constant


@cache
def compiled_pair(written: str) -> Any:
    """The loop over gaps x in other units, scales = (height, pressure, offset), that fills P and dP/dx; kept in this
    process only.  Raises ValueError for what is no formula of `gap`.
    """
    terms = _Terms()
    value, derivative = terms.dual(expressions.tree(written, "gap"))
    lines = "\n        ".join(f"{name} = {term}" for term, name in terms.names.items())
    made: dict[str, Any] = {}
    exec(_LOOP.format(lines=lines, value=value, derivative=derivative), dict(_NAMES), made)
    return numba.njit(nogil=True, error_model="numpy")(made["loop"])


class _Terms:
    """The terms of a formula so far, each with the name of the variable that holds it."""

    def __init__(self) -> None:
        self.names: dict[str, str] = {}

    def name(self, term: str) -> str:
        """The variable with that term."""
        return self.names.setdefault(term, f"v{len(self.names)}")

    def times(self, a: str, b: str) -> str:
        """a b."""
        if "0.0" in (a, b):
            return "0.0"
        return a if b == "1.0" else b if a == "1.0" else self.name(f"{a} * {b}")

    def plus(self, a: str, b: str) -> str:
        """a + b."""
        return a if b == "0.0" else b if a == "0.0" else self.name(f"{a} + {b}")

    def dual(self, node: ast.expr) -> Dual:
        """The value and the derivative of an expression."""
        match node:
            case ast.Constant():
                return repr(float(node.value)), "0.0"  # type: ignore[arg-type]
            case ast.Name():
                return node.id, "0.0" if node.id == "pi" else "1.0"
            case ast.UnaryOp():
                x, dx = self.dual(node.operand)
                return (self.times("-1.0", x), self.times("-1.0", dx)) if isinstance(node.op, ast.USub) else (x, dx)
            case ast.BinOp(op=ast.Pow()):
                return self.power(node.left, node.right)
            case ast.BinOp():
                return self.operation(node.op, *self.dual(node.left), *self.dual(node.right))
            case ast.Compare():
                signs = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">="}
                sides = [self.dual(side)[0] for side in (node.left, *node.comparators)]
                triples = zip(sides, node.ops, sides[1:], strict=False)
                holds = " and ".join(f"{a} {signs[type(op)]} {b}" for a, op, b in triples)
                return self.name(f"1.0 if {holds} else 0.0"), "0.0"
            case ast.IfExp():
                return self.choice(f"{self.dual(node.test)[0]} != 0", self.dual(node.body), self.dual(node.orelse))
            case ast.Call(func=ast.Name(id=called), args=arguments) if called in ("min", "max"):
                first, *others = map(self.dual, arguments)
                for other in others:
                    first = self.choice(f"{other[0]} {'<' if called == 'min' else '>'} {first[0]}", other, first)
                return first
            case ast.Call(func=ast.Name(id=called), args=[argument]):
                x, dx = self.dual(argument)
                v = self.name(f"{called}({x})")
                return v, self.times(dx, self.name(_DERIVATIVES[called].format(x=x, v=v))) if dx != "0.0" else dx
        raise ValueError

    def choice(self, condition: str, one: Dual, other: Dual) -> Dual:
        """One or the other; both are computed, so that the loop has no branch."""
        holds = self.name(condition)
        value, derivative = (
            a if a == b else self.name(f"{a} if {holds} else {b}") for a, b in zip(one, other, strict=True)
        )
        return value, derivative

    def operation(self, op: ast.operator, a: str, da: str, b: str, db: str) -> Dual:
        """a + b, a − b, a b or a/b."""
        match op:
            case ast.Add():
                return self.plus(a, b), self.plus(da, db)
            case ast.Sub():
                return self.name(f"{a} - {b}"), self.plus(da, self.times("-1.0", db))
            case ast.Mult():
                return self.times(a, b), self.plus(self.times(da, b), self.times(a, db))
        v = self.name(f"{a} / {b}")
        top = self.plus(da, self.times("-1.0", self.times(v, db)))
        return v, "0.0" if top == "0.0" else self.name(f"{top} / {b}")

    def product(self, a: str, n: int) -> str:
        """aⁿ for n ≥ 0, by squares."""
        if n == 0:
            return "1.0"
        half = self.product(a, n // 2)
        square = self.times(half, half)
        return self.times(square, a) if n % 2 else square

    def power(self, left: ast.expr, right: ast.expr) -> Dual:
        """aᵇ: a product where b is a whole number that `expressions` leaves one."""
        a, da = self.dual(left)
        match right:
            case ast.Constant(value=int(n)) if n > 0:
                less = self.product(a, n - 1)
                return self.times(less, a), self.times(self.times(repr(float(n)), less), da)
            case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int())):
                return self.operation(ast.Div(), "1.0", "0.0", *self.power(left, right.operand))
        b, db = self.dual(right)
        v = self.name(f"{a}**{b}")
        slope = self.times(da, self.times(b, self.name(f"{v} / {a}"))) if da != "0.0" else da  # NaN where a = 0
        return v, self.plus(slope, self.times(db, self.times(v, self.name(f"log({a})"))) if db != "0.0" else db)
