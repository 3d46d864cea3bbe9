"""Distribution of pressures and gaps: histograms, moments, and the fit of Persson's form.

Edges of bins are decimal numbers, chosen from the extreme values rounded outward, so that they do not depend on the
number of ranks, not even in the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.statistics.kernels import contact_sums, histogram, survey
from pgfmd.parallel.mpi import MPI

ORDERS = 4  # moments ⟨σⁿ⟩_c from n = 1 to this
DECADES = 12  # at most covered by the logarithmic bins, below the largest pressure
LINEAR_PER_LOG = 10  # linear bins for each logarithmic bin of a decade
FIT_BINS = 1000  # most bins of the fit, which passes over them hundreds of times; finer bins are merged

Group = dict[str, np.ndarray]


def pressure_groups(grid: SlabGrid, pressure: np.ndarray, bins: int) -> dict[str, Group]:
    """Histograms (linear and logarithmic) over contact, moments and Persson's fit of a pressure slab.  Collective.

    Densities are normalised to 1 over the contact, p > 0.  Without contact, counts are zero and the rest is NaN.  The
    fit is made on rank 0 only.  Two passes over the field.
    """
    seen = look_over(grid, pressure)
    linear = linear_edges(0.0, max(seen.largest, 0.0), bins)
    logarithmic = log_edges(seen.least_positive, seen.largest, max(1, bins // LINEAR_PER_LOG))
    mean = seen.total / seen.positive if seen.positive else math.nan  # over the contact

    def part(first: int, stop: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        count, log_count = (np.zeros(len(edges) - 1, np.int64) for edges in (linear, logarithmic))
        powers = np.zeros(ORDERS)
        contact_sums(pressure, mean, first, stop, ((linear, count), (logarithmic, log_count)), powers)
        return count, log_count, powers

    count, log_count, powers = _totals(grid, part)
    fit = {"persson_fit": persson_fit(linear, count, seen.total / grid.size, grid.size)} if grid.comm.rank == 0 else {}
    return fit | {
        "pressure_histogram": _histogram(linear, count, seen.positive),
        "pressure_histogram_log": _histogram(logarithmic, log_count, seen.positive),
        "pressure_moments": {
            "order": np.arange(1, ORDERS + 1),
            "value": powers / seen.positive if seen.positive else np.full(ORDERS, np.nan),
        },
    }


def gap_groups(grid: SlabGrid, gap: np.ndarray, bins: int) -> dict[str, Group]:
    """Histogram of the gaps of a slab.  Collective.

    Gaps that are exactly zero, those of hard contact, are left out of the bins, but the density is over all points: its
    integral is 1 − f_c.  Two passes over the field.
    """
    seen = look_over(grid, gap)
    edges = linear_edges(min(seen.least, 0.0), max(seen.largest, 0.0), bins)

    def part(first: int, stop: int) -> tuple[np.ndarray]:
        counts = np.zeros(len(edges) - 1, np.int64)
        histogram(gap, edges, first, stop, counts)
        return (counts,)

    (count,) = _totals(grid, part)
    return {"gap_histogram": _histogram(edges, count, grid.size)}


def persson_fit(edges: np.ndarray, count: np.ndarray, mean: float, points: int) -> Group:
    """Width s and misfit of N(σ; p̄, s) − N(σ; −p̄, s), for counts of `points` in all; NaN if all counts are zero."""
    from pgfmd.theory import persson  # and SciPy's minimisers, which take a fifth of all the time of a rank's imports

    if not count.any():
        return {"width": np.array(math.nan), "residual": np.array(math.nan)}
    starts = np.arange(0, len(count), -(-len(count) // FIT_BINS))
    edges, count = np.append(edges[starts], edges[-1]) / mean, np.add.reduceat(count, starts)  # pressures over p̄
    density = count / (points * np.diff(edges))
    width = persson.fit_std(edges, density, 1.0)
    model = -np.diff(persson.exceedance(edges, 1.0, width)) / np.diff(edges)
    residual = np.sqrt(np.mean((model - density) ** 2) / np.mean(density**2))
    return {"width": np.array(width * mean), "residual": np.array(residual)}


class Survey(NamedTuple):
    """What one pass over a distributed field tells."""

    positive: int  # points with a value > 0
    total: float  # sum of all values
    least_positive: float  # inf if there is none
    least: float
    largest: float


def look_over(grid: SlabGrid, field: np.ndarray) -> Survey:
    """Count, sum and extreme values of a slab (nx_local, ny).  Collective."""
    parts = grid.threads.collect(lambda first, stop: survey(field, first, stop), len(field))
    positive, total, least_positive, least, largest = zip(*parts, strict=True)
    reduction = grid.reduction
    count, total = reduction.sums(sum(positive), math.fsum(total))
    return Survey(
        int(count), float(total), reduction.min(least_positive), reduction.min(least), reduction.max(largest)
    )  # fmt: skip


def _totals(grid: SlabGrid, part: Callable[[int, int], tuple[np.ndarray, ...]]) -> list[np.ndarray]:
    """Sums over threads and ranks of the arrays that part(first, stop) returns for rows of this rank.  Collective."""
    found: dict[int, tuple[np.ndarray, ...]] = {}
    grid.threads.split(lambda first, stop: found.update({first: part(first, stop)}), grid.local_shape[0])
    totals = [np.sum(arrays, axis=0) for arrays in zip(*(found[first] for first in sorted(found)), strict=True)]
    for total in totals:
        grid.comm.Allreduce(MPI.IN_PLACE, total)
    return totals


def _histogram(edges: np.ndarray, count: np.ndarray, points: int) -> Group:
    """Edges and middles of bins, counts, and counts per bin width and point."""
    density = count / (max(points, 1) * np.diff(edges))
    return {"edges": edges, "center": (edges[1:] + edges[:-1]) / 2, "density": density, "count": count}


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
    """The value rounded up to two decimal digits, so at most 10 % larger; 0 stays 0."""
    if not value > 1e-300:
        return max(value, 0.0)
    exponent = math.floor(math.log10(value)) - 1
    digits = math.ceil(value / 10.0**exponent)
    rounded = float(f"{digits}e{exponent}")
    return rounded if rounded >= value else float(f"{digits + 1}e{exponent}")
