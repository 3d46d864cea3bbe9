"""Bins of wave numbers and distances on doubly periodic grids.  NumPy only.

A field has shape (nx, ny) on a cell of lengths (lx, ly).  Its Fourier coefficients are f̃(q) = (1/N) Σ f(r) exp(−iq·r),
N = nx·ny, so that Σ_q |f̃|² is the mean square of the field: this is the normalisation of every spectrum in this
package and in the result files.

`bin_edges` and `lag_edges` make bins of a given width; `wave_number_bins` and `lag_bins` those that a job asks for.
"""

import math
from collections.abc import Sequence

import numpy as np

from pgfmd.errors import InputError

HAIR = 1e-9
"""Bin edges lie this much, relatively, above their nominal place: rounding cannot move a mode that lies on an edge."""


def bin_edges(
    shape: Sequence[int],
    lengths: Sequence[float],
    spacing: str = "log",
    *,
    per_decade: float = 20,
    width: float | None = None,
    q_max: float | None = None,
) -> np.ndarray:
    """Edges (m+1,) of narrow bins in |q| > 0 that hold every mode of the grid, or every one up to `q_max`.

    "log": `per_decade` bins to a decade, the first centred on the smallest wave number of the cell; at small q, where
    modes are sparse, each distinct |q| then has a bin of its own and bins between stay empty.  "linear": bins centred
    on multiples of `width` (default: the smallest wave number); the first begins no higher than half the
    smallest wave number, so it may be wider.  With `q_max` the last edge lies there, so that no average mixes in
    modes beyond (set it to the cut-off q_s).  The edges depend on the arguments alone.  Radians per length.

    :raises InputError: if `spacing` is neither, or a width, density or limit is not positive.
    """
    _require_positive(per_decade=per_decade, width=width, q_max=q_max)
    lowest = 2 * np.pi / max(lengths)
    highest = 2 * np.pi * math.hypot(*(n // 2 / length for n, length in zip(shape, lengths, strict=True)))
    top = max(highest, lowest) if q_max is None else q_max
    if spacing == "log":
        count = int(np.ceil(max(per_decade * np.log10(top / lowest), 0) + 0.5))
        edges = lowest * 10 ** ((np.arange(count + 1) - 0.5) / per_decade)
    elif spacing == "linear":
        width = lowest if width is None else width
        edges = width * (np.arange(int(np.ceil(top / width + 0.5))) + 0.5)
        edges = np.append(min(edges[0], lowest / 2), edges[1:] if edges.size > 1 else 1.5 * width)
    else:
        raise InputError(f'spacing = {spacing!r}: must be "log" or "linear"')
    edges *= 1 + HAIR
    if q_max is None:
        return edges
    return np.append(edges[edges < q_max], q_max * (1 + HAIR))


def lag_edges(shape: Sequence[int], lengths: Sequence[float], width: float | None = None) -> np.ndarray:
    """Edges (m+1,) of bins in the distance r, centred on multiples of `width` (default: the larger grid spacing).

    The first bin holds r = 0 alone; the last one ends at half the shorter side of the cell: circles are whole.

    :raises InputError: if `width` is not positive.
    """
    _require_positive(width=width)
    spacing = [length / n for n, length in zip(shape, lengths, strict=True)]
    width = max(spacing) if width is None else width
    half = min(lengths) / 2
    edges = width * (np.arange(int(half / width) + 2) - 0.5)
    edges[1] = min(width, *spacing) / 2
    return np.append(edges[edges < half], half) * (1 + HAIR)


def wave_number_bins(
    shape: tuple[int, int],
    lengths: tuple[float, float],
    spacing: str = "log",
    bins: int = 20,
    q_max: float | None = None,
) -> np.ndarray:
    """`bin_edges` by the keys of a job: edges (m + 1,) of `bins` bins to a decade ("log"), or of `bins` bins in all, up
    to the largest |q| or q_max ("linear").  Raises InputError for another spacing.
    """
    if spacing == "linear":
        top = math.hypot(*(2 * np.pi * (n // 2) / length for n, length in zip(shape, lengths, strict=True)))
        top = top if q_max is None else min(q_max, top)
        return bin_edges(shape, lengths, "linear", width=top / bins or 1.0, q_max=q_max)
    return bin_edges(shape, lengths, spacing, per_decade=bins, q_max=q_max)


def lag_bins(shape: tuple[int, int], lengths: tuple[float, float], spacing: str = "log", bins: int = 20) -> np.ndarray:
    """Edges (k + 1,) of bins in distance, up to half the shorter side of the cell, by the keys of a job: `bins` to a
    decade ("log"), or in all ("linear": `lag_edges`).  The first bin holds Δr = 0 alone.
    """
    half, step = min(lengths) / 2, min(length / n for n, length in zip(shape, lengths, strict=True))
    if spacing != "log":
        return lag_edges(shape, lengths, half / bins)
    count = max(int(np.ceil(bins * np.log10(half / step) + 0.5)), 0)
    edges = step * 10 ** ((np.arange(count + 1) - 0.5) / bins)
    edges = np.concatenate([[-edges[0], min(edges[0], step / 2)], edges[1:]]) if len(edges) > 1 else np.array([-half])
    return np.append(edges[edges < half], half) * (1 + HAIR)


def _require_positive(**numbers: float | None) -> None:
    """:raises InputError: naming the first of the given numbers that is not positive and finite."""
    for name, number in numbers.items():
        if number is not None and not 0 < number < np.inf:
            raise InputError(f"{name} = {number:g}: must be positive and finite")
