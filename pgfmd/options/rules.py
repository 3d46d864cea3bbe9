"""A small declarative validator: each key of a section is a dataclass field that carries its rule.

A rule converts a TOML value and says in words what it allows, so that one line can name the key, the value and what is
allowed.  Sections validate themselves when they are made, from a file or from Python alike.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from pgfmd.errors import InputError


@dataclass(frozen=True)
class Rule:
    """What a value may be, in words, and how it is converted (`convert` raises ValueError where it may not)."""

    allowed: str
    convert: Callable[[Any], Any]


def integer(low: int, high: int = 2**63 - 1) -> Rule:
    """A whole number from `low` to `high`, not written as a float."""

    def convert(value):
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not low <= value <= high:
            raise ValueError
        return int(value)

    return Rule(f"a whole number ≥ {low}" if high == 2**63 - 1 else f"a whole number from {low} to {high}", convert)


def number(
    *,
    above: float = -math.inf,
    low: float = -math.inf,
    below: float = math.inf,
    high: float = math.inf,
    infinite: bool = False,
) -> Rule:
    """A real number within bounds (`above` and `below` exclude the bound); never NaN."""

    def convert(value):
        if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.integer, np.floating)):
            raise ValueError
        try:
            result = float(value)
        except OverflowError:
            raise ValueError from None
        if not (low <= result <= high and result > above and (result < below or infinite and result == below)):
            raise ValueError
        if math.isinf(result) and not infinite:
            raise ValueError
        return result

    bounds = [f"> {above:g}"] * (above > -math.inf) + [f"≥ {low:g}"] * (low > -math.inf)
    bounds += [f"< {below:g}"] * (below < math.inf) + [f"≤ {high:g}"] * (high < math.inf)
    return Rule(" ".join(["a number", " and ".join(bounds)]).strip() + (" (inf included)" if infinite else ""), convert)


def text() -> Rule:
    """A string that is not empty and can be encoded in UTF-8."""

    def convert(value):
        if not isinstance(value, str) or not value or "\0" in value:
            raise ValueError
        value.encode()  # UnicodeEncodeError, a ValueError, for bytes of a command line that are no UTF-8
        return value

    return Rule("a text in UTF-8, not empty", convert)


def flag() -> Rule:
    """true or false."""

    def convert(value):
        if not isinstance(value, (bool, np.bool_)):
            raise ValueError
        return bool(value)

    return Rule("true or false", convert)


def choice(*allowed) -> Rule:
    """One of the values given."""

    def convert(value):
        for candidate in allowed:
            if type(value) is type(candidate) and value == candidate:
                return candidate
        raise ValueError

    return Rule("one of " + ", ".join(show(value) for value in allowed), convert)


def many(rule: Rule, *, least: int = 0, distinct: bool = False) -> Rule:
    """A list whose entries obey `rule`; one bare value counts as a list of one.  Converted to a tuple."""

    def convert(value):
        values = tuple(rule.convert(entry) for entry in _entries(value))
        if len(values) < least or distinct and len(set(values)) < len(values):
            raise ValueError
        return values

    return Rule(
        "a list"
        + " that is not empty," * bool(least)
        + (" without repetition" if distinct else "")
        + f" of: {rule.allowed}",
        convert,
    )


def pair(rule: Rule) -> Rule:
    """One value for both directions, or a list of two, [x, y].  Converted to a tuple of two."""

    def convert(value):
        values = tuple(rule.convert(entry) for entry in _entries(value))
        if len(values) not in (1, 2):
            raise ValueError
        return values if len(values) == 2 else values * 2

    return Rule(f"{rule.allowed}, or two of them [x, y]", convert)


def _entries(value) -> list:
    return list(value) if isinstance(value, (list, tuple, np.ndarray)) else [value]


def key(rule: Rule | type[Section], default=None, *, only: tuple[str, ...] = (), needed: bool = False):
    """A dataclass field with its rule.

    `only`: the kinds of the section that know the key; `needed`: it has no default.  A default of None means that the
    key may be left out; in sections with kinds, a key of another kind is None.
    """
    metadata = {"rule": rule, "default": default, "only": only, "needed": needed}
    if isinstance(rule, type):
        return dataclasses.field(default_factory=rule, metadata=metadata)
    return dataclasses.field(default=None if only else default, metadata=metadata)


@dataclass(frozen=True, kw_only=True)
class Section:
    """A table of the TOML file.  Making one validates it; raises InputError."""

    where: ClassVar[str] = ""

    def __post_init__(self):
        kind = getattr(self, "kind", None)
        for field in dataclasses.fields(self):
            rule, only = field.metadata["rule"], field.metadata["only"]
            value = getattr(self, field.name)
            if only and kind not in only:
                if value is not None:
                    raise wrong(self, field.name, "belongs to kind = " + " or ".join(map(show, only)) + " only")
                continue
            if value is None:
                if field.metadata["needed"]:
                    raise InputError(f"{self.where}.{field.name} is missing: it must be {rule.allowed}")
                value = field.metadata["default"]
            if value is not None and isinstance(rule, Rule):
                try:
                    value = rule.convert(value)
                except ValueError:
                    raise wrong(self, field.name, f"must be {rule.allowed}") from None
            object.__setattr__(self, field.name, value)
        self.check()

    def check(self):
        """What several keys of this section must obey together; raises InputError."""


def wrong(section: Section, name: str, allowed: str) -> InputError:
    """The error for one key: where, its value, what is allowed."""
    return InputError(f"{section.where}.{name} = {show(getattr(section, name))}: {allowed}")


def build(kind: type[Section], table: Any) -> Section:
    """A section of the dataclass `kind` from a TOML table; raises InputError for unknown keys and wrong values."""
    if not isinstance(table, dict):
        raise InputError(f"{kind.where} = {show(table)}: must be a table, [{kind.where}]")
    fields = {field.name: field for field in dataclasses.fields(kind)}
    values = {}
    for name, value in table.items():
        if name not in fields:
            raise InputError(f"{kind.where}.{printable(name)} is not known{guess(name, list(fields))}")
        rule = fields[name].metadata["rule"]
        values[name] = build(rule, value) if isinstance(rule, type) else value
    return kind(**values)


def guess(name: str, allowed: list[str]) -> str:
    """The end of a message on an unknown name: the nearest known ones first."""
    near = difflib.get_close_matches(name, allowed, n=1)
    return (f"; did you mean {near[0]}?" if near else ".") + f" Allowed: {', '.join(allowed)}"


def printable(name: str, longest: int = 60) -> str:
    """Text without line breaks and control characters, cut to a readable length."""
    clean = "".join(letter if letter.isprintable() else "?" for letter in name)
    return clean if len(clean) <= longest else clean[: longest - 1] + "…"


def show(value) -> str:
    """A value as TOML writes it, on one line, cut to a readable length."""
    try:
        return printable(as_toml_value(value))
    except (TypeError, RecursionError):
        return printable(str(type(value).__name__))


def as_toml_value(value) -> str:
    """A TOML literal of a bool, number, text, list or table; raises TypeError for anything else."""
    if isinstance(value, (bool, np.bool_)):
        return "true" if value else "false"
    if isinstance(value, (int, np.integer)):
        return hex(value) if abs(value) >= 2**63 else str(int(value))  # hex: Python refuses to print huge decimals
    if isinstance(value, (float, np.floating)):
        return repr(float(value))
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, (list, tuple, np.ndarray)):
        return "[" + ", ".join(as_toml_value(entry) for entry in value) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{name} = {as_toml_value(entry)}" for name, entry in value.items()) + "}"
    raise TypeError(f"no TOML value: {type(value).__name__}")
