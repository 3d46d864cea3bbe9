"""Spectra and autocorrelations of a field in a file, in row blocks: the field may be larger than memory.  No MPI.

The half spectrum goes through a scratch file.  Pass 1 transforms rows; pass 2 transforms columns, a block of them at a
time; for an autocorrelation it transforms |f̃|² back along the columns, and pass 3 transforms rows back.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator

import numpy as np
from scipy import fft

from pgfmd.observables import binning

MEMORY = 2**27  # bytes of one block


def radial_spectrum(blocks, shape, lengths, *, edges=None, weight=None, memory: int = MEMORY, scratch=None):
    """|f̃|² averaged over direction: q, value, count, each (m,), those of the whole field.

    blocks : iterable of (rows, values), `rows` a slice of the nx rows, values of shape (rows, ny)
    shape (nx, ny), lengths (lx, ly); edges : of the bins (default: `binning.bin_edges`); weight : function of |q| by
    which each mode is multiplied before it is averaged; memory : bytes of a block; scratch : folder of the scratch file
    """
    edges = binning.bin_edges(shape, lengths) if edges is None else edges
    qx, qy = binning.wave_numbers(shape, lengths)
    modes = binning.hermitian_weight(shape[1])
    sums = np.zeros((3, len(edges) - 1))
    with tempfile.TemporaryFile(dir=scratch) as file:
        for columns, block in _columns(_rows_transformed(file, blocks, shape), memory):
            q, power = np.hypot(qx, qy[:, columns]), np.abs(block) ** 2
            values = power if weight is None else weight(np.where(q > 0, q, 1.0)) * power
            sums += binning.accumulate(edges, q, modes[columns], values)
    return binning.radial_mean(sums)


def radial_autocorrelation(blocks, shape, lengths, *, memory: int = MEMORY, scratch=None, width=None):
    """⟨f(r) f(r + Δr)⟩ averaged over direction: r, value, count."""
    edges = binning.lag_edges(shape, lengths, width)
    sums = np.zeros((3, len(edges) - 1))
    with tempfile.TemporaryFile(dir=scratch) as file:
        spectrum = _rows_transformed(file, blocks, shape)
        for columns, block in _columns(spectrum, memory):
            spectrum[:, columns] = fft.ifft(np.abs(block) ** 2, axis=0, norm="forward")
        step = max(1, memory // (16 * shape[1]))
        for start in range(0, shape[0], step):
            rows = slice(start, min(start + step, shape[0]))
            values = fft.irfft(spectrum[rows], n=shape[1], axis=1, norm="forward")
            sums += binning.accumulate(edges, binning.distances(shape, lengths, rows), 1.0, values)
    return binning.radial_mean(sums)


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
