"""Points joined by faces of conductance T: aggregates of points, the graph of these, fluxes.

Aggregates are matched twice (Notay 2010, ETNA 37, 123).  A group of points that hold together strongly must not be
joined to others over weak faces: else its mean is corrected neither by sweeps of Gauss–Seidel nor by the value of its
aggregate (Napov, Notay 2012, doi:10.1137/100818509).  Diagonals are row sums, and the points of an aggregate are
eliminated without subtraction, as those of the coarsest graph are (`elimination`).
"""

from typing import NamedTuple

import numpy as np

from pgfmd.parallel.compiled import compiled

LEFTMOST, RIGHTMOST, BORDER_ABOVE, BORDER_BELOW = 1, 2, 4, 8  # of a point: its column; the cell's border
ACROSS_X, ACROSS_Y = 1, 2  # kinds of faces that cross the border of the cell; negative: backwards
QUALITY = 5.0  # points a and b are joined if T_ab is at least d_a d_b / (QUALITY (d_a + d_b)), where d sums the
# diagonals of the points that each stands for.  Iterations to 1e-8 on rough surfaces of λ_s = 1 and 2 spacings: 5 to
# 12; QUALITY 8: 9 to 14; 16: 12 to 17; no rule: 31 to 67.  Below 4.8 a pair and three points with equal T's stay apart
STRONG = 0.9  # a point is matched if its free neighbour's T is at least this part of its largest


class Graph(NamedTuple):
    """The faces of n points in compressed rows: first (n + 1,), the other point, T, and the kind of border crossed.

    border may be empty where it is not used.

    Or those of a slab of the grid, where `first` is empty: other: n and ny; T to the row before (n + ny,), then to the
    next column (n,), 0 without a face; border: flags of each point.  The faces of point i are 4i up, 4i + 1 left,
    4i + 2 down and 4i + 3 right; copies of the rows around follow own points.
    """

    first: np.ndarray
    other: np.ndarray
    weight: np.ndarray
    border: np.ndarray

    @property
    def points(self) -> int:
        """Number of points."""
        return len(self.first) - 1 if len(self.first) else int(self.other[0])


@compiled(inline="always")
def face_to(graph: Graph, a: int, b: int) -> int:
    """The face of point a, in compressed rows, to point b."""
    c = graph.first[a]
    while graph.other[c] != b:
        c += 1
    return c


@compiled(inline="always")
def span(first: np.ndarray, i: int) -> tuple[int, int]:
    """First face of a point, and the one after its last."""
    return (first[i], first[i + 1]) if len(first) else (4 * i, 4 * i + 4)


@compiled(inline="always")
def face(
    first: np.ndarray, other: np.ndarray, weight: np.ndarray, border: np.ndarray, i: int, k: int
) -> tuple[int, float, int]:
    """The other point, T, and the kind of border crossed of point i's face k in a graph of these arrays."""
    if len(first):
        return int(other[k]), weight[k], int(border[k]) if k < len(border) else 0
    n, ny, flags, side = int(other[0]), int(other[1]), border[i], k & 3
    if side == 0:
        return i - ny if i >= ny else i + n, weight[i], -1 if flags & BORDER_ABOVE else 0
    if side == 2:
        return i + ny if i + ny < n else i + 2 * ny, weight[i + ny], 1 if flags & BORDER_BELOW else 0
    if side == 1:
        left = i + ny - 1 if flags & LEFTMOST else i - 1
        return left, weight[n + ny + left], -2 if flags & LEFTMOST else 0
    return i + 1 - ny if flags & RIGHTMOST else i + 1, weight[n + ny + i], 2 if flags & RIGHTMOST else 0


@compiled(inline="always")
def crossing(border: int, kind: int) -> int:
    """w of a face: 1 or −1 across that border, forwards or backwards, else 0."""
    return 1 if border == kind else -1 if border == -kind else 0


@compiled(inline="always")
def may_join(diagonals: np.ndarray, i: int, j: int, t: float) -> bool:
    """Whether points i and j may be joined: see `QUALITY`."""
    return len(diagonals) == 0 or QUALITY * t * (diagonals[i] + diagonals[j]) >= diagonals[i] * diagonals[j]


@compiled()
def match(
    graph: Graph, sizes: np.ndarray, diagonals: np.ndarray, most: int, over_border: bool
) -> tuple[np.ndarray, int]:
    """The aggregate (n,) of each point, and how many there are: pairs of strong neighbours, joined by points that were
    left, up to `most` in the `sizes` of points.  diagonals: sums of diagonals, see `QUALITY`; empty: without that rule.
    over_border: whether an aggregate may lie on both sides of the cell's border.
    Faces over which points cannot join count too: a point of a pool on both sides must not join what is around it.
    Points of a slab without faces have none, −1.
    """
    first, other, weight, border = graph
    count, n, in_slab = 0, len(sizes), len(first) == 0
    found, whole = np.full(n, -1, np.int32), np.zeros(n, np.int32)
    for i in range(n):
        largest, best, partner = 0.0, 0.0, -1
        low, stop = span(first, i)
        for k in range(low, stop if found[i] < 0 else low):
            j, t, crossed = face(first, other, weight, border, i, k)
            if j != i:
                largest = max(largest, t)
                joins = j < n and (over_border or crossed == 0) and may_join(diagonals, i, j, t)
                if joins and found[j] < 0 and t > best and sizes[i] + sizes[j] <= most:
                    best, partner = t, j
        if partner >= 0 and best >= STRONG * largest:
            found[i] = found[partner] = count
            whole[count] = sizes[i] + sizes[partner]
            count += 1
    for i in range(n):
        best, target = 0.0, -1
        low, stop = span(first, i)
        for k in range(low, stop if found[i] < 0 else low):
            j, t, crossed = face(first, other, weight, border, i, k)
            if j != i and t > best:
                joins = j < n and (over_border or crossed == 0) and may_join(diagonals, i, j, t)
                best, target = t, j if joins else -1
        if found[i] >= 0 or in_slab and best == 0:
            continue
        if target >= 0 and found[target] >= 0 and whole[found[target]] + sizes[i] <= most:
            found[i] = found[target]
            whole[found[i]] += sizes[i]
        else:
            found[i] = count
            whole[count] = sizes[i]
            count += 1
    return found, count


@compiled()
def summed_diagonals(graph: Graph, aggregate: np.ndarray, count: int) -> np.ndarray:
    """Sums of the diagonals of the points of each of `count` aggregates; of each point where `aggregate` is empty."""
    out = np.zeros(count)
    for i in range(graph.other[0] if len(graph.first) == 0 else len(graph.first) - 1):
        a = aggregate[i] if len(aggregate) else i
        low, stop = span(graph.first, i)
        for k in range(low, stop if a >= 0 else low):
            out[a] += face(graph.first, graph.other, graph.weight, graph.border, i, k)[1]
    return out


@compiled()
def grouped(aggregate: np.ndarray, n: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The first n points ordered by their aggregate, and where each aggregate begins (count + 1,)."""
    begin = np.zeros(count + 1, np.int32)
    for i in range(n):
        begin[aggregate[i] + 1] += aggregate[i] >= 0
    begin = np.cumsum(begin).astype(np.int32)
    place, order = begin[:-1].copy(), np.empty(begin[-1], np.int32)
    for i in range(n):
        a = aggregate[i]
        if a >= 0:
            order[place[a]] = i
            place[a] += 1
    return order, begin


@compiled()
def coarsened(graph: Graph, aggregate: np.ndarray, count: int) -> Graph:
    """The graph of `count` aggregates; aggregate: of own points, then of copies.  T's add up; a face crosses a border
    if all those that it stands for do.
    """
    first, other, weight, border = graph
    n = len(first) - 1 if len(first) else len(border)
    order, begin = grouped(aggregate, n, count)
    most, at = len(weight) if len(first) else 4 * n, 0
    firsts, others, weights = np.zeros(count + 1, np.int64), np.empty(most, np.int32), np.empty(most)
    borders, seen = np.empty(most, np.int8), np.full(aggregate.max() + 1 if len(aggregate) else 0, -1)
    for a in range(count):
        for m in range(begin[a], begin[a + 1]):
            i = order[m]
            low, stop = span(first, i)
            for k in range(low, stop):
                j, t, crossed = face(first, other, weight, border, i, k)
                b = aggregate[j]
                if b == a or t == 0:
                    continue
                if seen[b] < firsts[a]:
                    seen[b], others[at], weights[at], borders[at] = at, b, 0.0, crossed
                    at += 1
                weights[seen[b]] += t
                if crossed == 0:
                    borders[seen[b]] = 0
        firsts[a + 1] = at
    return Graph(firsts, others[:at], weights[:at], borders[:at])  # what is not written takes no memory


@compiled()
def unrolled(graph: Graph, aggregate: np.ndarray, kind: int) -> np.ndarray:
    """A u with u_j − u_i + w = 0 on the faces of a tree within each aggregate."""
    n = len(aggregate)
    out, seen, stack = np.zeros(n), np.zeros(n, np.bool_), np.empty(n, np.int32)
    for begin in range(n):
        height = 0 if seen[begin] else 1
        stack[0], seen[begin] = begin, True
        while height > 0:
            height -= 1
            i = stack[height]
            for k in range(graph.first[i], graph.first[i + 1]):
                j = graph.other[k]
                if not seen[j] and aggregate[j] == aggregate[i]:
                    out[j] = out[i] - crossing(graph.border[k], kind)
                    stack[height], seen[j] = j, True
                    height += 1
    return out


@compiled()
def eliminate(table: np.ndarray, n: int) -> None:
    """Star–mesh elimination of n points, from the last to the first, without subtraction: row k then holds T to the
    points before it when it is eliminated, and their sum on the diagonal, which is 0 before.
    """
    for k in range(n - 1, -1, -1):
        for j in range(k):
            table[k, k] += table[k, j]
        for i in range(k if table[k, k] > 0 else 0):
            share = table[k, i] / table[k, k]
            for j in range(k if share > 0 else 0):
                if j != i:
                    table[i, j] += share * table[k, j]


@compiled()
def back_substitute(table: np.ndarray, n: int, x: np.ndarray) -> np.ndarray:
    """Replaces x by A⁻¹ x, by an elimination of n points, and returns it; 0 at the first point of a component."""
    for k in range(n - 1, -1, -1):
        for i in range(k if table[k, k] > 0 else 0):
            x[i] += table[k, i] / table[k, k] * x[k]
    for k in range(n):
        for j in range(k):
            x[k] += table[k, j] * x[j]
        x[k] = x[k] / table[k, k] if table[k, k] > 0 else 0.0
    return x


@compiled(inline="always")
def place(order: np.ndarray, before: int, i: int) -> int:
    """How far after `before` a point comes in an order."""
    m = 0
    while order[before + m] != i:
        m += 1
    return m


@compiled()
def shared_flux(graph: Graph, coarse: Graph, above: np.ndarray, aggregate: np.ndarray, r: np.ndarray) -> np.ndarray:
    """A flux with Σ_j f_ij = r_i on the faces of a graph in compressed rows: `above`, that of the graph `coarse` of
    aggregates, in proportion to T between these, and the least that balances the rest within each.
    """
    first, other, weight, _ = graph
    flux = np.zeros(len(weight))
    order, begin = grouped(aggregate, len(r), len(coarse.first) - 1)
    largest = np.diff(begin).max() if len(begin) > 1 else 0
    table, target = np.empty((largest, largest)), np.empty(largest)
    for a in range(len(begin) - 1):
        n, before = begin[a + 1] - begin[a], begin[a]
        table[:n, :n] = 0.0
        for m in range(n):
            i = order[before + m]
            target[m] = r[i]
            for k in range(first[i], first[i + 1]):
                j, t, b = other[k], weight[k], aggregate[other[k]]
                if b == a and j != i:
                    table[m, place(order, before, j)] += t
                if b == a or t == 0:
                    continue
                c = face_to(coarse, a, b)
                flux[k] = above[c] * (t / coarse.weight[c])
                target[m] -= flux[k]
        eliminate(table, n)
        back_substitute(table, n, target)
        for m in range(n):
            i = order[before + m]
            for k in range(first[i], first[i + 1]):
                if aggregate[other[k]] == a:
                    flux[k] = weight[k] * (target[m] - target[place(order, before, other[k])])
    return flux


@compiled()
def shared_flux_in_slab(
    graph: Graph, coarse: Graph, above: np.ndarray, aggregate: np.ndarray, r: np.ndarray, flux: np.ndarray
) -> float:
    """The same on a graph of a slab; returns Σ f²/T over the faces of all points, each counted for both.  flux: filled
    unless empty, with the faces down and right of each point in turn.  Without the function `face`, which serves both
    kinds of graphs, this takes a quarter of the time.
    """
    _, other, weight, border = graph
    points, ny = int(other[0]), int(other[1])
    order, begin = grouped(aggregate, len(r), len(coarse.first) - 1)
    largest, total = np.diff(begin).max() if len(begin) > 1 else 0, 0.0
    table, target = np.empty((largest, largest)), np.empty(largest)
    inner, known = np.empty((largest, 4), np.int64), np.empty((largest, 4))  # place in the aggregate or −1, and T
    shares = np.empty(coarse.other.max() + 1 if len(coarse.other) else 0)  # flux over T of the faces to each aggregate
    for a in range(len(begin) - 1):
        n, before = begin[a + 1] - begin[a], begin[a]
        for c in range(coarse.first[a], coarse.first[a + 1]):
            shares[coarse.other[c]] = above[c] / coarse.weight[c]
        table[:n, :n] = 0.0
        for m in range(n):
            i = order[before + m]
            target[m] = r[i]
            left = i + ny - 1 if border[i] & LEFTMOST else i - 1
            for side in range(4):
                if side == 0:
                    j, t = i - ny if i >= ny else i + points, weight[i]
                elif side == 1:
                    j, t = left, weight[points + ny + left]
                elif side == 2:
                    j, t = i + ny if i + ny < points else i + 2 * ny, weight[i + ny]
                else:
                    j, t = i + 1 - ny if border[i] & RIGHTMOST else i + 1, weight[points + ny + i]
                inner[m, side], known[m, side] = -1, t
                if t == 0 or j == i:
                    continue
                if aggregate[j] == a:
                    inner[m, side] = place(order, before, j)
                    table[m, inner[m, side]] += t
                else:
                    f = shares[aggregate[j]] * t
                    target[m] -= f
                    total += f * f / t
                    if len(flux) and side & 2:
                        flux[2 * i + (side & 1)] = f
        eliminate(table, n)
        back_substitute(table, n, target)
        for m in range(n):
            for side in range(4):
                if inner[m, side] >= 0:
                    difference = target[m] - target[inner[m, side]]
                    total += known[m, side] * difference * difference
                    if len(flux) and side & 2:
                        flux[2 * order[before + m] + (side & 1)] = known[m, side] * difference
    return total
