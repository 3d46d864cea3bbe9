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
    pressure, direction = np.full(grid.local_shape, mean_pressure), np.zeros(grid.local_shape)
    gap, response = np.empty_like(direction), np.empty_like(direction)
    p, g, d, r = (field.reshape(-1) for field in (pressure, gap, direction, response))  # the same memory
    old, conjugate = 1.0, False
    while True:
        grid.convolve(source(pressure), compliance, sink(gap))
        gap -= heights
        g -= _mean_in_contact(p, g)
        old = _turn(p, g, d, conjugate, old)
        grid.convolve(source(direction), compliance, sink(response))
        total, conjugate = _move(p, g, d, _step(p, g, d, r, _mean_in_contact(p, r)))
        p *= load / total
        monitor(pressure, grid.transforms)


@_jit
def _mean_in_contact(p, field):
    """field[p > 0].mean()"""
    total, count = 0.0, 0
    for i in range(p.size):
        inside = p[i] > 0
        total += field[i] if inside else 0.0
        count += inside
    return total / count


@_jit
def _turn(p, gap, direction, conjugate, old):
    """direction = (gap + β direction) in contact, with β = Σ gap²/old (0 after the set has changed); returns Σ gap²"""
    squared = 0.0
    for i in range(p.size):
        squared += gap[i] ** 2 if p[i] > 0 else 0.0
    factor = squared / old if conjugate else 0.0
    for i in range(p.size):
        direction[i] = gap[i] + factor * direction[i] if p[i] > 0 else 0.0
    return squared


@_jit
def _step(p, gap, direction, response, mean):
    """Σ gap·direction / Σ (response − mean)·direction, over contact"""
    above = below = 0.0
    for i in range(p.size):
        if p[i] > 0:
            above += gap[i] * direction[i]
            below += (response[i] - mean) * direction[i]
    return above / below


@_jit
def _move(p, gap, direction, step):
    """p = (p − step·direction)₊, or −step·gap where that is 0 and the gap negative; returns Σp, and whether there was
    no such point."""
    total, same = 0.0, True
    for i in range(p.size):
        value = max(p[i] - step * direction[i], 0.0)
        if value == 0.0 and gap[i] < 0:
            value, same = -step * gap[i], False
        p[i] = value
        total += value
    return total, same
