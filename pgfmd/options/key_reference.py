"""The reference of the TOML file: every table and key with meaning, default and what is allowed, from the sections."""

import dataclasses
import json
import textwrap
from collections.abc import Iterable

from pgfmd.errors import InputError
from pgfmd.options.rules import Rule
from pgfmd.options.section import Kinds, Section
from pgfmd.options.text import as_toml_value, guess

WIDTH, COLUMN = 118, 34  # of a line; where comments begin
UNITS = """\
# The unit of a number stands in brackets. [length] and [pressure] are yours: any consistent set, such as m and Pa.
# [grid spacings] are the shorter ones, where those along x and y differ; [1] is a pure number; [pressure*length] is an
# energy per area, [pressure*length^2] a force; [conductivity] may have any unit, which is then that of the conductance.
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


def json_schema(tables: Tables) -> str:
    """The JSON Schema of a job, by which editors complete and check it (https://json-schema.org, draft 2020-12)."""
    properties: dict[str, object] = {table.where: _schema(table) for table in tables}
    properties["plugins"] = {"type": "array", "items": {"type": "string"}, "description": "Python files of your own"}
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "A job of pgfmd", "type": "object"}
    return json.dumps(head | {"properties": properties, "additionalProperties": False}, ensure_ascii=False, indent=1)


def _schema(table: type[Section] | Kinds) -> dict[str, object]:
    if isinstance(table, Kinds):
        return {"anyOf": [_of_kind(choice, table.default is None) for choice in table.choices]}
    return _of_kind(table, False)


def _of_kind(section: type[Section], named: bool) -> dict[str, object]:
    """The schema of a section; named: the table must say its kind.  [grid] requires no key: a file may give it."""
    properties: dict[str, object] = {"kind": {"const": section.kind}} if section.kind else {}
    for field in dataclasses.fields(section):
        rule = field.metadata["rule"]
        is_table = not isinstance(rule, Rule)
        properties[field.name] = _schema(rule) if is_table else {**rule.schema, "description": _meaning(field)}
    needed = [field.name for field in dataclasses.fields(section) if field.metadata["needed"] and section.kind]
    return {
        "type": "object",
        "description": _first_paragraph(section),
        "properties": properties,
        "required": needed + ["kind"] * named,
        "additionalProperties": False,
    }


def _first_paragraph(section: type[Section]) -> str:
    return " ".join((section.__doc__ or "").split("\n\n")[0].split())


def _chosen(table: type[Section] | Kinds, kinds: tuple[str, ...]) -> type[Section]:
    if not isinstance(table, Kinds):
        return table
    return next((choice for choice in table.choices if choice.kind in kinds), table.default or table.choices[0])


def _blocks(table: type[Section] | Kinds) -> list[str]:
    """Each section of a table as text, the tables inside it after it."""
    if isinstance(table, Kinds):
        return [block for choice in table.choices for block in _blocks(choice)]
    lines = _commented(f"[{table.where}]", _first_paragraph(table))
    inner: list[str] = []
    if table.kind:
        lines.append(f"kind = {as_toml_value(table.kind)}")
    for field in dataclasses.fields(table):
        rule = field.metadata["rule"]
        if isinstance(rule, Rule):
            lines += _commented(_entry(field, field.name in table.shown), _meaning(field))
        else:
            inner += _blocks(rule)
    return ["\n".join(lines) + "\n", *inner]


def _entry(field: dataclasses.Field, shown: bool) -> str:
    """The line of one key: its example if needed or shown; else, as a comment, its default or else its example."""
    example = field.metadata["example"]
    value = example if field.default is None else field.default
    if field.metadata["needed"] or shown:
        return f"{field.name} = {as_toml_value(example)}"
    return f"# {field.name} =" + ("" if value is None else f" {as_toml_value(value)}")


def _meaning(field: dataclasses.Field) -> str:
    """Unit, meaning and allowed values of a key."""
    unit, about, rule = (field.metadata[name] for name in ("unit", "about", "rule"))
    return f"[{unit}] " * bool(unit) + f"{about} | {rule.allowed}"


def _commented(entry: str, comment: str) -> list[str]:
    """An entry with its comment, wrapped into a column of its own."""
    wrapped = [f"{'':<{COLUMN}}# {line}" for line in textwrap.wrap(comment, WIDTH - COLUMN - 2)]
    if not wrapped or len(entry) >= COLUMN:
        return [entry, *wrapped]
    return [entry + wrapped[0][len(entry) :], *wrapped[1:]]
