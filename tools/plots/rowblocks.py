"""Spectra and autocorrelations of a field in a file, in row blocks: the field may be larger than memory.  No MPI.

The half spectrum goes through a scratch file.  Pass 1 transforms rows; pass 2 transforms columns, a block of them at a
time; for an autocorrelation it transforms |f̃|² back along the columns, and pass 3 transforms rows back.
"""

import tempfile
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft

from pgfmd.observables import binning

MEMORY = 2**27  # bytes of one block
BLOCK = 1 << 18  # entries that are binned at a time: temporaries stay in the cache


def radial_spectrum(blocks, shape, lengths, *, edges=None, weight=None, memory: int = MEMORY):
    """|f̃|² averaged over direction: q, value, count, each (m,), those of the whole field.

    blocks : iterable of (rows, values), `rows` a slice of the nx rows, values of shape (rows, ny)
    shape (nx, ny), lengths (lx, ly); edges : of the bins (default: `binning.bin_edges`); weight : function of |q| by
    which each mode is multiplied before it is averaged; memory : bytes of a block
    """
    edges = binning.bin_edges(shape, lengths) if edges is None else edges
    qx, qy = wave_numbers(shape, lengths)
    modes = hermitian_weight(shape[1])
    sums = np.zeros((3, len(edges) - 1))
    with tempfile.TemporaryFile() as file:
        for columns, block in _columns(_rows_transformed(file, blocks, shape), memory):
            q, power = np.hypot(qx, qy[:, columns]), np.abs(block) ** 2
            values = power if weight is None else weight(np.where(q > 0, q, 1.0)) * power
            sums += accumulate(edges, q, modes[columns], values)
    return radial_mean(sums)


def radial_autocorrelation(blocks, shape, lengths, *, memory: int = MEMORY):
    """⟨f(r) f(r + Δr)⟩ averaged over direction: r, value, count."""
    edges = binning.lag_edges(shape, lengths)
    sums = np.zeros((3, len(edges) - 1))
    with tempfile.TemporaryFile() as file:
        spectrum = _rows_transformed(file, blocks, shape)
        for columns, block in _columns(spectrum, memory):
            spectrum[:, columns] = fft.ifft(np.abs(block) ** 2, axis=0, norm="forward")
        step = max(1, memory // (16 * shape[1]))
        for start in range(0, shape[0], step):
            rows = slice(start, min(start + step, shape[0]))
            values = fft.irfft(spectrum[rows], n=shape[1], axis=1, norm="forward")
            sums += accumulate(edges, distances(shape, lengths, rows), 1.0, values)
    return radial_mean(sums)


def mapped(blocks, function: Callable) -> Iterator:
    """The blocks with a function applied to their values, e.g. pressure → contact."""
    return ((rows, function(values)) for rows, values in blocks)


def _rows_transformed(file, blocks, shape) -> np.memmap:
    """Pass 1: the coefficients along y of every row, (nx, ny//2+1) complex in the scratch file."""
    spectrum = np.memmap(file, np.complex128, "w+", shape=(shape[0], shape[1] // 2 + 1))
    for rows, values in blocks:
        spectrum[rows] = fft.rfft(values, axis=1, norm="forward")
    return spectrum


def _columns(spectrum: np.memmap, memory: int) -> Iterator[tuple[slice, np.ndarray]]:
    """Pass 2: the coefficients f̃ of a block of columns at a time."""
    step = max(1, memory // (16 * spectrum.shape[0]))
    for start in range(0, spectrum.shape[1], step):
        columns = slice(start, min(start + step, spectrum.shape[1]))
        yield columns, fft.fft(spectrum[:, columns], axis=0, norm="forward")


def wave_numbers(shape: Sequence[int], lengths: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """qx (nx, 1) in FFT order and qy (1, ny//2+1), ky ≥ 0, of a half spectrum; radians per length."""
    (nx, ny), (lx, ly) = shape, lengths
    return 2 * np.pi / lx * (np.fft.fftfreq(nx) * nx)[:, None], 2 * np.pi / ly * np.arange(ny // 2 + 1)[None, :]


def hermitian_weight(ny: int) -> np.ndarray:
    """How many modes of the whole spectrum an entry of the half spectrum stands for: 1 or 2, shape (ny//2+1,)."""
    weight = np.full(ny // 2 + 1, 2.0)
    weight[0] = 1
    if ny % 2 == 0:
        weight[-1] = 1
    return weight


def distances(shape: Sequence[int], lengths: Sequence[float], rows: slice = slice(None)) -> np.ndarray:
    """Distance of each grid point (rows, ny) from the point (0, 0), to the nearest periodic image."""
    x, y = (np.minimum(np.arange(n), n - np.arange(n)) * (length / n) for n, length in zip(shape, lengths, strict=True))
    return np.hypot(x[rows, None], y[None, :])


def accumulate(edges: np.ndarray, q: ArrayLike, weight: ArrayLike, *values: ArrayLike) -> np.ndarray:
    """Sums over a block of modes in each bin: rows Σw, Σ w q, and Σ w v for each of `values`; shape (2 + k, m).

    `q`, `weight` and the values broadcast against each other in any layout.  For an autocorrelation, q is the distance.
    A mode belongs to bin i if edges[i] < q ≤ edges[i+1]; those outside all bins, q = 0 among them, are left out.  Add
    up the result over blocks or ranks and hand it to `radial_mean`.
    """
    q, weight, *fields = np.broadcast_arrays(q, weight, *values)
    count = len(edges) - 1
    sums = np.zeros((2 + len(fields), count))
    step = max(1, BLOCK * len(q) // max(q.size, 1)) if q.ndim else 1
    for start in range(0, len(q), step):
        rows = slice(start, start + step)
        index, block_weight = np.searchsorted(edges, q[rows].ravel()), weight[rows].ravel()
        for total, value in zip(sums, (None, q, *fields), strict=True):
            terms = block_weight if value is None else block_weight * value[rows].ravel()
            total += np.bincount(index, terms, minlength=count + 2)[1 : count + 1]
    return sums


def radial_mean(sums: np.ndarray) -> tuple[np.ndarray, ...]:
    """From the sums of `accumulate`: mean q, mean of each value and count of modes, for the m' bins that are not empty.

    Returns (q, value, …, count), each of shape (m',).
    """
    sums = sums[:, sums[0] > 0]
    return (*(sums[1:] / sums[0]), sums[0])
