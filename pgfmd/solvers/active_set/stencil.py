"""A short-ranged kernel between the points of a set, summed in real space."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np

from pgfmd.grid.kernels import jit, u
from pgfmd.solvers.active_set.unknowns import HALO, Part, Points, SetVector

Symbol = Callable[[np.ndarray], np.ndarray]
"""Of an operator: its factor on a mode of wave number |q|, for an array of |q|."""
Vector = tuple[np.ndarray, Points]  # values (count,) on a set, and its points

RADIUS = HALO  # pixels along the axes
OFFSETS = tuple((i, j) for i in range(RADIUS + 1) for j in range(RADIUS + 1) if i * i + j * j <= RADIUS**2 + 1)
"""Of the 37 points within √10 pixels, those to the right of and below the centre."""
ROWS = 32  # evaluated together: with `RADIUS` rows more on each side they stay in cache


def power_of(half_space: Symbol) -> tuple[float, int]:
    """The c and the power n = ±1 of a half-space's stiffness or compliance, c |q|ⁿ."""
    one, two = (float(half_space(np.array(q))) for q in (1.0, 2.0))
    return one, 1 if two > one else -1


@lru_cache(maxsize=64)
def lattice_kernel(spacing: tuple[float, float], power: int, screen: float = 0.0) -> np.ndarray:
    """Real-space values of (|q|² + screen²)^(power/2) on the pixel lattice, (7, 7), zero beyond √10 pixels; to read.  A
    grid of 64 × 64 serves: a short-ranged kernel does not depend on the cell.
    """
    n = 64
    ax, ay = spacing
    q = np.hypot(2 * np.pi * np.fft.fftfreq(n, ax)[:, None], 2 * np.pi * np.fft.rfftfreq(n, ay)[None, :])
    kernel = np.fft.irfft2(np.hypot(q, screen) ** power, s=(n, n))
    return symmetric_kernel([kernel[offset] for offset in OFFSETS])


def symmetric_kernel(values: Sequence[float]) -> np.ndarray:
    """The kernel (7, 7), even in both directions, with these values at `OFFSETS`."""
    kernel = np.zeros((2 * RADIUS + 1, 2 * RADIUS + 1))
    for (i, j), value in zip(OFFSETS, values, strict=True):
        kernel[np.ix_([RADIUS - i, RADIUS + i], [RADIUS - j, RADIUS + j])] = value
    return kernel


class Stencil:
    """z = S K Sᵀ r: S restricts to a set of points, K is a `lattice_kernel`."""

    def __init__(self, kernel: np.ndarray) -> None:
        self.weights = kernel[RADIUS:, RADIUS:].astype(np.float32)

    def apply(self, values: SetVector, out: np.ndarray) -> None:
        """out (count,) = the kernel applied to `values`.  Collective."""
        values.exchange()
        self.sum(values, out)

    def sum(self, values: SetVector, out: np.ndarray) -> None:
        """The same for values whose halo is present."""
        points = values.points
        vector, (rows, ny) = (values.all, points.extended), points.grid.local_shape
        wraps = points.grid.domain.wraps

        def part(first: int, stop: int) -> None:
            work = np.empty((ROWS + 2 * RADIUS, ny + 2 * RADIUS), np.float32)
            correlate(vector, (self.weights, wraps), work, points.lists, (first, stop), out)

        points.grid.threads.deal(part, rows)


@jit
def correlate(
    vector: Vector, kernel: tuple[np.ndarray, bool], rows: np.ndarray, targets: Points, part: Part, out: np.ndarray
) -> None:
    """out[k] = Σ_st w[s, t] field[i + s, columns[k] + t] at the points k of the rows first ≤ i < stop of one set.  The
    field is a vector (values, points) on another set, 0 elsewhere; row i of `targets` is row i + 3 of the field's
    points.

    kernel: weights w[|s|, |t|], those of `OFFSETS`, the others are 0; whether the field is periodic along rows.
    rows (n + 6, ny + 6): work space for n rows at a time.
    Points next to each other are evaluated by a vectorised loop.
    """
    values, (sources, begins) = vector
    columns, offsets = targets
    weights, wraps = kernel
    a, b, c, d = weights[0, 0], weights[0, 1], weights[0, 2], weights[0, 3]
    e, f, g, h = weights[1, 0], weights[1, 1], weights[1, 2], weights[1, 3]
    k20, k21, k22, k30, k31 = weights[2, 0], weights[2, 1], weights[2, 2], weights[3, 0], weights[3, 1]
    ny, batch = rows.shape[1] - 6, rows.shape[0] - 6
    for low in range(part[0], part[1], batch):
        count = min(batch, part[1] - low)
        for i in range(count + 6):
            row = rows[i]
            row[:] = 0
            for k in range(begins[low + i], begins[low + i + 1]):
                row[u(sources[k] + 3)] = values[k]
            for j in range(3 if wraps else 0):
                row[2 - j], row[ny + 3 + j] = row[ny + 2 - j], row[3 + j]
        for i in range(count):
            n, o, p, q, r, s, t = rows[i], rows[i + 1], rows[i + 2], rows[i + 3], rows[i + 4], rows[i + 5], rows[i + 6]
            k, end = offsets[low + i], offsets[low + i + 1]
            while k < end:
                stop, shift = k + 1, columns[k] - k
                while stop < end and columns[stop] == shift + stop:
                    stop += 1
                for m in range(k, stop):
                    j = shift + m
                    j0, j1, j2, j3, j4, j5, j6 = u(j), u(j + 1), u(j + 2), u(j + 3), u(j + 4), u(j + 5), u(j + 6)
                    total = a * q[j3] + b * (q[j2] + q[j4]) + c * (q[j1] + q[j5]) + d * (q[j0] + q[j6])
                    total += e * (p[j3] + r[j3]) + f * ((p[j2] + p[j4]) + (r[j2] + r[j4]))
                    total += g * ((p[j1] + p[j5]) + (r[j1] + r[j5])) + h * ((p[j0] + p[j6]) + (r[j0] + r[j6]))
                    total += k20 * (o[j3] + s[j3]) + k21 * ((o[j2] + o[j4]) + (s[j2] + s[j4]))
                    total += k22 * ((o[j1] + o[j5]) + (s[j1] + s[j5]))
                    out[u(m)] = total + k30 * (n[j3] + t[j3]) + k31 * ((n[j2] + n[j4]) + (t[j2] + t[j4]))
                k = stop
