"""Distribution of pressures and gaps: histograms, moments, and the fit of Persson's form.

Bin edges are decimal numbers, the extreme values rounded outward: they are the same, bit for bit, whatever the rank
count.
"""

from __future__ import annotations

import math

import numpy as np
from mpi4py import MPI

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.statistics.kernels import histogram, positive_range, power_sums
from pgfmd.theory import persson

ORDERS = 4  # moments ⟨σⁿ⟩_c from n = 1 to this
DECADES = 12  # that the logarithmic bins reach down from the largest pressure, at most
BINS_PER_DECADE_SHARE = 10  # logarithmic bins to a decade: one for so many linear ones


def pressure_groups(grid: SlabGrid, pressure: np.ndarray, bins: int) -> dict[str, dict[str, np.ndarray]]:
    """Histograms (linear and logarithmic) over contact, moments and Persson's fit of a pressure slab.  Collective.

    Densities are normalised to 1 over the contact, p > 0.  Without contact, counts are zero and the rest is NaN.
    """
    least, _, largest = value_range(grid, pressure)
    linear = _histogram(grid, pressure, linear_edges(0.0, max(largest, 0.0), bins), False)
    logarithmic = _histogram(grid, pressure, log_edges(least, largest, max(1, bins // BINS_PER_DECADE_SHARE)), True)
    pixels, moments = contact_moments(grid, pressure)
    groups = {
        "pressure_histogram": linear | {"density": _density(linear, pixels)},
        "pressure_histogram_log": logarithmic | {"density": _density(logarithmic, pixels)},
        "pressure_moments": {"order": np.arange(1, ORDERS + 1), "value": moments},
    }
    density, edges = groups["pressure_histogram"]["density"] * (pixels / grid.size), linear["edges"]
    mean = grid.reduction.sum(pressure) / grid.size
    width = residual = math.nan
    if pixels:
        width = persson.fit_std(edges, density, mean)
        model = -np.diff(persson.exceedance(edges, mean, width)) / np.diff(edges)
        residual = float(np.sqrt(np.mean((model - density) ** 2) / np.mean(density**2)))
    return groups | {"persson_fit": {"width": np.array(width), "residual": np.array(residual)}}


def gap_groups(grid: SlabGrid, gap: np.ndarray, bins: int) -> dict[str, dict[str, np.ndarray]]:
    """Histogram of the gaps of a slab.  Collective.

    Gaps that are exactly zero, those of hard contact, are left out of the bins, but the density is over all points: its
    integral is 1 − f_c.
    """
    _, least, largest = value_range(grid, gap)
    found = _histogram(grid, gap, linear_edges(min(least, 0.0), max(largest, 0.0), bins), False)
    return {"gap_histogram": found | {"density": _density(found, grid.size)}}


def contact_moments(grid: SlabGrid, pressure: np.ndarray) -> tuple[int, np.ndarray]:
    """Contact pixels, and ⟨σⁿ⟩_c / σ_c^n for n = 1 … ORDERS (the second is m₂); NaN without contact.  Collective."""
    pixels = int(grid.reduction.sum(np.count_nonzero(pressure > 0)))
    if pixels == 0:
        return 0, np.full(ORDERS, np.nan)
    scale, parts = pixels / grid.reduction.sum(pressure), {}

    def part(first: int, stop: int):
        parts[first] = np.zeros(ORDERS)
        power_sums(pressure, scale, first, stop, parts[first])

    grid.threads.split(part, len(pressure))
    return pixels, grid.reduction.sums(*np.sum([parts[first] for first in sorted(parts)], axis=0)) / pixels


def value_range(grid: SlabGrid, field: np.ndarray) -> tuple[float, float, float]:
    """Least positive value (inf if none), least and largest value of a distributed field.  Collective."""
    parts = grid.threads.collect(lambda a, b: positive_range(field, a, b), len(field))
    positive, least, largest = zip(*parts, strict=True)
    return grid.reduction.min(positive), grid.reduction.min(least), grid.reduction.max(largest)


def linear_edges(least: float, largest: float, bins: int) -> np.ndarray:
    """Edges (bins + 1,) of even bins from `least` ≤ 0 to `largest` ≥ 0, both rounded outward to two decimal digits."""
    top, bottom = _round_up(largest), -_round_up(-least)
    if not top > bottom:
        top = 1.0
    edges = bottom + (top - bottom) / bins * np.arange(bins + 1)
    edges[-1] = top
    return edges


def log_edges(least: float, largest: float, per_decade: int) -> np.ndarray:
    """Edges 10^(k/per_decade) for integer k around the positive values, over no more than DECADES below the largest."""
    if not (0 < least <= largest):
        least = largest = 1.0
    high = math.floor(math.log10(largest) * per_decade) + 1
    low = max(math.floor(math.log10(least) * per_decade), high - DECADES * per_decade)
    edges = 10.0 ** (np.arange(low, high + 1) / per_decade)
    edges[-1] = max(edges[-1], largest)  # where rounding of the power put it below
    return edges


def _round_up(value: float) -> float:
    """The next number of two decimal digits, up to one per cent of a decade above; 0 stays 0."""
    if not value > 1e-300:
        return max(value, 0.0)
    exponent = math.floor(math.log10(value)) - 1
    digits = math.ceil(value / 10.0**exponent)
    rounded = float(f"{digits}e{exponent}")
    return rounded if rounded >= value else float(f"{digits + 1}e{exponent}")


def _histogram(grid: SlabGrid, field: np.ndarray, edges: np.ndarray, logarithmic: bool) -> dict[str, np.ndarray]:
    """Edges and counts of the non-zero values of a distributed field.  Collective."""
    parts = []

    def part(first: int, stop: int):
        counts = np.zeros(len(edges) - 1, np.int64)
        histogram(field, edges, logarithmic, first, stop, counts)
        parts.append(counts)

    grid.threads.split(part, len(field))
    total = np.sum(parts, axis=0)
    grid.comm.Allreduce(MPI.IN_PLACE, total)
    return {"edges": edges, "count": total}


def _density(found: dict[str, np.ndarray], points: int) -> np.ndarray:
    """Counts per point and bin width."""
    return found["count"] / (max(points, 1) * np.diff(found["edges"]))
