"""`RoughSurface`: the heights of a run, and what is measured on them once for all loads."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pgfmd.grid.callbacks import Columns, Rows, source
from pgfmd.grid.cell import Cell
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.io.schema import Groups
from pgfmd.observables.statistics.correlations import Correlations, Rings, along_axis, correlate, mode_rings


@dataclass(frozen=True)
class RoughSurface:
    """The rigid surface; `correlations` and `rms_slope` are measured together, on first use.  Collective then.

    heights: (nx_local, ny), kept, not copied
    cutoff: wave number beyond which it has no modes; None: it has all of the grid's
    modes: bins of the wave number in which spectra are averaged;  lags: those of the distance in which autocorrelations
    are averaged, None if none is asked for
    """

    grid: SlabGrid
    heights: np.ndarray
    cutoff: float | None
    modes: Rings
    lags: Rings | None

    @property
    def cell(self) -> Cell:
        """The grid as a job describes it."""
        return Cell(n=self.grid.shape, length=self.grid.lengths)

    def rings(self, edges: np.ndarray) -> Rings:
        """Bins of the wave number with these edges.  Collective."""
        return self.modes if np.array_equal(edges, self.modes.edges) else mode_rings(self.grid, edges)

    def correlate(self, fill: Rows, watch: Columns | None = None) -> Correlations:
        """Spectrum, and autocorrelation if one is asked for, of the field whose rows `fill` makes.  Collective."""
        return correlate(self.grid, fill, self.modes, self.lags, watch)

    @cached_property
    def _measured(self) -> tuple[Correlations, float]:
        parts, grid = {}, self.grid

        def watch(power: np.ndarray, first: int, stop: int) -> None:
            parts[first] = float(np.sum(grid.hermitian_weight[first:stop] * grid.q_squared(first, stop) * power))

        found = self.correlate(source(self.heights), watch)
        return found, math.sqrt(grid.reduction.sum([parts[first] for first in sorted(parts)])) / grid.size

    @property
    def correlations(self) -> Correlations:
        """Spectrum of the heights, and autocorrelation if one is asked for."""
        return self._measured[0]

    @property
    def rms_slope(self) -> float:
        """√Σ q²|h̃|²."""
        return self._measured[1]

    def acf_groups(self, name: str, found: Correlations) -> Groups:
        """The three groups of an autocorrelation; none if none is asked for."""
        if self.lags is None:
            return {}
        return {
            f"{name}_acf": self.lags.means(found.acf, "r"),
            f"{name}_acf_x": along_axis(self.grid, found.acf_x, 0),
            f"{name}_acf_y": along_axis(self.grid, found.acf_y, 1),
        }
