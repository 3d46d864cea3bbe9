"""Heights whose Fourier modes are independent Gaussian numbers of given variance.

The random number of mode (kx, ky) depends on (seed, kx, ky) alone: one seed is one surface on any
number of ranks and on any grid.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.domain import PERIODIC

if TYPE_CHECKING:
    from pgfmd.grid.slab_grid import SlabGrid

Variance = Callable[[np.ndarray], np.ndarray]
"""⟨|h̃|²⟩ of modes from their k² = (q L/2π)², L the longer side of the cell; 0 at k = 0."""

_GOLDEN, _TWICE = np.uint64(0x9E3779B97F4A7C15), np.uint64(0x3C6EF372FE94F82A)  # splitmix64's steps: 2⁶⁴/1.618…, twice
_ODD = np.uint64(0xD1342543DE82EF95)  # factor on ky: odd, so that distinct ky stay distinct modulo 2⁶⁴


@dataclass(frozen=True)
class RandomModes:
    """The modes of one seed.  variance: must return 0 for k > k_max, where most modes are skipped."""

    grid: SlabGrid
    seed: int
    variance: Variance
    k_max: float = math.inf

    def fill(self, block: np.ndarray, first: int) -> float:
        """Fill `block` (count, nx) with modes: this rank's columns ky from its number `first` on.  Returns Σ k²|h̃|²
        over these modes and their conjugates.

        Since the heights are real, mode −kx of the columns ky = 0 and ny/2 is the conjugate of mode kx.
        """
        nx, ny = self.grid.shape
        longest = max(self.grid.lengths)
        kx = np.arange(nx)
        kx[kx > nx // 2] -= nx
        unit_x, unit_y = (longest / length for length in self.grid.lengths)
        squares_x, moment = (kx * unit_x) ** 2, 0.0
        block[...] = 0
        for column, ky in zip(block, itertools.count(self.grid.columns.start + first), strict=False):
            if ky * unit_y > self.k_max:
                break
            squares, own_mirror = squares_x + (ky * unit_y) ** 2, ky == 0 or 2 * ky == ny
            inside = np.flatnonzero((squares <= self.k_max**2) & (kx >= 0 if own_mirror else True))
            column[inside] = np.sqrt(self.variance(squares[inside])) * _random(self.seed, kx[inside], ky)
            if own_mirror:
                _mirror(column)
            moment += (1 if own_mirror else 2) * float(np.dot(squares, column.real**2 + column.imag**2))
        return moment

    def heights(self, if_none: str, rms_slope: float | None = None) -> np.ndarray:
        """The heights (nx_local, ny) of the modes, scaled to the rms slope √⟨|∇h|²⟩ if it is given.  Collective.

        Raises InputError on all ranks, with the text `if_none`, if no mode of the grid has a variance.
        """
        if not self.grid.domain.wraps:
            with self.grid.like(self.grid.comm, self.grid.shape, self.grid.lengths, PERIODIC).freed() as cell:
                return replace(self, grid=cell).heights(if_none, rms_slope)
        moments: list[tuple[int, float]] = []
        heights, scale = self.grid.new_field(), np.empty(())

        def spectrum(block: np.ndarray, first: int, stop: int) -> None:
            moments.append((first, self.fill(block, first)))

        def set_scale() -> None:
            slope = math.sqrt(self.grid.reduction.sum([value for _, value in sorted(moments)]))
            if not slope > 0:
                raise InputError(if_none)
            scale[...] = 1.0 if rms_slope is None else rms_slope * max(self.grid.lengths) / (2 * math.pi * slope)

        def keep(first: int, stop: int, rows: np.ndarray) -> None:
            np.multiply(rows, scale, out=heights[first:stop])

        self.grid.make_field(spectrum, keep, between=set_scale)
        return heights


def _random(seed: int, kx: np.ndarray, ky: int) -> np.ndarray:
    """Modes (kx[i], ky) of variance 1: a number uniform in (0, 1] gives the modulus, another the phase."""
    start = _mix(np.array([seed], np.uint64) + _GOLDEN)
    state = _mix(_mix(start ^ (kx.astype(np.uint64) * _GOLDEN)) + np.array([ky], np.uint64) * _ODD)
    uniform, turn = ((_mix(state + step) >> np.uint64(11)) * 2.0**-53 for step in (_GOLDEN, _TWICE))
    modulus, phase = np.sqrt(-np.log(uniform + 2.0**-53)), 2 * np.pi * turn
    return modulus * np.cos(phase) + 1j * (modulus * np.sin(phase))


def _mirror(column: np.ndarray) -> None:
    """Complete a column ky = 0 or ny/2 from its kx ≥ 0: conjugates at −kx; real, of equal variance, at 0 and nx/2."""
    nx = len(column)
    pairs = np.arange(1, (nx + 1) // 2)
    column[nx - pairs] = column[pairs].conj()
    alone = [0] if nx % 2 else [0, nx // 2]
    column[alone] = math.sqrt(2.0) * column[alone].real


def _mix(z: np.ndarray) -> np.ndarray:
    """Finaliser of splitmix64 (Steele, Lea, Flood 2014, doi:10.1145/2714064.2660195): 64 well-mixed bits."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))
