"""Tables of the TOML file as frozen dataclasses: each key is a field that carries its rule.

A `Section` checks itself when it is made, from a file or from Python alike, so that one line can name the key, its
value and what is allowed.  Where a table may be one of several sections, `Kinds` lists them: a contact law, a surface.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from pgfmd.errors import InputError
from pgfmd.options.rules import Rule, checked, text
from pgfmd.options.text import as_toml_value, assignments, guess, printable, show


def key(
    rule: Rule | type[Section] | Kinds,
    default: Any = None,
    about: str = "",
    *,
    unit: str = "",
    needed: bool = False,
    example: Any = None,
) -> Any:
    """A dataclass field with its rule.

    about: what the key means, for the reference.  unit: of a real number ("1": a pure number), "" for other values.
    needed: the key must be given; the reference shows the example.  Any other key that is left out has the default;
    None means no value.
    """
    metadata = {"rule": rule, "needed": needed, "about": about, "unit": unit, "example": example}
    if isinstance(rule, type):
        return dataclasses.field(default_factory=rule, metadata=metadata)
    if isinstance(rule, Kinds) and rule.default is not None:
        return dataclasses.field(default_factory=rule.default, metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def path_key(about: str, example: str) -> Any:
    """The key `path`, which names a file: relative to the job's folder, and read again by a restart."""
    return key(text(), None, about, needed=True, example=example)


@dataclass(frozen=True, kw_only=True)
class Section:
    """A table of the TOML file.  Making one validates it; raises InputError.

    where: the name of the table, as in [where].  kind: the value of the key `kind` that chooses this section among
    others, "" if it is the only one.  shown: optional keys that the example job gives nevertheless.
    """

    where: ClassVar[str] = ""
    kind: ClassVar[str] = ""
    shown: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            rule, value = field.metadata["rule"], getattr(self, field.name)
            if value is None and (field.metadata["needed"] or isinstance(rule, Rule) and field.default is not None):
                raise InputError(f"{self.where}.{field.name} is missing: it must be {rule.allowed}")
            if value is not None and isinstance(rule, Rule):
                value = checked(f"{self.where}.{field.name}", value, rule)
            object.__setattr__(self, field.name, value)
        self.check()

    @property
    def source(self) -> tuple[str, str | None] | None:
        """The file that the key `path` names, and the dataset in it (None: not said); None if there is no such key."""
        path = getattr(self, "path", None)
        return None if path is None else (path, None)

    def check(self) -> None:
        """Check keys of this section against each other; raises InputError.  A subclass overrides it."""


@dataclass(frozen=True)
class Kinds:
    """The sections that one table may be.

    where: the name of the table.  choices: the sections; several may share a kind if their needed keys differ.
    default: the section of a table that is left out; None: the table and its `kind` are needed.  added: choices of
    plugins, taken only if the table names their `kind`.
    """

    where: str
    choices: tuple[type[Section], ...]
    default: type[Section] | None = None
    added: tuple[type[Section], ...] = ()

    @property
    def allowed(self) -> str:
        """The values of `kind`, in words."""
        return "one of " + ", ".join(show(kind) for kind in dict.fromkeys(choice.kind for choice in self.choices))

    def add(self, section: type[Section]) -> None:
        """Add a section; it replaces those of its kind."""
        others = (choice for choice in self.choices if choice.kind != section.kind)
        object.__setattr__(self, "choices", (*others, section))
        object.__setattr__(self, "added", (*self.added, section))

    def choose(self, table: Mapping[str, Any]) -> type[Section]:
        """The section for the keys of a table; raises InputError for a kind that is unknown or missing.

        Candidates are the choices of the table's kind; if it names none and there is a default, all but those of
        plugins.  Taken is the one that knows most of the table's keys; among equals the one with the fewest keys, then
        the default.  Candidates for which a needed key is missing come last.
        """
        if "kind" in table:
            candidates = [choice for choice in self.choices if choice.kind == table["kind"]]
            if not candidates:
                raise InputError(f"{self.where}.kind = {show(table['kind'])}: must be {self.allowed}")
        elif self.default is None:
            raise InputError(f"{self.where}.kind is missing: it must be {self.allowed}")
        else:
            candidates = [self.default, *(choice for choice in self.choices if choice not in self.added)]
        return max(candidates, key=lambda choice: (_fits(choice, table), -len(dataclasses.fields(choice))))

    def keys(self, kind: Any) -> set[str] | None:
        """The keys of the sections of that kind; None if there is no such kind."""
        keys = [set(_names(choice)) for choice in self.choices if choice.kind == kind]
        return set().union(*keys) if keys else None


def _names(section: type[Section]) -> list[str]:
    return [field.name for field in dataclasses.fields(section)]


def _fits(section: type[Section], table: Mapping[str, Any]) -> int:
    """How many keys of the table a section knows; −1 if a needed one is missing."""
    needed = [field.name for field in dataclasses.fields(section) if field.metadata["needed"]]
    return len(table.keys() & set(_names(section))) if table.keys() >= set(needed) else -1


def wrong(section: Section, name: str, message: str) -> InputError:
    """The error for one key: its name, its value, and the message, which says what is wrong or allowed."""
    return InputError(f"{section.where}.{name} = {show(getattr(section, name))}: {message}")


def build(section: type[Section] | Kinds, table: Any) -> Section:
    """A section from a TOML table; raises InputError for unknown keys and wrong values."""
    if not isinstance(table, dict):
        raise InputError(f"{section.where} = {show(table)}: must be a table, [{section.where}]")
    chosen, choices = (section.choose(table), section.choices) if isinstance(section, Kinds) else (section, ())
    fields = {field.name: field for field in dataclasses.fields(chosen)}
    values = {}
    for name, value in table.items():
        if name == "kind" and choices:
            continue
        if name not in fields:
            if kinds := [choice.kind for choice in choices if name in _names(choice)]:
                places = " or ".join(map(show, kinds))
                raise InputError(f"{section.where}.{name} = {show(value)}: belongs to kind = {places} only")
            known = ["kind"] * bool(choices) + list(fields)
            raise InputError(f"{section.where}.{printable(name)} is not known{guess(name, known)}")
        rule = fields[name].metadata["rule"]
        values[name] = value if isinstance(rule, Rule) else build(rule, value)
    return chosen(**values)


def in_words(section: Section) -> str:
    """The keys of a section that are not None, with their values, on one line; numbers to ten digits."""
    values = _values(section).items()
    return assignments({name: float(f"{v:.10g}") if isinstance(v, float) else v for name, v in values})


def as_toml(title: str, section: Section) -> str:
    """A section as a TOML table with all its keys, those that are None left out."""
    lines, tables = [f"kind = {show(section.kind)}"] if section.kind else [], []
    for name, value in _values(section).items():
        if isinstance(value, Section):
            tables.append(as_toml(f"{title}.{name}", value))
        elif value is not None:
            lines.append(f"{name} = {as_toml_value(value)}")
    return "\n".join([f"[{title}]", *lines, "", *tables])


def _values(section: Section) -> dict[str, Any]:
    return {name: getattr(section, name) for name in _names(type(section))}
