"""Contact patches: connected sets of pixels of a doubly periodic mask, and what is measured on each of them.

Every rank labels its rows together with a copy of the row above them, the last one of the rank before (of the last
rank, for rank 0).  Runs that touch are joined to fragments; a piece of a patch is a fragment, or several known to be
connected.  Two neighbouring ranks hold the same row, so that a piece of one and a piece of the other belong together
where they hold the same run: there is nothing geometric left to do at a seam, and one rank alone is no special case.
Seams are joined pairwise up a binary tree of ranks, groups of neighbours keeping only their two outer rows; the answers
come down the same way.  No rank holds more than a few rows of the others; what touches no seam does not travel.

Numbers: patches are numbered from 1 in the order of their first pixels, read row by row through the whole grid (rows
along y, as stored).  This rule does not know about ranks.

Each rank measures the pixels it holds; pieces of a patch on other ranks are added on the rank that keeps the patch, and
only finished rows go to rank 0.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from pgfmd.errors import InputError
from pgfmd.observables.run_length import PeriodicSets, column_wraps, find_fragments, find_runs, paint
from pgfmd.parallel.collectives import raise_together
from pgfmd.parallel.compiled import compiled
from pgfmd.parallel.mpi import MPI

_RANK_BITS = 40  # a key is (rank << 40) + piece: keys are in the order of first pixels, and say where the patch is kept
_NOWHERE = np.iinfo(np.int64).max  # the key of a piece of which no pixel is seen here

Answer = tuple[np.ndarray, np.ndarray, np.ndarray]
"""For m pieces: the key of their patch (m,); the cells to add to their coordinates to have them in its frame (m, 2);
whether it winds around the cell along x and along y (m, 2).
"""


@dataclass(frozen=True)
class Labels:
    """What each rank knows of the patches of a mask, as runs.  Symbols as in `run_length`; row 0 is the copied one.

    A patch is kept by the rank that holds its first pixel.  Local numbers: kept patches first, in the order of their
    labels, then those that others keep (`foreign`), in the order of the ranks that keep them.
    """

    comm: MPI.Comm
    starts: np.ndarray  # (ranks + 1,) first row of each rank, and the number of rows
    columns: int
    connectivity: int
    count: int  # patches of the whole grid
    runs: np.ndarray  # (n, 2) int32
    first: np.ndarray  # (rows + 2,) int64
    fragment: np.ndarray  # (n,) fragment of each run
    covered: np.ndarray  # (n,) pixels of each run that have a set pixel in the row above, across the seams too
    patch: np.ndarray  # (fragments,) local number of the patch of each; −1 if the fragment has no pixel of this rank
    shift: np.ndarray  # (fragments, 2) int32, cells to add to coordinates to have each patch unrolled in one piece
    kept_counts: np.ndarray  # (ranks,) patches kept by each rank
    winds: np.ndarray  # (kept, 2) bool: the patch meets its own periodic image along x, along y
    foreign: np.ndarray  # (foreign patches,) labels
    send_counts: np.ndarray  # (ranks,) how many of `foreign` each rank keeps
    returned: np.ndarray  # local numbers of kept patches of which others hold pieces, by rank of the others
    return_counts: np.ndarray  # (ranks,) how many of `returned` each rank asked for

    @property
    def kept(self) -> int:
        """Number of patches kept by this rank."""
        return int(self.kept_counts[self.comm.rank])

    @property
    def kept_from(self) -> int:
        """Label of the first patch kept by this rank."""
        return 1 + int(self.kept_counts[: self.comm.rank].sum())

    def label_field(self) -> np.ndarray:
        """The label of each pixel of this slab, 0 outside patches: shape (rows, columns), int32 (int64 from 2³¹ on)."""
        out = np.empty((len(self.first) - 2, self.columns), np.int32 if self.count < 2**31 else np.int64)
        # The last entry stands for the fragments without a pixel here, whose local number is −1.
        labels = np.concatenate([np.arange(self.kept_from, self.kept_from + self.kept), self.foreign, [0]])
        paint(self.runs, self.first, labels.astype(out.dtype)[self.patch], self.fragment, out)
        return out

    def to_keepers(self, values: np.ndarray) -> np.ndarray:
        """Send `values`, a row per foreign patch, to their keepers; returns the rows for `returned`, in its order.
        Collective.
        """
        return _exchange(self.comm, values, self.send_counts, self.return_counts)


def label_patches(
    comm: MPI.Comm, mask: np.ndarray, starts: np.ndarray, connectivity: int = 8, wraps: bool = True
) -> Labels:
    """Find the patches of a mask, doubly periodic if it `wraps`.  Collective.

    `mask`: (rows, columns) bool, rows starts[rank] … starts[rank + 1] − 1 of the grid, at least one per rank.
    `connectivity`: 8 joins pixels that share an edge or a corner, 4 only those that share an edge.
    Raises InputError for another connectivity, ValueError if the mask does not have this shape and type.
    """
    if connectivity not in (4, 8):
        raise InputError(f"patches: connectivity = {connectivity!r}: must be 4 or 8")
    rows = int(starts[comm.rank + 1] - starts[comm.rank])
    with raise_together(comm):
        if mask.ndim != 2 or mask.dtype != np.bool_ or len(mask) != rows or mask.size == 0:
            raise ValueError(f"the mask is {mask.dtype} {mask.shape}: must be bool, ({rows}, columns), and not empty")
    mask = np.ascontiguousarray(mask)
    above = np.empty_like(mask[0])
    comm.Sendrecv(mask[-1], (comm.rank + 1) % comm.size, recvbuf=above, source=(comm.rank - 1) % comm.size)

    if comm.rank == 0 and not wraps:
        above[:] = False
    reach = int(connectivity == 8)
    runs, first = find_runs(above, mask)
    fragment, covered, below, count = find_fragments(runs, first, reach)
    pieces = PeriodicSets(count)
    ends, begins = column_wraps(runs, first, mask.shape[1], reach)
    if not wraps:
        ends = begins = ends[:0]
    pieces.unite(fragment[ends], fragment[begins], np.broadcast_to(np.array([0, 1], np.int32), (len(ends), 2)))

    top, bottom = fragment[: first[1]], fragment[first[-2] :]
    roots, at_seam = np.unique(pieces.parent[np.concatenate([top, bottom])], return_inverse=True)
    shift = pieces.shift[np.concatenate([top, bottom])]
    own_key = np.where(roots < below, (comm.rank << _RANK_BITS) + roots.astype(np.int64), _NOWHERE)
    seam = _Seam(at_seam[: len(top)], shift[: len(top)], at_seam[len(top) :], shift[len(top) :],
                 own_key, pieces.winds[roots])  # fmt: skip
    key, move, winds = _join_seams(comm, seam, wraps)

    pieces.winds[roots] = winds
    moves = np.zeros((count, 2), np.int32)
    moves[roots] = move
    pieces.shift += moves[pieces.parent]
    numbers = _number(comm, below, pieces, (roots, own_key, key))
    return Labels(
        comm=comm, starts=np.asarray(starts), columns=mask.shape[1], connectivity=connectivity,
        runs=runs, first=first, fragment=fragment, covered=covered, shift=pieces.shift, **numbers,
    )  # fmt: skip


@dataclass
class _Seam:
    """The two outer rows of a group of neighbouring ranks, with the m pieces that touch them."""

    top: np.ndarray  # piece of each run of the row above the group
    top_shift: np.ndarray  # (runs, 2) cells to add to coordinates to have them in the frame of the piece
    bottom: np.ndarray  # the same for the last row of the group
    bottom_shift: np.ndarray
    key: np.ndarray  # (m,) lowest key of the pieces joined so far
    winds: np.ndarray  # (m, 2) bool


def _join_seams(comm: MPI.Comm, seam: _Seam, wraps: bool) -> Answer:
    """Join the pieces at all seams: key, shift (to the frame of the patch) and winds of this rank's m.  Collective."""
    joined = []
    step = 1
    while step < comm.size and comm.rank % (2 * step) == 0:
        if comm.rank + step < comm.size:
            joint = _Joint(seam, comm.recv(source=comm.rank + step))
            joined.append((comm.rank + step, joint))
            seam = joint.seam
        step *= 2
    if comm.rank == 0:
        answer = _close(seam) if wraps else (seam.key, np.zeros((len(seam.key), 2), np.int32), seam.winds)
    else:
        comm.send(seam, comm.rank - step)
        answer = comm.recv(source=comm.rank - step)
    for partner, joint in reversed(joined):
        answer, other = joint.resolve(answer)
        comm.send(other, partner)
    return answer


class _Joint:
    """Two groups, `upper` just above `lower`, joined: `seam` is what the pair shows to the outside."""

    def __init__(self, upper: _Seam, lower: _Seam):
        self.split = split = len(upper.key)
        self.sets = sets = PeriodicSets(split + len(lower.key))
        sets.winds[:] = np.concatenate([upper.winds, lower.winds])
        sets.unite(upper.bottom, lower.top + split, upper.bottom_shift - lower.top_shift)
        self.key = np.concatenate([upper.key, lower.key])
        np.minimum.at(self.key, sets.parent, self.key.copy())
        bottom = lower.bottom + split
        outer = sets.parent[np.concatenate([upper.top, bottom])]
        self.open, at = np.unique(outer, return_inverse=True)  # the others are complete: nothing outside touches them
        self.seam = _Seam(at[: len(upper.top)], upper.top_shift + sets.shift[upper.top],
                          at[len(upper.top) :], lower.bottom_shift + sets.shift[bottom],
                          self.key[self.open], sets.winds[self.open])  # fmt: skip

    def resolve(self, answer: Answer) -> tuple[Answer, Answer]:
        """Key, shift and winds of the pieces of the upper and of the lower group, given those of the open ones."""
        key, winds = self.key, self.sets.winds
        move = np.zeros_like(self.sets.shift)
        key[self.open], move[self.open], winds[self.open] = answer
        parent = self.sets.parent
        whole = key[parent], self.sets.shift + move[parent], winds[parent]
        a, b, c = (np.split(part, [self.split]) for part in whole)
        return (a[0], b[0], c[0]), (a[1], b[1], c[1])


def _close(seam: _Seam) -> Answer:
    """Join the last row of the grid to the row above its first one, which is the same row one cell further up."""
    sets = PeriodicSets(len(seam.key))
    sets.winds[:] = seam.winds
    sets.unite(seam.bottom, seam.top, seam.bottom_shift - seam.top_shift + np.array([1, 0], np.int32))
    key = seam.key.copy()
    np.minimum.at(key, sets.parent, seam.key)
    return key[sets.parent], sets.shift, sets.winds[sets.parent]


def _number(
    comm: MPI.Comm, below: int, pieces: PeriodicSets, seam: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> dict[str, Any]:
    """Number the patches: entries of `Labels`.  Collective.

    below: number of pieces with a pixel of this rank; seam: pieces at seams, their keys, those of patches.
    """
    roots, own_key, key = seam
    kept = pieces.parent[:below] == np.arange(below, dtype=pieces.parent.dtype)
    kept[roots[(key != own_key) & (roots < below)]] = False
    kept_roots = np.flatnonzero(kept)
    kept_counts = np.array(comm.allgather(len(kept_roots)))

    elsewhere = (key != own_key) & (roots < below)
    foreign, at = np.unique(key[elsewhere], return_inverse=True)  # in the order of the ranks that keep them
    number = np.full(len(pieces.parent), -1, pieces.parent.dtype)
    number[kept_roots] = np.arange(len(kept_roots))
    number[roots[elsewhere]] = len(kept_roots) + at

    send_counts = np.bincount(foreign >> _RANK_BITS, minlength=comm.size)
    return_counts = np.empty_like(send_counts)
    comm.Alltoall(send_counts, return_counts)
    asked = _exchange(comm, foreign & ((1 << _RANK_BITS) - 1), send_counts, return_counts)
    returned = number[asked].astype(np.int64)
    label = returned + 1 + kept_counts[: comm.rank].sum()
    return {
        "count": int(kept_counts.sum()),
        "patch": number[pieces.parent],
        "kept_counts": kept_counts,
        "winds": pieces.winds[kept_roots],
        "foreign": _exchange(comm, label, return_counts, send_counts),
        "send_counts": send_counts,
        "returned": returned,
        "return_counts": return_counts,
    }


def _exchange(comm: MPI.Comm, values: np.ndarray, counts: np.ndarray, back: np.ndarray) -> np.ndarray:
    """Send counts[r] rows of `values` to each rank r in turn, receive back[r] rows from it.  Collective."""
    values = np.ascontiguousarray(values)
    out = np.empty((int(back.sum()), *values.shape[1:]), values.dtype)
    width = int(np.prod(values.shape[1:], dtype=int))
    comm.Alltoallv([values, counts * width], [out, back * width])
    return out


def patch_table(
    labels: Labels,
    spacing: tuple[float, float],
    pressure: np.ndarray | None = None,
    line: tuple[np.ndarray, np.ndarray] | None = None,
    highest: float = math.inf,
) -> dict[str, np.ndarray]:
    """Measure all patches: columns (count,) as `contact_patches` describes them, in the order of the labels, on rank 0;
    none on the others.  Collective.

    `pressure`: (rows, columns) float32 or float64, the slab of this rank; without it no column of loads or pressures.
    `spacing` = (ax, ay).  An edge of a pixel counts ay across x, ax across y.  An extent is the length of the shortest
    interval of the periodic axis that holds the patch.
    `line`: area beyond that of the pixels and length of the contact line of each patch that this rank keeps; without it
    no corrected columns.  `highest`: the largest pressure that the law admits (see `contact_area`).

    A patch percolates in x if, followed from pixel to pixel over the edges of the cell, it arrives at a periodic image
    of itself that is displaced along x (whatever the displacement along y), that is if the unrolled patch has no end
    along x.  Reaching from one edge of the cell to the other is neither enough nor needed.
    Raises ValueError if the pressure does not have the shape of the mask.
    """
    rows = len(labels.first) - 2
    with raise_together(labels.comm):
        if pressure is not None and pressure.shape != (rows, labels.columns):
            raise ValueError(f"the pressure has shape {pressure.shape}, the labels ({rows}, {labels.columns})")
    columns = shapes = _shape_columns(labels, spacing)
    load = np.zeros(labels.kept)
    if pressure is not None:
        total, peak = _pressures(labels, pressure)
        load = total * (spacing[0] * spacing[1])
        columns = columns | {"load": load, "mean_pressure": load / shapes["area"], "peak_pressure": peak}
    if line is not None:
        inside = shapes["area"] + line[0]
        none = inside <= 0  # of a pixel or two, close to other patches: as in `contact_area`
        columns = columns | {
            "area_corrected": np.maximum(np.where(none, shapes["area"], inside), load / highest),
            "perimeter_corrected": np.where(none, shapes["perimeter"], line[1]),
        }
    table = {name: _gather(labels, columns.pop(name)) for name in list(columns)}
    return {"patch": np.arange(1, labels.count + 1), **table} if labels.comm.rank == 0 else {}


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


def _gather(labels: Labels, column: np.ndarray) -> np.ndarray:
    """One column of the table on rank 0, in the order of the labels; empty elsewhere.  Collective."""
    out = np.empty(labels.count if labels.comm.rank == 0 else 0, column.dtype)
    labels.comm.Gatherv(np.ascontiguousarray(column), [out, labels.kept_counts])
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
