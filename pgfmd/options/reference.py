"""The reference of the TOML file: every table and key with meaning, default and what is allowed, from the sections."""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Iterable

from pgfmd.options.rules import Rule
from pgfmd.options.section import Kinds, Section
from pgfmd.options.text import as_toml_value

WIDTH, COLUMN = 118, 34  # of a line; where comments begin


def reference(tables: Iterable[type[Section] | Kinds]) -> str:
    """A commented job with all tables.  Keys that may be left out are commented out and show their defaults."""
    return "\n".join(block for table in tables for block in _blocks(table))


def job_of_kind(tables: Iterable[type[Section] | Kinds], chosen: dict[str, type[Section]]) -> str:
    """The same with one section for each table, of the kinds `chosen` by table name, else the first or the default."""
    blocks = []
    for table in tables:
        kind = chosen.get(table.where) or (table.default or table.choices[0] if isinstance(table, Kinds) else table)
        blocks += _blocks(kind)
    return "\n".join(blocks)


def _blocks(table: type[Section] | Kinds) -> list[str]:
    """Each section of a table as text, the tables inside it after it."""
    if isinstance(table, Kinds):
        return [block for choice in table.choices for block in _blocks(choice)]
    head = (table.__doc__ or "").split("\n\n")[0]
    lines = _commented(f"[{table.where}]", " ".join(head.split()))
    inner: list[str] = []
    if table.kind:
        lines += [f"kind = {as_toml_value(table.kind)}"]
    for field in dataclasses.fields(table):
        rule = field.metadata["rule"]
        if isinstance(rule, Rule):
            lines += _key(field, rule)
        else:
            inner += _blocks(rule)
    return ["\n".join(lines) + "\n", *inner]


def _key(field: dataclasses.Field, rule: Rule) -> list[str]:
    """The lines of one key."""
    about, example = field.metadata["about"], field.metadata["example"]
    if field.metadata["needed"]:
        entry = f"{field.name} = {as_toml_value(example)}" if example is not None else f"{field.name} ="
    elif field.default is None:
        shown = f" {as_toml_value(example)}" if example is not None else ""
        entry = f"# {field.name} ={shown}"
    else:
        entry = f"# {field.name} = {as_toml_value(field.default)}"
    return _commented(entry, "; ".join(part for part in (about, rule.allowed) if part))


def _commented(entry: str, comment: str) -> list[str]:
    """An entry with its comment, wrapped into a column of its own."""
    wrapped = textwrap.wrap(comment, WIDTH - COLUMN - 2) or [""]
    lines = [f"{entry:<{COLUMN}}# {wrapped[0]}"] if len(entry) < COLUMN else [entry, f"{'':<{COLUMN}}# {wrapped[0]}"]
    return lines + [f"{'':<{COLUMN}}# {line}" for line in wrapped[1:]]
