"""Compiled loops on the runs of a mask: its rows cut into runs of set pixels, joined into connected fragments.

A mask is labelled through its runs, not its pixels: sixteen bytes per run (at most 0.5 runs per pixel, 0.24 in white
noise of density 0.4), and neither a label field nor a second pass over the pixels.  Union–find with halved paths:
Tarjan and van Leeuwen, doi:10.1145/62.2160.

Shape symbols: `rows × columns` is the mask, `n` its number of runs; row i holds the runs first[i] … first[i+1] − 1,
ordered by column; runs[k] = (start, stop), the stop excluded.  No MPI here.
"""

from typing import Any

import numpy as np

from pgfmd.parallel.compiled import compiled


def find_runs(above: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Runs of the row `above` (columns,) and then of `mask` (rows, columns), both bool.

    Returns `runs` (n, 2) int32 and `first` (rows + 2,) int64: the row above is row 0, row i of the mask is row i + 1.
    """
    above, mask = above.view(np.uint8), mask.view(np.uint8)
    first = np.zeros(len(mask) + 2, np.int64)
    _count_runs(above, mask, first)
    edges = np.empty(2 * first[-1] + 1, np.int32)  # one more: the branch-free loop writes one beyond the last edge
    _find_edges(above, mask, edges)
    return edges[:-1].reshape(-1, 2), first


@compiled()
def _count_runs(above: np.ndarray, mask: np.ndarray, first: np.ndarray) -> None:
    """first[1:] = cumulative number of runs, row by row; first[0] stays 0."""
    for i in range(len(first) - 1):
        row = above if i == 0 else mask[i - 1]
        count = np.int64(row[0])
        for j in range(1, len(row)):
            count += row[j] > row[j - 1]
        first[i + 1] = first[i] + count


@compiled()
def _find_edges(above: np.ndarray, mask: np.ndarray, edges: np.ndarray) -> None:
    """Columns where the mask changes, row by row: starts and stops in turn.

    Every column is written, and kept only where the mask changes: no branch that a rough mask would mispredict.
    """
    at = 0
    for i in range(len(mask) + 1):
        row = above if i == 0 else mask[i - 1]
        before = np.uint8(0)
        for j in range(len(row)):
            edges[at] = j
            at += int(row[j] ^ before)
            before = row[j]
        edges[at] = len(row)
        at += int(before)


def find_fragments(runs: np.ndarray, first: np.ndarray, reach: int) -> tuple[np.ndarray, np.ndarray, int, int]:
    """Number the sets of runs that are connected without crossing the edges of the mask.

    `reach` = 1 also connects runs that touch at a corner (8-connectivity), 0 does not.  Fragments are numbered from 0
    by their first pixel below row 0; those with none, which consist of runs of row 0 alone, come last.
    Returns the fragment of each run (n,) int32 (int64 beyond 2³¹ runs), the pixels of each run that have a set pixel
    just above (n,) int32 (0 in row 0), the number of fragments with a pixel below row 0, and the number of all.
    """
    fragment = np.empty(len(runs), np.int32 if len(runs) < 2**31 else np.int64)
    covered = np.zeros(len(runs), np.int32)
    below, count = _find_fragments(runs, first, reach, fragment, covered)
    return fragment, covered, below, count


@compiled(inline="always")
def _root(parent: np.ndarray, k: int) -> int:
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k


@compiled()
def _find_fragments(
    runs: np.ndarray, first: np.ndarray, reach: int, parent: np.ndarray, covered: np.ndarray
) -> tuple[int, int]:
    """Overwrites `parent` and `covered` (n,) with what `find_fragments` returns."""
    for k in range(first[0], first[1]):
        parent[k] = k
    for i in range(1, len(first) - 1):
        u, u_end = first[i - 1], first[i]
        for k in range(first[i], first[i + 1]):
            start, stop = runs[k, 0], runs[k, 1]
            while u < u_end and runs[u, 1] + reach <= start:
                u += 1
            root: Any = np.int64(k)
            overlap = 0
            for v in range(u, u_end):
                if runs[v, 0] >= stop + reach:
                    break
                u = v  # the last run that touches this one may touch the next one too: the scan goes on from it
                overlap += max(0, min(stop, runs[v, 1]) - max(start, runs[v, 0]))
                other = _root(parent, v)
                if root == k:
                    root = other
                elif other != root:
                    root, other = min(root, other), max(root, other)
                    parent[other] = root
            parent[k] = root
            covered[k] = overlap
    for k in range(len(parent)):  # a parent never has the higher number: one ascending pass makes all point to a root
        parent[k] = parent[parent[k]]
    # The number c of a fragment replaces its root's parent as ~c < 0, so that the pass needs no second array.
    below = _number_roots(parent, first[1], len(parent), 0)
    count = _number_roots(parent, 0, first[1], below)
    for k in range(len(parent)):
        parent[k] = ~parent[k]
    return below, count


@compiled(inline="always")
def _number_roots(parent: np.ndarray, begin: int, end: int, count: int) -> int:
    """Give the runs begin … end − 1 the number of their root, which gets the next one, from `count`, if it has none."""
    for k in range(begin, end):
        if parent[k] >= 0:
            root = parent[k]
            if parent[root] >= 0:
                parent[root] = ~count
                count += 1
            parent[k] = parent[root]
    return count


def column_wraps(runs: np.ndarray, first: np.ndarray, columns: int, reach: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of runs that touch across the last column: one that ends there, and one that begins in column 0.

    The rows of a pair are the same or, with `reach` = 1, neighbours.  Returns two int64 arrays of run numbers.
    """
    filled = first[1:] > first[:-1]
    last, left = np.where(filled, first[1:] - 1, -1), np.where(filled, first[:-1], -1)
    ends, begins = filled.copy(), filled
    ends[filled] = runs[last[filled], 1] == columns
    begins[filled] = runs[left[filled], 0] == 0
    pairs = [(last, left, ends & begins)]
    if reach:
        pairs += [(last[1:], left[:-1], ends[1:] & begins[:-1]), (last[:-1], left[1:], ends[:-1] & begins[1:])]
    return np.concatenate([a[both] for a, _, both in pairs]), np.concatenate([b[both] for _, b, both in pairs])


class PeriodicSets:
    """Disjoint sets of pieces of a periodic plane: where each piece lies, and whether a set meets its own image.

    `parent` (m,) int32 or int64 leads to a piece of lower number, the root to itself.  `shift` (m, 2) int32, in cells
    along x and y, is what to add to the coordinates of a piece to have them in the frame of its parent.  `winds`
    (m, 2) bool, at the roots: whether some closed path inside the set ends a non-zero number of cells along x, along y
    from where it began, so that the unrolled set has no end in that direction.
    """

    def __init__(self, count: int):
        self.parent: np.ndarray = np.arange(count, dtype=np.int32 if count < 2**31 else np.int64)
        self.shift = np.zeros((count, 2), np.int32)
        self.winds = np.zeros((count, 2), np.bool_)

    def unite(self, a: np.ndarray, b: np.ndarray, shift: np.ndarray) -> tuple[int, int]:
        """Join pieces a[e] and b[e]: b, moved by shift[e] cells ((edges, 2) integers), touches or overlaps a.  Returns
        the first e that closes a path around the cell along x, and the first along y; len(a) where none does.

        Afterwards every piece points to its root, the lowest number of its set.
        """
        closing = _unite(self.parent, self.shift, self.winds, a, b, shift)
        _flatten(self.parent, self.shift)
        return closing


@compiled()
def _place(parent: np.ndarray, shift: np.ndarray, k: int) -> tuple[int, int, int]:
    """Root of piece k and what to add to the coordinates of k in its frame; halves the path."""
    x = y = 0
    while parent[k] != k:
        up = parent[k]
        shift[k, 0] += shift[up, 0]
        shift[k, 1] += shift[up, 1]
        parent[k] = parent[up]
        x += shift[k, 0]
        y += shift[k, 1]
        k = parent[k]
    return k, x, y


@compiled()
def _unite(
    parent: np.ndarray, shift: np.ndarray, winds: np.ndarray, a: np.ndarray, b: np.ndarray, moved: np.ndarray
) -> tuple[int, int]:
    along_x = along_y = len(a)
    for e in range(len(a)):
        low, ax, ay = _place(parent, shift, a[e])
        high, bx, by = _place(parent, shift, b[e])
        x, y = moved[e, 0] + ax - bx, moved[e, 1] + ay - by  # of the root of b in the frame of the root of a
        if low == high:
            winds[low, 0] |= x != 0
            winds[low, 1] |= y != 0
            along_x, along_y = min(along_x, e if x else len(a)), min(along_y, e if y else len(a))
            continue
        if low > high:
            low, high, x, y = high, low, -x, -y
        parent[high] = low
        shift[high, 0], shift[high, 1] = x, y
        winds[low, 0] |= winds[high, 0]
        winds[low, 1] |= winds[high, 1]
    return along_x, along_y


@compiled()
def _flatten(parent: np.ndarray, shift: np.ndarray) -> None:
    for k in range(len(parent)):
        up = parent[k]
        if up != k:
            parent[k] = parent[up]
            shift[k, 0] += shift[up, 0]
            shift[k, 1] += shift[up, 1]


@compiled()
def paint(runs: np.ndarray, first: np.ndarray, label: np.ndarray, fragment: np.ndarray, out: np.ndarray) -> None:
    """out[i − 1, start … stop − 1] = label[fragment[k]] for each run k of the rows i ≥ 1; overwrites `out`."""
    out[:] = 0
    for i in range(1, len(first) - 1):
        for k in range(first[i], first[i + 1]):
            out[i - 1, runs[k, 0] : runs[k, 1]] = label[fragment[k]]
