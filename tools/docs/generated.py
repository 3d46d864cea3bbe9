"""Writes what is generated of pages/reference.md, from the source: python tools/docs/generated.py"""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from pgfmd.application.job import SECTIONS
from pgfmd.observables.observable_kinds import LAYOUT, OBSERVABLES
from pgfmd.observables.schema import FIELDS, LOADS, TABLE, Dataset
from pgfmd.options.key_reference import reference

PAGE = Path(__file__).parent / "pages" / "reference.md"


def generated() -> dict[str, str]:
    """The parts of the page between <!-- NAME --> and <!-- /NAME -->, by name."""
    units, *tables = re.split(r"\n(?=\[)", reference(SECTIONS.values()))
    datasets = (
        (f"{group}/{name}", dataset.unit, dataset.description)
        for group, held in LAYOUT.items()
        for name, dataset in held.items()
        if group != TABLE
    )
    columns = ((name, about.unit, f"{about.description} (`{kind.name}`)")
               for kind in OBSERVABLES.values() for name, about in kind.layout.get(TABLE, {}).items())  # fmt: skip
    return {
        "keys": _code(units) + "".join(f"\n### {_heading(table)}\n\n{_code(table)}" for table in tables),
        "columns": _table("column", (*_described(LOADS), *columns)),
        "fields": _table("field", _described(FIELDS)),
        "datasets": _table("dataset", datasets),
    }


def page(text: str) -> str:
    """The page with its generated parts as they have to be."""
    for name, part in generated().items():
        before, after = f"<!-- {name} -->", f"<!-- /{name} -->"
        text = f"{text.partition(before)[0]}{before}\n\n{part}\n{after}{text.partition(after)[2]}"
    return text


def _heading(table: str) -> str:
    """[surface] kind = "file"."""
    kind = re.search(r"^kind = .*", table, re.MULTILINE)
    return " ".join(filter(None, (table.split()[0], kind and kind[0])))


def _code(text: str) -> str:
    return f"```toml\n{text.rstrip()}\n```\n"


def _described(datasets: Mapping[str, Dataset]) -> Iterable[tuple[str, str, str]]:
    return ((name, about.unit, about.description) for name, about in datasets.items())


def _table(what: str, rows: Iterable[tuple[str, str, str]]) -> str:
    cells = ((f"`{name}`", re.sub("[{}]", "", unit), about.replace("|", "&#124;")) for name, unit, about in rows)
    lines = (f"| {' | '.join(row)} |" for row in cells)
    return "\n".join([f"| {what} | unit | |", "|---|---|---|", *lines]) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text()))
