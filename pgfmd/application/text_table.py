"""Numbers of loads as aligned text."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np


def text_table(loads: Mapping[str, np.ndarray], units: Mapping[str, str], errors: Mapping[str, np.ndarray]) -> str:
    """Columns as text: their names, units, and rows of "value ± error"; "value" where the error is 0 or not finite."""
    columns = [["load", "", *map(str, range(len(next(iter(loads.values())))))]]
    for name, values in loads.items():
        texts = [f"{value:d}" if isinstance(value, np.integer) else f"{value:.5g}" for value in values]
        bars = [f" ± {error:.1g}" if np.isfinite(error) and error > 0 else "" for error in errors[name]]
        columns.append([name, units[name], *(text + bar for text, bar in zip(texts, bars, strict=True))])
    widths = [max(map(len, column)) for column in columns]
    rows = zip(*columns, strict=True)
    return "\n".join(
        "  ".join(entry.rjust(width) for entry, width in zip(row, widths, strict=True)) for row in rows
    )
