"""Rules for one value: each converts a TOML value and says in words what it allows."""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pgfmd.errors import InputError
from pgfmd.options.text import show

MOST_SEEDS = 10**6  # of an ensemble
SEEDS = {
    "anyOf": [
        {"type": "integer", "minimum": 0},
        {"type": "array", "items": {"type": "integer", "minimum": 0}, "minItems": 1, "uniqueItems": True},
        {"type": "string", "pattern": r"^\s*\d+\s*\.\.\s*\d+\s*$"},
    ]
}


@dataclass(frozen=True)
class Rule:
    """Which values are allowed, in words and as JSON Schema; `convert` raises ValueError for any other value."""

    allowed: str
    convert: Callable[[Any], Any]
    schema: Mapping[str, Any] = field(default_factory=dict)


def checked(name: str, value: object, rule: Rule) -> Any:
    """The value of a key or an argument as its rule converts it; raises InputError."""
    try:
        return rule.convert(value)
    except (TypeError, ValueError):
        raise InputError(f"{name} = {show(value)}: must be {rule.allowed}") from None


def integer(low: int, high: int = 2**63 - 1) -> Rule:
    """A whole number from `low` to `high`, not written as a float."""

    def convert(value: Any) -> Any:
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not low <= value <= high:
            raise ValueError
        return int(value)

    words = f"a whole number ≥ {low}" if high == 2**63 - 1 else f"a whole number from {low} to {high}"
    return Rule(words, convert, {"type": "integer", "minimum": low, "maximum": high})


def seeds() -> Rule:
    """A seed; or for an ensemble several, as a list or as text "first..last", converted to a tuple."""
    one = integer(0)
    several = many(one, least=1, distinct=True)

    def convert(value: Any) -> Any:
        if isinstance(value, str):
            first, last = (one.convert(int(end)) for end in value.split(".."))  # ValueError for any other text
            if not first <= last < first + MOST_SEEDS:
                raise ValueError
            return tuple(range(first, last + 1))
        return several.convert(value) if isinstance(value, (list, tuple, np.ndarray)) else one.convert(value)

    several_in_words = f'a list of them without repetition, or "first..last", at most {MOST_SEEDS} of them'
    return Rule(f"a whole number ≥ 0, or for an ensemble {several_in_words}", convert, SEEDS)


def number(
    *,
    above: float = -math.inf,
    low: float = -math.inf,
    below: float = math.inf,
    high: float = math.inf,
    infinite: bool = False,
) -> Rule:
    """A real number within bounds (`above` and `below` exclude the bound); never NaN."""

    def convert(value: Any) -> Any:
        if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.integer, np.floating)):
            raise ValueError
        try:
            result = float(value)
        except OverflowError:
            raise ValueError from None
        if math.isinf(result) and not infinite:
            raise ValueError
        if not (low <= result <= high and above < result and (result < below or below == math.inf)):
            raise ValueError
        return result

    bounds = [f"> {above:g}"] * (above > -math.inf) + [f"≥ {low:g}"] * (low > -math.inf)
    bounds += [f"< {below:g}"] * (below < math.inf) + [f"≤ {high:g}"] * (high < math.inf)
    limits = {"exclusiveMinimum": above, "minimum": low, "exclusiveMaximum": below, "maximum": high}
    schema = {"type": "number"} | {name: limit for name, limit in limits.items() if math.isfinite(limit)}
    words = " ".join(["a number", " and ".join(bounds)]).strip() + (" (inf included)" if infinite else "")
    return Rule(words, convert, schema)


POSITIVE = number(above=0)


def text() -> Rule:
    """A string that is not empty and can be encoded in UTF-8."""

    def convert(value: Any) -> Any:
        if not isinstance(value, str) or not value or "\0" in value:
            raise ValueError
        value.encode()  # UnicodeEncodeError, a ValueError, for bytes of a command line that are no UTF-8
        return value

    return Rule("a text in UTF-8, not empty", convert, {"type": "string", "minLength": 1})


def assignment() -> Rule:
    """A text "name=value", short enough for any MPI library."""

    def convert(value: Any) -> Any:
        if not isinstance(value, str) or not re.fullmatch(r"[\w.-]{1,32}=[!-~]{1,255}", value, re.ASCII):
            raise ValueError
        return value

    return Rule('a text "name=value" without spaces', convert, {"type": "string", "pattern": "^[^=]+="})


def flag() -> Rule:
    """true or false."""

    def convert(value: Any) -> Any:
        if not isinstance(value, (bool, np.bool_)):
            raise ValueError
        return bool(value)

    return Rule("true or false", convert, {"type": "boolean"})


def choice(*allowed: Any) -> Rule:
    """One of the values given."""

    def convert(value: Any) -> Any:
        for candidate in allowed:
            if type(value) is type(candidate) and value == candidate:
                return candidate
        raise ValueError

    return Rule("one of " + ", ".join(show(value) for value in allowed), convert, {"enum": list(allowed)})


def many(rule: Rule, *, least: int = 0, distinct: bool = False) -> Rule:
    """A list whose entries obey `rule`; one bare value counts as a list of one, also an array without axes.  Converted
    to a tuple.
    """

    def convert(value: Any) -> Any:
        several = isinstance(value, (list, tuple)) or isinstance(value, np.ndarray) and value.ndim > 0
        values = tuple(map(rule.convert, value if several else [value]))
        if len(values) < least or distinct and len(set(values)) < len(values):
            raise ValueError
        return values

    kind = ["a list of them", "not empty" * bool(least), "without repetition" * distinct]
    items = {"type": "array", "items": rule.schema, "minItems": least, "uniqueItems": distinct}
    return Rule(f"{rule.allowed}; or {', '.join(filter(None, kind))}", convert, {"anyOf": [rule.schema, items]})


def pair(rule: Rule) -> Rule:
    """One value for both directions, or a list of two, [x, y].  Converted to a tuple of two."""
    several = many(rule)

    def convert(value: Any) -> Any:
        values = several.convert(value)
        x, y = values * 2 if len(values) == 1 else values  # ValueError for any other number
        return x, y

    two = {"type": "array", "items": rule.schema, "minItems": 1, "maxItems": 2}
    return Rule(f"{rule.allowed}, or two of them [x, y]", convert, {"anyOf": [rule.schema, two]})


def interval() -> Rule:
    """A list of two numbers, converted to a tuple."""
    several = many(number())

    def convert(value: Any) -> Any:
        low, high = several.convert(value)
        if not low < high:
            raise ValueError
        return low, high

    ends = {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2}
    return Rule("a number and a larger one, [a, b]", convert, ends)
