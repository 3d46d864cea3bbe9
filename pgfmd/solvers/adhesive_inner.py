"""Conjugate gradients for the directions of adhesive contacts, preconditioned by the compliance between free points."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from pgfmd.grid.kernels import jit, u
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transforms import ColumnAction, RowAction, source
from pgfmd.solvers.adhesive_model import Actions, AdhesiveModel

MOST_INNER = 200
Pair = tuple[np.ndarray, np.ndarray]
Steps = list[tuple[float, float]]
Enough = Callable[[float, float, Steps], bool]


def apply(
    grid: SlabGrid, action: ColumnAction, fill: RowAction, drain: Callable[[np.ndarray, slice], tuple[float, float]]
) -> np.ndarray:
    """Sums of what `drain` returns of the rows of a convolution in single precision.  Collective."""
    parts: dict[int, tuple[float, float]] = {}

    def take(first: int, stop: int, rows: np.ndarray) -> None:
        parts[first] = drain(rows, slice(first, stop))

    grid.convolve(fill, action, take, np.float32)
    return grid.reduction.sums_of_blocks(parts, 2)


def conjugate_gradients(
    model: AdhesiveModel, start: np.ndarray, weight: np.ndarray, actions: Actions, enough: Enough,
    most: int = MOST_INNER,
) -> tuple[np.ndarray, bool, float, Steps]:  # fmt: skip
    """(K − weight)x = start on the free points, until enough(first ⟨r, Gr⟩ per point, the share left of it, steps);
    with firm points all are unknowns.  start becomes what is left of it.  Returns x, whether `model.search` is now a
    direction of negative curvature, the first ⟨r, Gr⟩ per point, and (step, ratio) of each iteration, which give the
    spectrum.  Collective.
    """
    grid, z, d, (soften, stiffen, fixed, firm) = model.grid, model.image, model.search, actions
    free = np.ones_like(model.free) if firm else model.free
    threads, rows, inverse = grid.threads, len(free), 1 / model.count if fixed and model.count else 0.0
    residual, x, steps = start, grid.new_field(np.float32), Steps()
    x[...] = d[...] = 0

    def inner(first: int, stop: int, rows: np.ndarray) -> None:
        np.multiply(residual[first:stop], model.free[first:stop], out=rows)

    def softened(rows: np.ndarray, s: slice) -> tuple[float, float]:
        if firm:
            np.divide(residual[s], -weight[s], out=rows, where=~model.free[s])
        return masked(rows, residual[s], free[s], z[s])

    def precondition() -> tuple[float, float]:
        square, total = apply(grid, soften, inner if firm else source(residual), softened)
        return max(square, 0.0), total * inverse

    square, mean = precondition()
    first, before = square, math.inf
    for _ in range(most):
        if not square > 0 or enough(first / grid.size, square / first, steps):
            break
        turn = np.float32(square / before), np.float32(mean)
        threads.deal(lambda a, b, t=turn: turned(d[a:b], z[a:b], free[a:b], t), rows)  # type: ignore[misc]
        bend, total = apply(grid, stiffen, source(d), lambda r, s: bent(r, d[s], weight[s], free[s], z[s]))
        if not bend > 0:
            return x, True, first / grid.size, steps
        step, before = square / bend, square
        move = np.float32(step), np.float32(total * inverse)
        threads.deal(
            lambda a, b, m=move: advanced((x[a:b], residual[a:b]), (d[a:b], z[a:b]), free[a:b], m), rows  # type: ignore[misc]
        )
        square, mean = precondition()
        steps.append((step, square / before))
    return x, False, first / grid.size, steps


def least_ritz(steps: Steps) -> tuple[float, float]:
    """The smallest eigenvalue of the tridiagonal matrix of conjugate gradients, an estimate from above of that of the
    preconditioned operator; and the norm of the residual, within which that has an eigenvalue.
    """
    if not steps:  # nothing is free
        return 1.0, 0.0
    from scipy.linalg import eigh_tridiagonal

    lengths, ratios = np.array(steps).T
    diagonal, beside = 1 / lengths, np.sqrt(ratios) / lengths
    diagonal[1:] += ratios[:-1] / lengths[:-1]
    values, vectors = eigh_tridiagonal(diagonal, beside[:-1], select="i", select_range=(0, 0))
    return float(values[0]), float(beside[-1] * abs(vectors[-1, 0]))


def decrement(first: float, steps: Steps, floor: float) -> float:
    """Largest ⟨r, A⁻¹r⟩ for A ≥ floor · P⁻¹, P the preconditioner: of the first ⟨r, Pr⟩ and the steps of conjugate
    gradients with A, ⟨r, x⟩ and the share of what is left.
    """
    found = 0.0
    for step, ratio in steps:
        found, first = found + step * first, first * ratio
    return found + first / floor


@jit
def masked(rows: np.ndarray, residual: np.ndarray, free: np.ndarray, out: np.ndarray) -> tuple[float, float]:
    """out = rows on free points, else 0; returns Σ residual · out and Σ out."""
    square, total = np.float64(0), np.float64(0)
    for i in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            value = rows[i, u(j)] if free[i, u(j)] else np.float32(0)
            out[i, u(j)] = value
            square += np.float64(value) * residual[i, u(j)]
            total += value
    return square, total


@jit
def bent(
    rows: np.ndarray, direction: np.ndarray, weight: np.ndarray, free: np.ndarray, out: np.ndarray
) -> tuple[float, float]:
    """out = rows − weight · direction on free points, else 0; returns Σ direction · out and Σ out."""
    square, total = np.float64(0), np.float64(0)
    for i in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            d = direction[i, u(j)]
            value = rows[i, u(j)] - weight[i, u(j)] * d if free[i, u(j)] else np.float32(0)
            out[i, u(j)] = value
            square += np.float64(value) * d
            total += value
    return square, total


@jit
def turned(direction: np.ndarray, z: np.ndarray, free: np.ndarray, turn: tuple[float, float]) -> None:
    """direction = z − mean + ratio · direction on free points; turn: (ratio, mean)."""
    for i in range(z.shape[0]):
        for j in range(z.shape[1]):
            value = z[i, u(j)] - turn[1] + turn[0] * direction[i, u(j)]
            direction[i, u(j)] = value if free[i, u(j)] else np.float32(0)


@jit
def advanced(pair: Pair, moved: Pair, free: np.ndarray, move: tuple[float, float]) -> None:
    """x += step · d, r −= step · (image − mean) on free points; pair: (x, r), moved: (d, image), move: (step, mean)."""
    x, r = pair
    d, image = moved
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            x[i, u(j)] += move[0] * d[i, u(j)]
            change = move[0] * (image[i, u(j)] - move[1])
            r[i, u(j)] -= change if free[i, u(j)] else np.float32(0)
