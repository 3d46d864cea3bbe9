"""Exact potentials of a graph: its points are eliminated one after the other, those with few faces first.

Star–mesh elimination adds T's and subtracts nothing (Grassmann, Taksar and Heyman 1985, doi:10.1287/opre.33.5.1107): a
contrast of 1e20 does no harm.  Near closure the graph is almost a tree, and 2 to 8 faces per point are kept.
"""

from typing import NamedTuple

import numpy as np

from pgfmd.observables.flow_graph import Graph
from pgfmd.parallel.compiled import compiled

SPARSE = 4  # faces: the time is judged when only points with more are left
FEW = 20  # when a pass eliminates less than one in so many points, those with one face more may go


class Elimination(NamedTuple):
    """The faces of n points to those that are eliminated later."""

    order: np.ndarray  # (n,) the points as they are eliminated; `first` and `total` are in this order
    first: np.ndarray  # (n + 1,) first face of each
    other: np.ndarray  # the other point of each face
    weight: np.ndarray  # its T
    total: np.ndarray  # (n,) sum of T of each point, 0 for the last one of a component


class _Lists(NamedTuple):
    """The faces of the n points that are left: a list for each."""

    begin: np.ndarray  # (n,) where it begins
    size: np.ndarray  # (n,) its length
    room: np.ndarray  # (n,) length to which it may grow there
    other: np.ndarray  # the other point of each face
    weight: np.ndarray  # its T


@compiled()
def _packed(lists: _Lists, more: int) -> tuple[_Lists, int]:
    """The lists in a row, each with room for two more faces, and where they end.  The arrays are twice as long, and
    have room for `more` faces besides.
    """
    begin, size, room, other, weight = lists
    at, left = 0, np.flatnonzero(size)
    whole = 2 * (size[left].sum() + 2 * len(left)) + more
    others, weights = np.empty(whole, np.int32), np.empty(whole)
    for i in left:
        others[at : at + size[i]] = other[begin[i] : begin[i] + size[i]]
        weights[at : at + size[i]] = weight[begin[i] : begin[i] + size[i]]
        begin[i], room[i] = at, size[i] + 2
        at += room[i]
    return _Lists(begin, size, room, others, weights), at


@compiled()
def _lists(graph: Graph) -> tuple[_Lists, int]:
    """The lists of all points, faces to the same point joined, and where they end."""
    first, other, weight, _ = graph
    n, at = len(first) - 1, 0
    begin, size, place = np.zeros(n, np.int64), np.zeros(n, np.int32), np.full(n, -1)
    others, weights = np.empty(len(other), np.int32), np.empty(len(other))
    for i in range(n):
        begin[i] = at
        for k in range(first[i], first[i + 1]):
            j = other[k]
            if place[j] >= begin[i]:
                weights[place[j]] += weight[k]
            elif j != i:
                place[j], others[at], weights[at] = at, j, weight[k]
                at += 1
        size[i] = at - begin[i]
    return _packed(_Lists(begin, size, size.copy(), others, weights), 0)


@compiled()
def _longer(values: np.ndarray, count: int) -> np.ndarray:
    """The values, with room for at least `count`."""
    out = np.empty(max(count, len(values) + len(values) // 2), values.dtype)
    out[: len(values)] = values
    return out


@compiled()
def eliminated(graph: Graph, many: int) -> Elimination:
    """The elimination of all points of a graph in compressed rows; an empty one if more than `many` points are left
    when those with up to `SPARSE` faces are gone.
    """
    n = len(graph.first) - 1
    lists, used = _lists(graph)
    begin, size, room, near, t = lists
    order, first, total = np.empty(n, np.int32), np.zeros(n + 1, np.int64), np.zeros(n)
    other, weight = np.empty(8 * n, np.int32), np.empty(8 * n)
    place, left = np.zeros(n, np.int32), np.arange(n).astype(np.int32)
    count, alive, most = 0, n, 2
    while alive > 0:
        kept, before = 0, count
        for m in range(alive):
            k = left[m]
            if size[k] > most:
                left[kept] = k
                kept += 1
                continue
            faces, at = size[k], first[count]
            if at + faces > len(other):
                other, weight = _longer(other, at + faces), _longer(weight, at + faces)
            other[at : at + faces] = near[begin[k] : begin[k] + faces]
            weight[at : at + faces] = t[begin[k] : begin[k] + faces]
            size[k] = 0
            order[count], total[count] = k, weight[at : at + faces].sum()
            for a in range(at, at + faces):
                i, share = other[a], weight[a] / total[count] if total[count] > 0 else 0.0
                if size[i] + faces > room[i]:
                    wanted = size[i] + 2 * faces
                    if used + wanted > len(near):
                        lists, used = _packed(_Lists(begin, size, room, near, t), wanted)
                        begin, size, room, near, t = lists
                    if size[i] + faces > room[i]:
                        near[used : used + size[i]] = near[begin[i] : begin[i] + size[i]]
                        t[used : used + size[i]] = t[begin[i] : begin[i] + size[i]]
                        begin[i], room[i] = used, wanted
                        used += wanted
                low = begin[i]
                for c in range(size[i]):
                    place[near[low + c]] = c
                size[i] -= 1
                near[low + place[k]], t[low + place[k]] = near[low + size[i]], t[low + size[i]]
                place[near[low + place[k]]] = place[k]
                for b in range(at, at + faces):
                    j, c = other[b], place[other[b]]
                    if j == i:
                        continue
                    if c < size[i] and near[low + c] == j:
                        t[low + c] += share * weight[b]
                    else:
                        near[low + size[i]], t[low + size[i]] = j, share * weight[b]
                        size[i] += 1
            count += 1
            first[count] = at + faces
        if FEW * (count - before) < alive:
            most += 1
            if most == SPARSE + 1 and kept > many:
                return Elimination(order[:0], first[:1], other[:0], weight[:0], total[:0])
        alive = kept
    return Elimination(order, first, other[: first[n]].copy(), weight[: first[n]].copy(), total)


@compiled()
def solve_eliminated(found: Elimination, x: np.ndarray) -> np.ndarray:
    """Replaces x by A⁻¹ x, and returns it; the point of a component that was eliminated last has 0."""
    order, first, other, weight, total = found
    for k in range(len(order)):
        i = order[k]
        if total[k] > 0:
            part = x[i] / total[k]
            for a in range(first[k], first[k + 1]):
                x[other[a]] += weight[a] * part
    for k in range(len(order) - 1, -1, -1):
        i = order[k]
        if total[k] > 0:
            for a in range(first[k], first[k + 1]):
                x[i] += weight[a] * x[other[a]]
            x[i] /= total[k]
        else:
            x[i] = 0.0
    return x
