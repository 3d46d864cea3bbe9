"""Values and names as text: in messages, on one line, and in TOML."""

import difflib
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


def reason(error: BaseException) -> str:
    """The message of an error on one line; the name of its type if it has none."""
    return " ".join(str(error).split()) or type(error).__name__


def guess(name: str, allowed: list[str]) -> str:
    """End of a message about an unknown name: the most similar allowed name, then all allowed names."""
    near = difflib.get_close_matches(name, allowed, n=1)
    return (f"; did you mean {near[0]}?" if near else ".") + f" Allowed: {', '.join(allowed)}"


def printable(name: str, longest: int = 60) -> str:
    """Text without line breaks and control characters, cut to a readable length."""
    clean = "".join(letter if letter.isprintable() else "?" for letter in name)
    return clean if len(clean) <= longest else clean[: longest - 1] + "…"


def counted(number: int, noun: str) -> str:
    """ "1 rank", "2 ranks"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def readable(size: float) -> str:
    """A number of bytes with a decimal prefix."""
    for unit in ("B", "kB", "MB", "GB", "TB"):
        if size < 1000:
            return f"{float(f'{size:.3g}'):g} {unit}"
        size /= 1000
    return f"{size:.3g} PB"


def duration(seconds: float) -> str:
    """A time in the unit that reads best, to two digits; days to three."""
    for limit, divisor, unit in ((120, 1, "s"), (7200, 60, "min"), (172800, 3600, "h")):
        if seconds < limit:
            return f"{float(f'{seconds / divisor:.2g}'):g} {unit}"
    return f"{float(f'{seconds / 86400:.3g}'):g} days"


def with_error(value: float, error: float) -> str:
    """ "0.80000 ± 0.00100" ("± 2e-06" where five decimals show nothing), or "0.80000" if the error is not known."""
    shown = f"{error:.5f}" if error >= 1e-5 or error == 0 else f"{error:.0e}"
    return f"{value:.5f}" + (f" ± {shown}" if np.isfinite(error) else "")


def assignments(table: Mapping[str, Any]) -> str:
    """The entries that are not None, on one line: "young = 2.0, poisson = 0.3"."""
    return ", ".join(f"{name} = {show(value)}" for name, value in table.items() if value is not None)


def listed(lines: Mapping[str, str]) -> str:
    """A line for each entry that is not empty: its name, and its text in a column."""
    width = max(map(len, lines))
    return "\n".join(f"{name:<{width}}  {value}" for name, value in lines.items() if value)


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """A line for each row, columns aligned to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]


def show(value: Any) -> str:
    """A value as TOML writes it, on one line, cut to a readable length."""
    try:
        return printable(as_toml_value(value))
    except (TypeError, RecursionError):
        return printable(str(type(value).__name__))


def as_toml_value(value: Any) -> str:
    """A TOML literal of a bool, number, text, list or table; raises TypeError for anything else."""
    if isinstance(value, (bool, np.bool_)):
        return "true" if value else "false"
    if isinstance(value, (int, np.integer)):
        try:
            return str(int(value))
        except ValueError:  # Python refuses to print thousands of decimal digits
            return hex(int(value))
    if isinstance(value, (float, np.floating)):
        return repr(float(value))
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, (list, tuple, np.ndarray)):
        return "[" + ", ".join(as_toml_value(entry) for entry in value) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{name} = {as_toml_value(entry)}" for name, entry in value.items()) + "}"
    raise TypeError(f"no TOML value: {type(value).__name__}")
