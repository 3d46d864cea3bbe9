"""Plain Polonsky–Keer conjugate gradients (Wear 231, 206, 1999) on our own transforms.

It tells the cost of the algorithm from that of the FFT.
"""

import numba
import numpy as np

from pgfmd.grid.transforms import sink, source

_jit = numba.njit(nogil=True, cache=True, fastmath={"reassoc", "contract", "nsz"})


def polonsky_keer(problem, monitor) -> None:
    """Iterate, calling monitor(pressure, transforms) each time, until it raises.  Serial.

    Two applications of the compliance per iteration: to the pressure and to the search direction.
    """
    grid, heights, mean_pressure = problem.grid, problem.heights, problem.mean_pressure
    compliance = problem.solid.apply_compliance(grid, np.float64, 1 / grid.size)

    load = mean_pressure * grid.size
    p = np.full(grid.local_shape, mean_pressure)
    direction, gap, response = np.zeros_like(p), np.empty_like(p), np.empty_like(p)
    old, conjugate = 1.0, False
    while True:
        grid.convolve(source(p), compliance, sink(gap))
        gap -= heights
        gap -= _mean_in_contact(p, gap)
        squared = _turn(p, gap, direction, conjugate, old)
        old = squared
        grid.convolve(source(direction), compliance, sink(response))
        step = _step(p, gap, direction, response, _mean_in_contact(p, response))
        total, conjugate = _move(p, gap, direction, step)
        p *= load / total
        monitor(p, grid.transforms)


@_jit
def _mean_in_contact(p, field):
    """field[p > 0].mean()"""
    total, count = 0.0, 0
    for i in range(p.shape[0]):
        for j in range(p.shape[1]):
            inside = p[i, j] > 0
            total += field[i, j] if inside else 0.0
            count += inside
    return total / count


@_jit
def _turn(p, gap, direction, conjugate, old):
    """direction = (gap + β direction) in contact, with β = Σ gap²/old (0 after the set has changed); returns Σ gap²"""
    squared = 0.0
    for i in range(p.shape[0]):
        for j in range(p.shape[1]):
            squared += gap[i, j] ** 2 if p[i, j] > 0 else 0.0
    factor = squared / old if conjugate else 0.0
    for i in range(p.shape[0]):
        for j in range(p.shape[1]):
            direction[i, j] = gap[i, j] + factor * direction[i, j] if p[i, j] > 0 else 0.0
    return squared


@_jit
def _step(p, gap, direction, response, mean):
    """Σ gap·direction / Σ (response − mean)·direction, over contact"""
    above = below = 0.0
    for i in range(p.shape[0]):
        for j in range(p.shape[1]):
            if p[i, j] > 0:
                above += gap[i, j] * direction[i, j]
                below += (response[i, j] - mean) * direction[i, j]
    return above / below


@_jit
def _move(p, gap, direction, step):
    """p = (p − step·direction)₊, or −step·gap where that is 0 and the gap negative; returns Σp, and whether there was
    no such point."""
    total, same = 0.0, True
    for i in range(p.shape[0]):
        for j in range(p.shape[1]):
            value = max(p[i, j] - step * direction[i, j], 0.0)
            if value == 0.0 and gap[i, j] < 0:
                value, same = -step * gap[i, j], False
            p[i, j] = value
            total += value
    return total, same
