"""A random job: its tables, its TOML text, and how it may end."""

import json
import re
from dataclasses import dataclass

import numpy as np

RIGHT, REFUSED, UNCERTIFIED, WRONG, TRACEBACK, HANGS, UNJUDGED = VERDICTS = (
    "right", "refused", "uncertified", "wrong", "traceback", "hang", "unjudged",
)  # fmt: skip
BAD = (WRONG, TRACEBACK, HANGS)


@dataclass
class Case:
    """A job as tables of TOML, heights (nx, ny) for its file, and the way by which it is run."""

    number: int
    document: dict
    heights: np.ndarray | None
    way: str  # "solve" (arrays), "simulate" (in this process) or "command" (in another one)
    spoilt: bool = False  # a value was replaced by another that is probably wrong
    factor: np.ndarray | None = None  # (2, 2): q and F(q) of a solid that is a table


def kind(verdict: str, detail: str) -> str:
    """What failures of one kind share: verdict and detail without numbers; of a traceback the last lines."""
    if verdict == TRACEBACK:
        detail = " ".join(detail.strip().splitlines()[-3:])
    detail = re.sub(r"\S*/job\.toml", "job.toml", detail)
    return verdict + " " + re.sub(r"[-+]?\d[\d.]*(e[-+]?\d+)?|\binf\b|\bnan\b", "#", detail)[:160]


def toml(document: dict) -> str:
    """The tables as TOML."""
    lines = []

    def write(prefix: str, table: dict):
        tables = {}
        for name, value in table.items():
            if isinstance(value, dict) and value and not prefix.count("."):
                tables[name] = value
            else:
                lines.append(f"{name} = {_literal(value)}")
        for name, value in tables.items():
            lines.append(f"[{prefix}.{name}]")
            write(f"{prefix}.{name}", value)

    for section, table in document.items():
        if isinstance(table, dict):
            lines.append(f"[{section}]")
            write(section, table)
        else:
            lines.insert(0, f"{section} = {_literal(table)}")
    return "\n".join(lines) + "\n"


def _literal(value) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, dict):
        return "{" + ", ".join(f"{name} = {_literal(entry)}" for name, entry in value.items()) + "}"
    return "[" + ", ".join(map(_literal, value)) + "]"


def show(case: Case, detail: str) -> str:
    """A job that went wrong, to be copied into a file."""
    heights = ""
    if case.heights is not None:
        values = np.array2string(case.heights, separator=", ", threshold=10**6, floatmode="unique", max_line_width=118)
        heights = f"# heights.npy = np.array({values})\n" if case.heights.size <= 100 else "# heights.npy is drawn\n"
    factor = "" if case.factor is None else f"# factor.npy = np.array({case.factor.tolist()})\n"
    return f"# job {case.number} by {case.way}: {detail}\n{toml(case.document)}{heights}{factor}"
