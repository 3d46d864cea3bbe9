"""The reference of the TOML file: every table and key with meaning, default and what is allowed, from the sections."""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Iterable

from pgfmd.errors import InputError
from pgfmd.options.rules import Rule
from pgfmd.options.section import Kinds, Section
from pgfmd.options.text import as_toml_value, guess

WIDTH, COLUMN = 118, 34  # of a line; where comments begin
UNITS = """\
# The unit of a number stands in brackets. [length] and [pressure] are yours: any consistent set, such as m and Pa.
# [grid spacings] are the shorter ones, where those along x and y differ; [1] is a pure number.
"""
PLUGINS = """\
# plugins = ["my_law.py"]         # Python files with laws, solids, surfaces or observables of your own, relative to the
                                  # job's folder. Their code runs: use only files that you trust. Above all tables.
"""
Tables = Iterable[type[Section] | Kinds]


def reference(tables: Tables) -> str:
    """A commented job with every table of every kind.  Keys that may be left out are commented out, unless `shown`."""
    return "\n".join([UNITS + PLUGINS, *(block for table in tables for block in _blocks(table))])


def example(tables: Tables, *kinds: str) -> str:
    """A commented job that is valid: each table once.  Its kind is one of `kinds`, else its default, else its first.

    Raises InputError for a kind that no table has.
    """
    tables = list(tables)
    known = [choice.kind for table in tables if isinstance(table, Kinds) for choice in table.choices]
    for kind in kinds:
        if kind not in known:
            raise InputError(f"kind {kind!r} is not known{guess(kind, list(dict.fromkeys(known)))}")
    return "\n".join([UNITS, *(block for table in tables for block in _blocks(_chosen(table, kinds)))])


def _chosen(table: type[Section] | Kinds, kinds: tuple[str, ...]) -> type[Section]:
    if not isinstance(table, Kinds):
        return table
    return next((choice for choice in table.choices if choice.kind in kinds), table.default or table.choices[0])


def _blocks(table: type[Section] | Kinds) -> list[str]:
    """Each section of a table as text, the tables inside it after it."""
    if isinstance(table, Kinds):
        return [block for choice in table.choices for block in _blocks(choice)]
    lines = _commented(f"[{table.where}]", " ".join((table.__doc__ or "").split("\n\n")[0].split()))
    inner: list[str] = []
    if table.kind:
        lines.append(f"kind = {as_toml_value(table.kind)}")
    for field in dataclasses.fields(table):
        rule = field.metadata["rule"]
        if isinstance(rule, Rule):
            comment = f"{_in_brackets(field.metadata['unit'])}{field.metadata['about']} | {rule.allowed}"
            lines += _commented(_entry(field, field.name in table.shown), comment)
        else:
            inner += _blocks(rule)
    return ["\n".join(lines) + "\n", *inner]


def _entry(field: dataclasses.Field, shown: bool) -> str:
    """The line of one key: its example if it is needed or shown; else, commented out, its default (its example if the
    default is None).
    """
    example = field.metadata["example"]
    value = example if field.default is None else field.default
    if field.metadata["needed"] or shown:
        return f"{field.name} = {as_toml_value(example)}"
    return f"# {field.name} =" + ("" if value is None else f" {as_toml_value(value)}")


def _in_brackets(unit: str) -> str:
    return f"[{unit}] " if unit else ""


def _commented(entry: str, comment: str) -> list[str]:
    """An entry with its comment, wrapped into a column of its own."""
    wrapped = [f"{'':<{COLUMN}}# {line}" for line in textwrap.wrap(comment, WIDTH - COLUMN - 2)]
    if not wrapped or len(entry) >= COLUMN:
        return [entry, *wrapped]
    return [entry + wrapped[0][len(entry) :], *wrapped[1:]]
