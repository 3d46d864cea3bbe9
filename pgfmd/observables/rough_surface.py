"""`RoughSurface`: the heights of a run, and what is measured on them once for all loads."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pgfmd.grid.callbacks import ColumnAction, RowAction, source
from pgfmd.grid.cell import Cell
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.contact_line.line import RESOLVED
from pgfmd.observables.schema import Groups
from pgfmd.observables.statistics.correlations import Correlations, Rings, along_axis, correlate, mode_rings, squared

BEYOND = 0.05
"""Share of the mean square slope in waves beyond RESOLVED above which the grid does not resolve the surface.  Roughness
of λ_s = 1, 2 and 2.5 pixels has .47, .37 and .15 (H = .3) to .10, .08 and .03 (H = .95), of 3 pixels at most .02; a
paraboloid with its kinks at the cell's edges has 2/n."""


@dataclass(frozen=True)
class RoughSurface:
    """The rigid surface.  The first use of `modes`, `correlations` and of any number is collective.

    heights: (nx_local, ny), kept, not copied
    cutoff: wave number beyond which it has no modes; None: not known, every mode of the grid may count
    edges: of the bins of the wave number in which spectra are averaged;  lags: the bins of the distance in which
    autocorrelations are averaged, None if none is asked for
    correlated: whether `correlations` will be asked for, which are then measured together with the slopes
    """

    grid: SlabGrid
    heights: np.ndarray
    cutoff: float | None
    edges: np.ndarray
    lags: Rings | None
    correlated: bool

    @property
    def cell(self) -> Cell:
        """The grid as a job describes it."""
        return Cell(n=self.grid.shape, length=self.grid.lengths)

    @cached_property
    def modes(self) -> Rings:
        """The bins of the wave number.  Collective on first use."""
        return mode_rings(self.grid, self.edges)

    def rings(self, edges: np.ndarray) -> Rings:
        """Bins of the wave number with these edges.  Collective."""
        return self.modes if np.array_equal(edges, self.edges) else mode_rings(self.grid, edges)

    def correlate(self, fill: RowAction, watch: ColumnAction | None = None) -> Correlations:
        """Spectrum, and autocorrelation if one is asked for, of the field whose rows `fill` makes.  Collective."""
        return correlate(self.grid, fill, self.modes, self.lags, watch)

    @cached_property
    def _measured(self) -> tuple[float, float, float, Correlations | None]:
        """√Σ q²|h̃|², √(Σ q⁴|h̃|² / Σ q²|h̃|²), the share of Σ q²|h̃|² beyond RESOLVED, and the correlations if they will
        be asked for, in one pass.  Collective.
        """
        parts, grid = dict[int, tuple[float, float, float]](), self.grid
        unit = min(grid.spacing)  # of lengths here, so that no power of q overflows
        along, across = (unit * grid.qx[0]) ** 2, (unit * grid.qy[:, 0]) ** 2
        weight = grid.hermitian_weight[:, 0].copy()
        waves = (grid.qx[0], grid.qy[:, 0])
        inner_x, inner_y = (np.abs(q) * step <= RESOLVED for q, step in zip(waves, grid.spacing, strict=True))
        powers = np.stack([np.ones_like(along), along, along**2, inner_x, inner_x * along], axis=1)

        def watch(power: np.ndarray, first: int, stop: int) -> None:
            sums, square, w = power @ powers, across[first:stop], weight[first:stop]  # Σ v, Σ qx² v, Σ qx⁴ v
            second, inner = (sums[:, i + 1] + square * sums[:, i] for i in (0, 3))
            fourth = sums[:, 2] + square * (2 * sums[:, 1] + square * sums[:, 0])
            parts[first] = w @ second, w @ fourth, w @ (inner_y[first:stop] * inner)

        found = None
        if self.correlated:
            found = self.correlate(source(self.heights), watch)
        else:
            grid.read_spectrum(source(self.heights), lambda block, *place: watch(squared(block), *place))
        totals = grid.reduction.sums_of_blocks(parts, 3)
        second, fourth = np.sqrt(totals[:2]) / grid.size
        if second == 0:
            return 0.0, 0.0, 0.0, found
        return float(second) / unit, float(fourth / second) / unit, float(1 - totals[2] / totals[0]), found

    @cached_property
    def correlations(self) -> Correlations:
        """Spectrum of the heights, and autocorrelation if one is asked for."""
        return self._measured[3] or self.correlate(source(self.heights))

    @property
    def rms_slope(self) -> float:
        """√Σ q²|h̃|²."""
        return self._measured[0]

    @property
    def roughness(self) -> float:
        """√(Σ q⁴|h̃|² / Σ q²|h̃|²) in radians per pixel: curvature over slope."""
        return self._measured[1] * math.sqrt(self.grid.pixel_area)

    @property
    def is_smooth(self) -> bool:
        """Whether the grid resolves the surface."""
        return self._measured[2] <= BEYOND

    def acf_groups(self, name: str, found: Correlations) -> Groups:
        """The three groups of an autocorrelation; none if none is asked for."""
        if self.lags is None or found.acf is None or found.acf_x is None or found.acf_y is None:
            return {}
        return {
            f"{name}_acf": self.lags.means(found.acf, "r"),
            f"{name}_acf_x": along_axis(self.grid, found.acf_x, 0),
            f"{name}_acf_y": along_axis(self.grid, found.acf_y, 1),
        }
