"""`Surface`: base class of the kinds of surface, each a set of options that makes heights."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.cell import Cell
from pgfmd.options.section import Section
from pgfmd.options.text import show

if TYPE_CHECKING:
    from pgfmd.grid.slab_grid import SlabGrid


SLACK = 1e-9  # relative: a mode that lies on an end of a spectrum belongs to it on every grid
SEED = "one seed is one surface, on any grid; several are an ensemble, with results for each and their mean"


def single(seed: int | tuple[int, ...]) -> int:
    """The seed of one surface; raises InputError for those of an ensemble."""
    if isinstance(seed, tuple):
        raise InputError(f"surface.seed = {show(seed)}: one surface has one seed; several are for runs of whole jobs")
    return seed


@dataclass(frozen=True)
class Extent:
    """What the file of a surface says of the cell: points (nx, ny), lengths (lx, ly) and the unit of length; None where
    it does not say them.
    """

    n: tuple[int, int]
    lengths: tuple[float, float] | None
    unit: str | None


@dataclass(frozen=True, kw_only=True)
class Surface(Section):
    """Heights of the rigid surface, peaks positive.  A subclass is one kind; its fields are its keys in [surface]."""

    where = "surface"
    centred = False  # whether the mean height is 0
    cut_out = False  # whether, on a patch with open boundaries, the surface goes on beyond

    def known_slope(self) -> float | None:
        """√⟨|∇h|²⟩ if the options tell it, for estimates before the run."""
        return None

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seeds of an ensemble; () for one surface."""
        seed = getattr(self, "seed", None)
        return seed if isinstance(seed, tuple) else ()

    def check_in(self, cell: Cell) -> None:
        """Raise InputError, naming the key, if this surface does not fit into that cell."""

    def shortest_wavelength(self, cell: Cell) -> float:
        """Wavelength (length) below which the spectrum is zero; 0 if every mode of the grid may count."""
        return 0.0

    def cutoff(self, cell: Cell) -> float | None:
        """Wave number beyond which the spectrum is zero; None if every mode of the grid may count."""
        shortest = self.shortest_wavelength(cell)
        return 2 * math.pi / shortest if shortest else None

    def extent(self, length_unit: str | None = None) -> Extent | None:
        """What the file that `path` names says of the cell, in `length_unit` if that is given; None if nothing.  No
        MPI.  Raises InputError if it cannot be read.
        """
        return None

    def check_inputs(self, cell: Cell, length_unit: str | None) -> str:
        """Check the file that `path` names; describes what it holds ("" if there is none).  No MPI.

        Raises InputError if it cannot be read or does not fit into that cell.
        """
        return ""

    def heights(self, grid: SlabGrid, length_unit: str | None) -> np.ndarray:
        """Heights (nx_local, ny) in units of length, float64.  Collective.

        length_unit: name of the job's unit, for files that say their own unit; None: nothing is converted.
        Raises InputError on all ranks.
        """
        raise NotImplementedError


def coordinates(grid: SlabGrid) -> tuple[np.ndarray, np.ndarray]:
    """Positions x (nx_local, 1) and y (1, ny) of the grid points, from 0 on."""
    x = grid.spacing[0] * np.arange(grid.rows.start, grid.rows.stop)[:, None]
    return x, grid.spacing[1] * np.arange(grid.shape[1])[None, :]


def refined_heights(surface: Surface, cell: Cell, grid: SlabGrid, length_unit: str | None) -> np.ndarray:
    """The heights (nx_local, ny) of a surface in a cell, on the grid of `cell.refined` on which contacts are solved.
    Collective.

    Raises InputError on all ranks, as `Surface.heights` does.
    """
    from pgfmd.grid.transfer import interpolate  # compiles loops

    if cell.refine == 1:
        return surface.heights(grid, length_unit)
    own = grid.like(grid.comm, cell.shape, cell.lengths)
    with own.freed():
        return interpolate(own, grid, surface.heights(own, length_unit))
