"""Spectra and autocorrelations of whole fields by plain NumPy, for comparison; as in `pgfmd.observables.binning`."""

import numpy as np
import rowblocks

from pgfmd.observables import binning


def power_spectrum(field) -> np.ndarray:
    """|f̃|² of a real field (nx, ny): half spectrum (nx, ny//2+1), squared unit of the field."""
    return np.abs(np.fft.rfft2(field, norm="forward")) ** 2


def autocorrelation(field) -> np.ndarray:
    """C(Δr) = ⟨f(r) f(r + Δr)⟩ over all r of the periodic field (nx, ny), same shape; C[0, 0] is the mean square."""
    return np.fft.irfft2(power_spectrum(field), s=np.shape(field), norm="forward")


def radial_average(power, shape, lengths, **bins) -> tuple[np.ndarray, ...]:
    """q, mean and count of a half spectrum (nx, ny//2+1) in the bins of `bin_edges` that hold modes."""
    edges, q = binning.bin_edges(shape, lengths, **bins), np.hypot(*rowblocks.wave_numbers(shape, lengths))
    return rowblocks.radial_mean(rowblocks.accumulate(edges, q, rowblocks.hermitian_weight(shape[1]), power))


def radial_autocorrelation(correlation, lengths) -> tuple[np.ndarray, ...]:
    """r, mean and count of an autocorrelation (nx, ny) in the bins of `lag_edges` that hold points."""
    edges, r = binning.lag_edges(np.shape(correlation), lengths), rowblocks.distances(np.shape(correlation), lengths)
    return rowblocks.radial_mean(rowblocks.accumulate(edges, r, 1.0, correlation))
