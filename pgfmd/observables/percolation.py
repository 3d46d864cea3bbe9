"""Whether contact and gap percolate, the critical constriction of the gap, and the load at which it closes.

The constriction is the largest value g* such that the points with g ≥ g* still connect the periodic plane.  Labellings
at a few thresholds leave a bracket of at most `GATHERED` points.  Rank 0 then unites these, from the highest on, with
each other and with the clusters of the points above the bracket: the first edge that closes a winding path is the
constriction, exactly.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.cell import Cell
from pgfmd.grid.grid_cost import Cost
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.contact import Contact
from pgfmd.observables.observable import Observable
from pgfmd.observables.patch_table import Labels, label_patches
from pgfmd.observables.run_length import PeriodicSets, paint
from pgfmd.observables.schema import TABLE, Dataset, Groups
from pgfmd.parallel.collectives import from_root

GATHERED = 100_000  # points of the bracket that rank 0 receives
SAMPLES = 50_000  # of values, of which thresholds are chosen
SHIFTS = 1 << 15  # cells of a shift along y, in a number that holds both


@dataclass(frozen=True, kw_only=True)
class Percolation(Observable):
    """Whether a path in the contact, over edges and corners, or one in the gap, over edges, winds around the periodic
    cell.  The critical constriction is the least gap on the path along which the least gap is largest.
    """

    name = "percolation"
    needs_period = "paths wind around the cell"
    layout = {
        TABLE: {
            **{
                f"{part}_percolates_{axis}": Dataset("1", f"1: a path in the {part} winds around the cell along {axis}")
                for part in ("contact", "gap")
                for axis in "xy"
            },
            **{
                f"constriction_{axis}": Dataset("{length}", f"critical constriction of paths along {axis}; 0: no path")
                for axis in "xy"
            },
        },
        "percolation": {
            **{
                f"constriction_{axis}_{place}": Dataset("1", f"its {place}, of paths along {axis}; −1: no path")
                for axis in "xy"
                for place in ("row", "column")
            },
            "labellings": Dataset("1", "labellings of the grid that both constrictions took"),
        },
    }

    def cost(self, cell: Cell, cutoff: float | None) -> Cost:
        """Some labellings, fields of labels and shifts, and what is gathered, as measured at 512² … 2048²."""
        gathered = min(1.0, 1e5 / math.prod(cell.n))
        return Cost(transforms=17.0 + 100 * gathered, memory=62.0 + 400 * gathered)

    def measure(self, contact: Contact) -> Groups:
        """Labels the contact and the gap.  Collective."""
        found = bottlenecks(contact.grid, contact.gap, contact.contact_pressure <= 0)
        touching = percolates(contact.labels(8))
        numbers: dict[str, float] = {}
        at: dict[str, np.ndarray] = {"labellings": np.array(found[0].labellings)}
        for axis, solid, open_ in zip("xy", touching, found, strict=True):
            numbers |= {f"contact_percolates_{axis}": solid, f"gap_percolates_{axis}": open_.value > 0}
            numbers[f"constriction_{axis}"] = open_.value
            for place, index in zip(("row", "column"), open_.point, strict=True):
                at[f"constriction_{axis}_{place}"] = np.array(index)
        return {TABLE: {name: np.array(float(value)) for name, value in numbers.items()}, "percolation": at}


COLUMNS = {
    "closing_pressure_lower": Dataset("{pressure}", "highest mean pressure found at which the gap percolates"),
    "closing_pressure_upper": Dataset("{pressure}", "lowest mean pressure found at which it does not"),
}


@dataclass(frozen=True, kw_only=True)
class ClosingLoad(Observable):
    """The loads between which the gap ceases to percolate; in every run that imposes load.percolation."""

    name = "closing_load"
    needs_period = "paths wind around the cell"
    layout = {TABLE: COLUMNS}

    def measure(self, contact: Contact) -> Groups:
        """As the search found."""
        if not contact.details.keys() >= COLUMNS.keys():
            raise InputError("output.observables: closing_load needs load.percolation")
        return {TABLE: {name: np.array(contact.details[name]) for name in COLUMNS}}


class Bottleneck(NamedTuple):
    """Where the widest path around the cell is narrowest."""

    value: float  # 0: no path percolates
    point: tuple[int, int]  # row and column; (−1, −1): no path
    labellings: int  # that both directions took together


def percolates(labels: Labels) -> tuple[bool, bool]:
    """Whether some patch winds around the cell along x, along y.  Collective."""
    flags = np.zeros(2) + (labels.winds.any(axis=0) if labels.kept else 0)
    return tuple(map(bool, labels.comm.allreduce(flags)))  # type: ignore[return-value]


def gap_percolates(grid: SlabGrid, mask: np.ndarray) -> bool:
    """Whether a path over edges of a mask (nx_local, ny) winds around the cell, along any axis.  Collective."""
    return any(percolates(label_patches(grid.comm, mask, grid.starts, 4)))


def bottlenecks(grid: SlabGrid, gap: np.ndarray, mask: np.ndarray) -> tuple[Bottleneck, Bottleneck]:
    """Along x and along y, of a gap (nx_local, ny) on the points of a mask, joined over edges.  Collective."""
    comm, least = grid.comm, float(np.nextafter(0, 1))
    value = np.where(mask, np.maximum(gap, least), 0.0)
    stride = max(1, grid.size // SAMPLES)
    samples = np.sort(np.concatenate(comm.allgather(value.ravel()[::stride])))
    low, high = [0.0, 0.0], [math.inf, math.inf]  # {value ≥ low} percolates, {value ≥ high} does not
    labels, count = {math.inf: label_patches(comm, value == math.inf, grid.starts, 4)}, 0

    def bracket(axis: int) -> np.ndarray:
        return (value >= low[axis]) & (value < high[axis])

    threshold = least
    while True:
        found = label_patches(comm, value >= threshold, grid.starts, 4)
        count += 1
        for axis, winds in enumerate(percolates(found)):
            if not low[axis] < threshold < high[axis]:
                continue
            if winds:
                low[axis] = threshold
            else:
                high[axis], labels[threshold] = threshold, found
        labels = {key: kept for key, kept in labels.items() if key in high}
        left = grid.reduction.sums(*(float(np.count_nonzero(bracket(axis))) if low[axis] else 0.0 for axis in range(2)))
        widest = int(np.argmax(left))
        within = samples[(samples > low[widest]) & (samples < high[widest])]
        if left[widest] <= GATHERED or not len(within):
            break
        threshold = float(within[len(within) // 2])
    return tuple(  # type: ignore[return-value]
        Bottleneck(*_closing(grid, value, labels[high[axis]], bracket(axis), axis), count)
        if low[axis]
        else Bottleneck(0.0, (-1, -1), count)
        for axis in range(2)
    )


def _closing(
    grid: SlabGrid, value: np.ndarray, labels: Labels, bracket: np.ndarray, axis: int
) -> tuple[float, tuple[int, int]]:
    """Value, row and column of the point of the bracket whose union with those above it (`labels`) first winds along
    the axis.  Collective.
    """
    nx, ny = grid.shape
    numbers = np.arange(grid.rows.start * ny, grid.rows.stop * ny).reshape(value.shape)
    node = np.where(bracket, -2 - numbers, labels.label_field())  # ≤ −2: a point, > 0: a cluster, 0: below the bracket
    shift, code = np.empty(value.shape, np.int64), labels.shift.astype(np.int64) @ [SHIFTS, 1]
    paint(labels.runs, labels.first, code, labels.fragment, shift)
    around = grid.neighbours([node, shift])
    node, shift = (np.concatenate([rows[:1], own, rows[1:]]) for own, rows in zip((node, shift), around, strict=True))
    i, j = np.nonzero(bracket)
    points, edges = -2 - numbers[i, j], [np.empty((0, 4), np.int64)]
    for di, dj in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        row, column = i + di, j + dj
        other, moved = node[row + 1, column % ny], shift[row + 1, column % ny]  # 0 of points
        y = (moved + SHIFTS // 2) % SHIFTS - SHIFTS // 2
        # Cells by which the cluster of the neighbour lies beyond.
        across, aside = (row + grid.rows.start) // nx - (moved - y) // SHIFTS, column // ny - y
        edge = np.stack([points, other, across, aside], axis=1)
        edges.append(edge[(other > 0) | (other < 0) & (di + dj > 0)])  # two points of the bracket: once
    found = grid.comm.gather((points, value[i, j], np.concatenate(edges)))
    least, number = from_root(grid.comm, _first_winding, found, axis)
    return least, divmod(number, ny)


def _first_winding(parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]], axis: int) -> tuple[float, int]:
    """Value and number of the point whose edges first close a path that winds along the axis.

    parts, of each rank: nodes of the bracket, their values, and edges: (a node of the bracket, another node, cells
    along x and along y by which this is moved to touch the first)
    """
    points, values, edges = (np.concatenate(each) for each in zip(*parts, strict=True))
    nodes, places = np.unique(edges[:, :2], return_inverse=True)
    a, b = places.reshape(-1, 2).T.copy()
    own = np.full(len(nodes), math.inf)  # of clusters, which are above the bracket
    joined = np.isin(points, nodes)
    own[np.searchsorted(nodes, points[joined])] = values[joined]
    order = np.argsort(-np.minimum(own[a], own[b]), kind="stable")
    first = PeriodicSets(len(nodes)).unite(a[order], b[order], edges[order, 2:].astype(np.int32))[axis]
    value, node = min((own[k], -2 - nodes[k]) for k in (a[order[first]], b[order[first]]))
    return float(value), int(node)
