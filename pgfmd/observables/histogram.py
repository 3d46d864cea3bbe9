"""The distributions of pressure and gap: histograms, moments, and the fit of Persson's form.

Edges of bins are decimal numbers, chosen from the extreme values rounded outward, so that they do not depend on the
number of ranks, not even in the last bit.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.contact import Contact
from pgfmd.observables.observable import Observable
from pgfmd.observables.schema import Dataset, Groups
from pgfmd.options.rules import integer
from pgfmd.options.section import key
from pgfmd.parallel.mpi import MPI


def _layout(unit: str, what: str) -> dict[str, Dataset]:
    return {
        "edges": Dataset(unit, f"bin edges of {what}", ("edges",)),
        "center": Dataset(unit, "middle of each bin", ("center",)),
        "density": Dataset(f"1/({unit})", f"probability density of {what}", ("center",)),
        "count": Dataset("1", "points in each bin", ("center",)),
    }


@dataclass(frozen=True, kw_only=True)
class Histogram(Observable):
    """Histograms of the pressure over the contact (bins even in the pressure, and in its logarithm), with its moments
    and the fit of Persson's distribution; histogram of the gap over the points out of contact, whose density integrates
    to 1 − f_c.
    """

    name = "histogram"
    layout = {
        "pressure_histogram": _layout("{pressure}", "the pressure over the contact"),
        "pressure_histogram_log": _layout("{pressure}", "the pressure over the contact, bins even in its logarithm"),
        "pressure_moments": {
            "order": Dataset("1", "n of ⟨σⁿ⟩_c / σ_c^n", ("order",)),
            "value": Dataset("1", "moments over the contact, σ_c = p̄/f_c", ("order",)),
        },
        "persson_fit": {
            "width": Dataset("{pressure}", "s of the distribution N(σ; p̄, s) − N(σ; −p̄, s) that fits best"),
            "residual": Dataset("1", "rms deviation of the fit over the rms density"),
        },
        "gap_histogram": _layout("{length}", "the gap over all points, those where it is 0 left out"),
    }

    bins: int = key(
        integer(1, 10**7), 200, "number of bins of pressure and of gap; logarithmic bins: a tenth of it per decade"
    )

    def measure(self, contact: Contact) -> Groups:
        """Two passes over each field, no transform.  Collective."""
        groups = pressure_groups(contact.grid, contact.contact_pressure, self.bins)
        return groups | gap_groups(contact.grid, contact.gap, self.bins)


ORDERS = 4  # moments ⟨σⁿ⟩_c from n = 1 to this
DECADES = 12  # at most covered by the logarithmic bins, below the largest pressure
LEAST_RANGE = 1e-290  # of values that edges tell apart: the density in a bin of a smaller one would overflow
LINEAR_PER_LOG = 10  # linear bins for each logarithmic bin of a decade
ROWS = 64  # that are binned at a time
FIT_BINS = 1000  # most bins of the fit, which passes over them hundreds of times; finer bins are merged

Group = dict[str, np.ndarray]


def pressure_groups(grid: SlabGrid, pressure: np.ndarray, bins: int) -> dict[str, Group]:
    """Histograms (linear and logarithmic) over contact, moments and Persson's fit of a pressure slab ≥ 0.  Collective.

    Densities are normalised to 1 over the contact, p > 0.  Without contact, counts are zero and the rest is NaN.  The
    fit is made on rank 0 only.
    """

    def survey(first: int, stop: int) -> tuple[float, ...]:
        inside = _not_0(pressure, first, stop)
        return len(inside), float(inside.sum(dtype=np.float64)), inside.min(initial=np.inf), inside.max(initial=0.0)

    counts, sums, least, most = zip(*grid.threads.collect(survey, len(pressure)), strict=True)
    touching, total = grid.reduction.sums(sum(counts), math.fsum(sums)).tolist()
    largest, mean = grid.reduction.max(most), total / touching if touching else math.nan  # over the contact
    linear = linear_edges(0.0, largest, bins)
    logarithmic = log_edges(grid.reduction.min(least), largest, max(1, bins // LINEAR_PER_LOG))

    def part(first: int, stop: int) -> tuple[np.ndarray, ...]:
        inside = _not_0(pressure, first, stop)
        power, sums = np.ones(len(inside)), np.empty(ORDERS)
        for order in range(ORDERS):
            power *= inside / mean
            sums[order] = power.sum()
        inside.sort()
        return _counts(inside, linear), _counts(inside, logarithmic), sums

    count, log_count, powers = _totals(grid, part)
    fit = {"persson_fit": persson_fit(linear, count, total / grid.size, grid.size)} if grid.comm.rank == 0 else {}
    return fit | {
        "pressure_histogram": _histogram(linear, count, touching),
        "pressure_histogram_log": _histogram(logarithmic, log_count, touching),
        "pressure_moments": {
            "order": np.arange(1, ORDERS + 1),
            "value": powers / touching if touching else np.full(ORDERS, np.nan),
        },
    }


def gap_groups(grid: SlabGrid, gap: np.ndarray, bins: int) -> dict[str, Group]:
    """Histogram of the gaps of a slab but those of exactly 0; the density is over all points.  Collective."""
    ends = grid.threads.collect(lambda first, stop: (gap[first:stop].min(), gap[first:stop].max()), len(gap))
    edges = linear_edges(min(grid.reduction.min(ends), 0.0), max(grid.reduction.max(ends), 0.0), bins)
    (count,) = _totals(grid, lambda first, stop: (_counts(np.sort(_not_0(gap, first, stop)), edges),))
    return {"gap_histogram": _histogram(edges, count, grid.size)}


def _not_0(field: np.ndarray, first: int, stop: int) -> np.ndarray:
    """The values of some rows that are not 0, copied."""
    rows = field[first:stop]
    return rows[rows != 0]


def _counts(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """How many of rising values lie in each bin, of which the last contains its end."""
    below = np.searchsorted(values, edges)
    below[-1] = np.searchsorted(values, edges[-1], side="right")
    return np.diff(below)


def persson_fit(edges: np.ndarray, count: np.ndarray, mean: float, points: int) -> Group:
    """Width s and misfit of N(σ; p̄, s) − N(σ; −p̄, s), for counts of `points` in all; NaN without pressure."""
    from pgfmd.theory import persson  # and SciPy's minimisers, which take a fifth of all the time of a rank's imports

    if not (count.any() and mean > LEAST_RANGE):
        return {"width": np.array(math.nan), "residual": np.array(math.nan)}
    starts = np.arange(0, len(count), -(-len(count) // FIT_BINS))
    edges, count = np.append(edges[starts], edges[-1]) / mean, np.add.reduceat(count, starts)  # pressures over p̄
    density = count / (points * np.diff(edges))
    width = persson.fit_std(edges, density, 1.0)
    model = -np.diff(persson.exceedance(edges, 1.0, width)) / np.diff(edges)
    residual = np.sqrt(np.mean((model - density) ** 2) / np.mean(density**2))
    return {"width": np.array(width * mean), "residual": np.array(residual)}


def _totals(grid: SlabGrid, part: Callable[[int, int], tuple[np.ndarray, ...]]) -> list[np.ndarray]:
    """Sums over blocks and ranks of the arrays that part(first, stop) returns for rows of this rank.  Collective."""

    def sum_up(first: int, stop: int) -> tuple[np.ndarray, ...]:
        totals = part(first, min(first + ROWS, stop))
        for begin in range(first + ROWS, stop, ROWS):
            for total, more in zip(totals, part(begin, min(begin + ROWS, stop)), strict=True):
                total += more
        return totals

    rows = grid.local_shape[0]
    parts = grid.threads.collect(sum_up, rows, -(-rows // grid.threads.count))
    totals = [np.sum(arrays, axis=0) for arrays in zip(*parts, strict=True)]
    for total in totals:
        grid.comm.Allreduce(MPI.IN_PLACE, total)
    return totals


def _histogram(edges: np.ndarray, count: np.ndarray, points: float) -> Group:
    """Edges and middles of bins, counts, and counts per bin width and point."""
    density = count / (max(points, 1) * np.diff(edges))
    return {"edges": edges, "center": (edges[1:] + edges[:-1]) / 2, "density": density, "count": count}


def linear_edges(least: float, largest: float, bins: int) -> np.ndarray:
    """Edges (bins + 1,) of even bins from `least` ≤ 0 to `largest` ≥ 0, both rounded outward to two decimal digits."""
    top, bottom = _round_up(largest), -_round_up(-least)
    if not top - bottom > LEAST_RANGE:
        top = 1.0
    edges = bottom + (top - bottom) / bins * np.arange(bins + 1)
    edges[-1] = top
    return edges


def log_edges(least: float, largest: float, per_decade: int) -> np.ndarray:
    """Edges 10^(k/per_decade) for integer k around the positive values, over no more than DECADES below the largest."""
    if not (0 < least <= largest and largest > LEAST_RANGE):
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
