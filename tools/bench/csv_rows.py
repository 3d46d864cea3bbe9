"""Tables of measurements: rows as dicts, in CSV files."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path


def read(path: Path, needed: bool = False) -> list[dict[str, str]]:
    """The rows of a file.  A missing file has none; raises FileNotFoundError if it is needed."""
    if not needed and not path.exists():
        return []
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write(path: Path, rows: Sequence[Mapping], digits: int = 0) -> None:
    """Write a file anew, with the columns of all rows; there is none without rows.  digits: significant ones of floats;
    0: as Python writes them.
    """
    path.unlink(missing_ok=True)
    if rows:
        append(path, list(dict.fromkeys(name for row in rows for name in row)), rows, digits)


def append(path: Path, columns: Sequence[str], rows: Iterable[Mapping], digits: int = 6) -> None:
    """Add rows to a file, which begins with its columns; what a row lacks is left empty."""
    fresh = not path.exists()
    with open(path, "a", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, columns, restval="", lineterminator="\n")
        if fresh:
            table.writeheader()
        table.writerows({name: shown(value, digits) for name, value in row.items()} for row in rows)


def shown(value: object, digits: int = 6) -> str:
    """A value as it stands in a table, where None is nothing."""
    if value is None:
        return ""
    return f"{value:.{digits}g}" if digits and isinstance(value, float) else str(value)
