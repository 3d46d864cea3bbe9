"""`pgfmd compare`: differences between the tables of loads of several runs, beside their errors.  No MPI here."""

import json
import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from pgfmd.application.ensemble import Ensemble, is_ensemble, mean_loads
from pgfmd.application.info import comma_separated, known
from pgfmd.application.job import differences, parse
from pgfmd.application.results import Results
from pgfmd.errors import InputError
from pgfmd.observables.schema import is_error
from pgfmd.options.text import aligned

OF_THE_SOLVER = {"target", "contact_line", "certified_error", "pressure_error", "max_violation", "iterations"}
OF_THE_SOLVER |= {"transforms", "seconds"}
"""Columns that tell how a load was solved, not what came out."""
SAME_TARGET = 1e-9
"""Relative difference up to which two targets are the same: jobs write decimal numbers."""


Numbers = dict[str, tuple[float, float]]
"""The numbers of one load by name: value and error, NaN if that is not known."""


@dataclass(frozen=True)
class Row:
    """A number of a load: index and target of the load in the first run, the number there and in another run."""

    run: str
    load: int
    target: float
    name: str
    first: float
    first_error: float
    other: float
    other_error: float

    @property
    def difference(self) -> float:
        """Other less first."""
        return self.other - self.first

    @property
    def error(self) -> float:
        """Root of the sum of squares of the errors that are known; NaN if neither is."""
        bars = [bar for bar in (self.first_error, self.other_error) if math.isfinite(bar)]
        return math.hypot(*bars) if bars else math.nan

    @property
    def ratio(self) -> float:
        """Difference over error; NaN without an error."""
        return self.difference / self.error if self.error > 0 else math.nan


class Side:
    """A result folder or an ensemble: the numbers of each load with their errors.

    The error of a run is the estimate of solver and grid together, which the observables "discretisation", "stiffness"
    and others write; that of an ensemble is the standard error of the mean.
    """

    def __init__(self, folder: str | os.PathLike):
        self.name = str(folder)
        self.loads: list[Numbers]
        if is_ensemble(folder):
            runs = Ensemble(folder).runs
            if not runs:
                raise InputError(f"{folder}: no seed has results")
            run, columns = runs[0], mean_loads(runs)
            names = [name for name in columns if not is_error(name, columns)]
            pairs = [zip(columns[name].mean.tolist(), columns[name].error.tolist(), strict=True) for name in names]
            self.loads = [dict(zip(names, load, strict=True)) for load in zip(*pairs, strict=True)]
        else:
            run = Results(folder)
            rows = (load.numbers for load in run)
            self.loads = [{name: (value, row.get(f"{name}_error", math.nan))
                           for name, value in row.items() if not is_error(name, row)} for row in rows]  # fmt: skip
        self.job = parse(run.provenance["effective_toml"], str(run.directory))
        self.imposed = self.job.load.control
        self.units = run.units


def compare(folders: Sequence[str | os.PathLike]) -> tuple[list[Row], list[str]]:
    """Each number of each load that the first folder shares with another; and a line for each difference of jobs.

    Loads are the same if their targets are, of the same kind of load.  Raises InputError for fewer than two folders, if
    a folder holds no results, for units that differ, and where no load is shared.
    """
    if len(folders) < 2:
        raise InputError("compare: give two result folders or more; the others are compared with the first")
    first, *others = map(Side, folders)
    rows: list[Row] = []
    notes: list[str] = []
    for other in others:
        _check(first, other)
        pairs = list(_pairs(first, other))
        if not pairs:
            raise InputError(f"{first.name} and {other.name}: no load has the same target in both")
        notes += [f"{other.name}: {line}" for line in differences(first.job, other.job)]
        missing = len(first.loads) + len(other.loads) - 2 * len(pairs)
        if missing:
            notes.append(f"{other.name}: {missing} loads of one run have no partner in the other")
        for index, mine, its in pairs:
            for name in mine:
                if name in its and name not in OF_THE_SOLVER:
                    row = Row(other.name, index, mine["target"][0], name, *mine[name], *its[name])
                    if math.isfinite(row.first) or math.isfinite(row.other):
                        rows.append(row)
    return rows, notes


def _check(first: Side, other: Side) -> None:
    if first.imposed != other.imposed:
        raise InputError(f"{first.name} imposes {first.imposed}, {other.name} {other.imposed}: loads differ")
    for name in first.units:
        if first.units[name] != other.units.get(name, first.units[name]):
            raise InputError(
                f"{first.name} has {name} in {first.units[name]}, {other.name} in {other.units[name]}; "
                "units must be the same"
            )


def _pairs(first: Side, other: Side) -> Iterable[tuple[int, Numbers, Numbers]]:
    """Pairs of loads with the same target, each in one pair at most: index in the first run, numbers of both."""
    free = list(other.loads)
    for index, mine in enumerate(first.loads):
        target = mine["target"][0]
        for its in free:
            if math.isclose(its["target"][0], target, rel_tol=SAME_TARGET):
                free.remove(its)
                yield index, mine, its
                break


def as_text(rows: Sequence[Row], notes: Sequence[str], first: str) -> str:
    """The differences as an aligned table below those of the jobs, without numbers that are equal."""
    head = ("load", "number", "first", "other", "difference", "error", "in errors", "relative")
    parts = []
    for run in dict.fromkeys(row.run for row in rows):
        lines = [head]
        for row in (row for row in rows if row.run == run and row.difference):
            relative = row.difference / abs(row.first) if row.first else math.nan
            cells = (f"{row.first:.6g}", f"{row.other:.6g}", f"{row.difference:.2g}", _known(row.error, ".1g"))
            lines.append((str(row.load), row.name, *cells, _known(row.ratio, ".2f"), _known(relative, ".2%")))
        about = [note.removeprefix(run + ":") for note in notes if note.startswith(run + ":")]
        same = ["all numbers of the loads that both have are the same"]
        parts.append("\n".join([f"{run} less {first}", *about, *(aligned(lines) if len(lines) > 1 else same)]))
    legend = "\n\nin errors: the difference over the joint error; —: no error is known"
    return "\n\n".join(parts) + legend * any(row.difference for row in rows)


def _known(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else "—"


def as_csv(rows: Sequence[Row]) -> str:
    """The differences in full precision."""
    return comma_separated([*Row.__dataclass_fields__, "difference", "error"], _entries(rows))


def as_json(rows: Sequence[Row], notes: Sequence[str]) -> str:
    """The differences, and those of the jobs; null for what is not known."""
    return json.dumps(known({"differs": list(notes), "numbers": _entries(rows)}), ensure_ascii=False, indent=2)


def _entries(rows: Sequence[Row]) -> list[dict[str, Any]]:
    return [asdict(row) | {"difference": row.difference, "error": row.error} for row in rows]
