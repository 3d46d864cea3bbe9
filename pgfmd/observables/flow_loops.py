"""Compiled loops over the points of a graph: residuals, sweeps of Gauss–Seidel, energies, sums over aggregates.

Vectors x, target, r hold own points, then copies of those of the ranks around; aggregate: of each of these, or empty.
"""

import numpy as np

from pgfmd.observables.flow_graph import ACROSS_X, ACROSS_Y, BORDER_BELOW, Graph
from pgfmd.parallel.compiled import compiled


@compiled()
def residual(graph: Graph, target: np.ndarray, x: np.ndarray, aggregate: np.ndarray, out: np.ndarray) -> None:
    """out = target − Ax, or added up over aggregates unless these are empty; target: 0 if empty."""
    for i in range(len(graph.first) - 1):
        total = target[i] if len(target) else 0.0
        for k in range(graph.first[i], graph.first[i + 1]):
            total += graph.weight[k] * (x[graph.other[k]] - x[i])
        if len(aggregate):
            out[aggregate[i]] += total
        else:
            out[i] = total


@compiled()
def residual_in_slab(graph: Graph, target: np.ndarray, x: np.ndarray, aggregate: np.ndarray, out: np.ndarray) -> None:
    """The same of a graph of a slab, row by row; products in double precision, so that r drifts less (numba's
    float() leaves a single-precision number as it is)."""
    n, ny = graph.other
    line = np.empty(ny)
    for begin in range(0, n, ny):
        own, after = x[begin : begin + ny], begin + (2 * ny if begin + ny == n else ny)
        before = begin - ny if begin else n
        up, down = graph.weight[begin : begin + ny], graph.weight[begin + ny : begin + 2 * ny]
        right, above, below = graph.weight[n + ny + begin : n + begin + 2 * ny], x[before : before + ny], x[after:]
        for j in range(ny):
            line[j] = np.float64(up[j]) * (above[j] - own[j]) + np.float64(down[j]) * (below[j] - own[j])
        for j in range(1, ny):
            line[j] += np.float64(right[j - 1]) * (own[j - 1] - own[j])
        for j in range(ny - 1):
            line[j] += np.float64(right[j]) * (own[j + 1] - own[j])
        across = np.float64(right[ny - 1]) * (own[0] - own[ny - 1])
        line[ny - 1] += across
        line[0] -= across
        if len(target):
            for j in range(ny):
                line[j] += target[begin + j]
        if len(aggregate):
            for j in range(ny):
                if aggregate[begin + j] >= 0:
                    out[aggregate[begin + j]] += line[j]
        else:
            out[begin : begin + ny] = line


@compiled()
def relax(graph: Graph, inverse: np.ndarray, target: np.ndarray, x: np.ndarray, backward: bool) -> None:
    """A sweep of Gauss–Seidel over own points, forward or backward."""
    count = len(inverse)
    for step in range(count):
        i = count - 1 - step if backward else step
        total = target[i]
        for k in range(graph.first[i], graph.first[i + 1]):
            total += graph.weight[k] * x[graph.other[k]]
        x[i] = total * inverse[i]


@compiled()
def relax_in_slab(graph: Graph, target: np.ndarray, x: np.ndarray, backward: bool) -> None:
    """The same of a graph of a slab: of each row first what does not depend on the sweep along it."""
    n, ny = graph.other
    line, factor, left = np.empty(ny), np.empty(ny), np.empty(ny)
    for step in range(0, n, ny):
        begin = n - ny - step if backward else step
        own, after = x[begin : begin + ny], begin + (2 * ny if begin + ny == n else ny)
        before = begin - ny if begin else n
        up, down = graph.weight[begin : begin + ny], graph.weight[begin + ny : begin + 2 * ny]
        right, above, below = graph.weight[n + ny + begin : n + begin + 2 * ny], x[before : before + ny], x[after:]
        left[1:] = right[:-1]
        left[0] = right[ny - 1]
        for j in range(ny):
            diagonal = up[j] + down[j] + left[j] + right[j]
            inverse = 1 / diagonal if diagonal > 0 else 0.0
            line[j] = (target[begin + j] + up[j] * above[j] + down[j] * below[j]) * inverse
            factor[j] = inverse
        if backward:
            for j in range(1, ny):
                line[j] += left[j] * factor[j] * own[j - 1]
            value = own[0]
            for j in range(ny - 1, 0, -1):
                value = line[j] + right[j] * factor[j] * value
                own[j] = value
            own[0] = line[0] + factor[0] * (left[0] * own[ny - 1] + right[0] * own[1 % ny])
        else:
            for j in range(ny - 1):
                line[j] += right[j] * factor[j] * own[j + 1]
            value = own[ny - 1]
            for j in range(ny - 1):
                value = line[j] + left[j] * factor[j] * value
                own[j] = value
            last = ny - 1
            own[last] = line[last] + factor[last] * (left[last] * own[last - 1] + right[last] * own[0])


@compiled()
def form_in_slab(graph: Graph, kind: int, a: np.ndarray, b: np.ndarray) -> float:
    """Σ T (a_j − a_i + w)(b_j − b_i + w) over the faces to the next row and the next column of a slab."""
    (n, ny), total = graph.other, 0.0
    for begin in range(0, n, ny):
        end, of_row = begin + ny, 0.0
        after, w = end if end < n else n + ny, 1 if graph.border[begin] & BORDER_BELOW and kind == ACROSS_X else 0
        down, right = graph.weight[end : end + ny], graph.weight[n + end : n + end + ny]
        a_row, a_next, b_row, b_next = a[begin:end], a[after : after + ny], b[begin:end], b[after : after + ny]
        for j in range(ny):
            of_row += down[j] * (a_next[j] - a_row[j] + w) * (b_next[j] - b_row[j] + w)
        for j in range(ny - 1):
            of_row += np.float64(right[j]) * (a_row[j + 1] - a_row[j]) * (b_row[j + 1] - b_row[j])
        w = 1 if kind == ACROSS_Y else 0
        total += of_row + right[ny - 1] * (a_row[0] - a_row[ny - 1] + w) * (b_row[0] - b_row[ny - 1] + w)
    return total


@compiled()
def restrict(values: np.ndarray, aggregate: np.ndarray, n: int, out: np.ndarray) -> None:
    """Adds the values of the first n points up over their aggregates."""
    for i in range(n):
        if aggregate[i] >= 0:
            out[aggregate[i]] += values[i]


@compiled()
def prolong(coarse: np.ndarray, aggregate: np.ndarray, n: int, out: np.ndarray) -> None:
    """Adds the value of its aggregate to each of the first n points."""
    for i in range(n):
        if aggregate[i] >= 0:
            out[i] += coarse[aggregate[i]]


@compiled()
def add_scaled(a: np.ndarray, factor: float, b: np.ndarray, out: np.ndarray) -> None:
    """out = a + factor · b."""
    for i in range(len(a)):
        out[i] = a[i] + factor * b[i]
