"""What is measured on each contact patch: area, load, perimeter, pressures, periodic extent, percolation.

Each rank measures the pixels it holds; pieces of a patch on other ranks are added on the rank that keeps the patch (see
`labelling`), and only finished rows go to rank 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from pgfmd.observables.labelling import Labels
from pgfmd.parallel.collectives import raise_together
from pgfmd.parallel.compiled import compiled


@dataclass(frozen=True)
class PatchTable:
    """One entry per patch, in the order of the labels: entry i belongs to label i + 1.  Every array has shape (count,).

    Lengths are in the unit of the grid spacing, pressures in that of the pressure field, loads in pressure × length².
    """

    area: np.ndarray  # number of pixels × ax ay
    load: np.ndarray | None  # Σ p ax ay; None, as the pressures, if no pressure was given
    perimeter: np.ndarray  # pixel edges between contact and non-contact, each with its length: ay across x, ax across y
    mean_pressure: np.ndarray | None  # load / area
    peak_pressure: np.ndarray | None
    extent_x: np.ndarray  # length of the shortest interval of the periodic x axis that holds the patch; at most lx
    extent_y: np.ndarray
    percolates_x: np.ndarray  # bool: see `patch_table`
    percolates_y: np.ndarray
    area_corrected: np.ndarray | None  # inside the line, or `area` if that is ≤ 0; ≥ load/highest; None without a line
    perimeter_corrected: np.ndarray | None  # length of the contact line, or `perimeter` likewise


def patch_table(
    labels: Labels,
    spacing: tuple[float, float],
    pressure: np.ndarray | None = None,
    line: tuple[np.ndarray, np.ndarray] | None = None,
    highest: float = math.inf,
) -> PatchTable | None:
    """Measure all patches; the table on rank 0, None on the others.  Collective.

    `pressure`: (rows, columns) float32 or float64, the slab of this rank; `spacing` = (ax, ay).
    `line`: area beyond that of the pixels and length of the contact line of each patch that this rank keeps.
    `highest`: the largest pressure that the law admits (see `contact_area`).

    A patch percolates in x if, followed from pixel to pixel over the edges of the cell, it arrives at a periodic image
    of itself that is displaced along x (whatever the displacement along y), that is if the unrolled patch has no end
    along x.  Reaching from one edge of the cell to the other is neither enough nor needed.
    Raises ValueError if the pressure does not have the shape of the mask.
    """
    rows = len(labels.first) - 2
    with raise_together(labels.comm):
        if pressure is not None and pressure.shape != (rows, labels.columns):
            raise ValueError(f"the pressure has shape {pressure.shape}, the labels ({rows}, {labels.columns})")
    columns: dict[str, np.ndarray | None] = dict.fromkeys(field.name for field in fields(PatchTable))
    shapes = _shape_columns(labels, spacing)
    columns |= shapes
    load = np.zeros(labels.kept)
    if pressure is not None:
        total, peak = _pressures(labels, pressure)
        load = total * (spacing[0] * spacing[1])
        columns |= {"load": load, "mean_pressure": load / shapes["area"], "peak_pressure": peak}
    if line is not None:
        inside = shapes["area"] + line[0]
        none = inside <= 0  # of a pixel or two, close to other patches: as in `contact_area`
        columns |= {
            "area_corrected": np.maximum(np.where(none, shapes["area"], inside), load / highest),
            "perimeter_corrected": np.where(none, shapes["perimeter"], line[1]),
        }
    gathered: dict[str, Any] = {name: _gather(labels, columns.pop(name)) for name in list(columns)}
    return PatchTable(**gathered) if labels.comm.rank == 0 else None


def _shape_columns(labels: Labels, spacing: tuple[float, float]) -> dict[str, np.ndarray]:
    """Area, perimeter, extents and percolation of the patches this rank keeps.  Collective."""
    local = labels.kept + len(labels.foreign)
    counts = np.zeros((local, 3), np.int64)
    box = np.full((local, 4), np.iinfo(np.int64).max)
    cell = np.array([labels.starts[-1], labels.columns], np.int64)
    corner = int(labels.starts[labels.comm.rank])
    found = labels.runs, labels.first, labels.fragment, labels.covered
    _measure_shape(found, (labels.patch, labels.shift), cell, corner, counts, box)

    np.add.at(counts, labels.returned, labels.to_keepers(counts[labels.kept :]))
    np.minimum.at(box, labels.returned, labels.to_keepers(box[labels.kept :]))
    pixels, across_x, across_y = counts[: labels.kept].T
    low, high = box[: labels.kept, :2], -box[: labels.kept, 2:]
    # A connected patch has no gap in its unrolled rows: if there are as many as the cell has, it fills them all.
    extent = np.where(labels.winds, cell, np.minimum(high - low + 1, cell)) * np.asarray(spacing)
    ax, ay = spacing
    return {
        "area": pixels * (ax * ay),
        "perimeter": across_x * ay + across_y * ax,
        "extent_x": extent[:, 0],
        "extent_y": extent[:, 1],
        "percolates_x": labels.winds[:, 0],
        "percolates_y": labels.winds[:, 1],
    }


def _pressures(labels: Labels, pressure: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sum and maximum of the pressure on each patch this rank keeps.  Collective."""
    local = labels.kept + len(labels.foreign)
    total, peak = np.zeros(local), np.full(local, -np.inf)
    _measure_pressure((labels.runs, labels.first, labels.fragment), labels.patch, pressure, total, peak)
    np.add.at(total, labels.returned, labels.to_keepers(total[labels.kept :]))
    np.maximum.at(peak, labels.returned, labels.to_keepers(peak[labels.kept :]))
    return total[: labels.kept], peak[: labels.kept]


def _gather(labels: Labels, column: np.ndarray | None) -> np.ndarray | None:
    """One column of the table on rank 0, in the order of the labels; None elsewhere.  Collective."""
    if column is None:
        return None
    out = np.empty(labels.count, column.dtype) if labels.comm.rank == 0 else None
    labels.comm.Gatherv(np.ascontiguousarray(column), None if out is None else [out, labels.kept_counts])
    return out


@compiled()
def _measure_shape(
    found: tuple[np.ndarray, ...], places: tuple[np.ndarray, ...], cell: np.ndarray, corner: int,
    counts: np.ndarray, box: np.ndarray,
) -> None:  # fmt: skip
    """Add to counts[p] the pixels and the open edges across x and across y of each local patch p; update box[p].

    box[p] = (min row, min column, −max row, −max column), unrolled, so that one minimum over pieces serves all four.
    """
    (runs, first, fragment, covered), (patch, shift) = found, places
    for i in range(1, len(first) - 1):
        begin, end = first[i], first[i + 1]
        closed = end > begin and runs[begin, 0] == 0 and runs[end - 1, 1] == cell[1]
        for k in range(begin, end):
            start, stop = runs[k, 0], runs[k, 1]
            piece = fragment[k]
            p = patch[piece]
            counts[p, 0] += stop - start
            counts[p, 1] += 2 * (stop - start - covered[k])  # a column enters a patch as often as it leaves it
            counts[p, 2] += 0 if closed and k == begin else 2
            row = corner + i - 1 + shift[piece, 0] * cell[0]
            column = shift[piece, 1] * cell[1]
            box[p, 0] = min(box[p, 0], row)
            box[p, 1] = min(box[p, 1], column + start)
            box[p, 2] = min(box[p, 2], -row)
            box[p, 3] = min(box[p, 3], 1 - column - stop)


@compiled()
def _measure_pressure(
    found: tuple[np.ndarray, ...], patch: np.ndarray, pressure: np.ndarray, total: np.ndarray, peak: np.ndarray
) -> None:
    """Add to total[p] the pressures of each local patch p, run by run in float64; raise peak[p] to the largest."""
    runs, first, fragment = found
    for i in range(1, len(first) - 1):
        for k in range(first[i], first[i + 1]):
            sum_of_run, largest = 0.0, -np.inf
            for j in range(runs[k, 0], runs[k, 1]):
                value = np.float64(pressure[i - 1, j])
                sum_of_run += value
                largest = max(largest, value)
            p = patch[fragment[k]]
            total[p] += sum_of_run
            peak[p] = max(peak[p], largest)
