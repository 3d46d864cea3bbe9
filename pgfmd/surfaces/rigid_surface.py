"""`Surface`: base class of the kinds of surface; each is a section of options that makes heights."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.cell import Cell
from pgfmd.options.rules import Rule
from pgfmd.options.section import Kinds, Section, build, key, wrong
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


def _table(value: Any) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise ValueError
    return dict(value)


@dataclass(frozen=True)
class Extent:
    """What a file says of the cell: points (nx, ny), lengths (lx, ly), unit of length; None: it does not say."""

    n: tuple[int, int]
    lengths: tuple[float, float] | None
    unit: str | None


@dataclass(frozen=True, kw_only=True)
class Surface(Section):
    """Heights of the rigid surface, peaks positive.  A subclass is one kind; its fields are its keys in [surface].

    kinds: those that `second` may be.
    """

    where = "surface"
    kinds: ClassVar[Kinds]
    second: dict[str, Any] | None = key(
        Rule("a table as [surface], without a second of its own", _table, {"type": "object"}),
        about="the other body, {kind = …} with its keys; heights are added, both with peaks towards the other body",
    )
    centred = False  # whether the mean height is 0
    cut_out = False  # whether the surface continues beyond a patch with open boundaries

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.second is None:
            return
        try:
            other = build(self.kinds, self.second)
        except InputError as error:
            raise InputError(f"surface.second: {error}") from None
        if isinstance(other, Surface) and (other.second is not None or other.seeds):
            raise wrong(self, "second", "has one seed, and no second of its own")

    @property
    def bodies(self) -> tuple[Surface, ...]:
        """This surface, and the second if there is one."""
        if self.second is None:
            return (self,)
        other = build(self.kinds, self.second)
        assert isinstance(other, Surface)
        return self, other

    @property
    def whole(self) -> Surface:
        """What is pressed against the solid: the surface, or the sum of both."""
        return self if self.second is None else Sum(*self.bodies)

    def known_slope(self) -> float | None:
        """√⟨|∇h|²⟩ if the options tell it, for estimates before the run."""
        return None

    def known_height(self, cell: Cell) -> float | None:
        """The rms height, likewise."""
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
        """What the file `path` says of the cell, in `length_unit` if given, or None.  No MPI.  Raises InputError."""
        return None

    def check_inputs(self, cell: Cell, length_unit: str | None) -> str:
        """Check the file that `path` names; describes what it holds ("" if there is none).  No MPI.

        Raises InputError if it cannot be read or does not fit into that cell.
        """
        return ""

    def heights(self, grid: SlabGrid, length_unit: str | None) -> np.ndarray:
        """Heights (nx_local, ny) in units of length, float64.  Collective.

        length_unit: of the job, for files that say theirs; None: nothing is converted.  Raises InputError on all ranks.
        """
        raise NotImplementedError


class Sum(Surface):
    """The heights of two bodies, added: the contact of a half-space depends on their sum alone.

    Squares of slopes add: the bodies are taken as independent.
    """

    parts: tuple[Surface, ...]

    def __init__(self, *parts: Surface) -> None:
        vars(self).update(
            parts=parts, second=None, kind=" + ".join(part.kind for part in parts),
            centred=all(part.centred for part in parts), cut_out=any(part.cut_out for part in parts),
        )  # fmt: skip

    def known_slope(self) -> float | None:
        slopes = [part.known_slope() for part in self.parts]
        return None if None in slopes else math.hypot(*(slope or 0.0 for slope in slopes))

    def known_height(self, cell: Cell) -> float | None:
        heights = [part.known_height(cell) for part in self.parts]
        return None if None in heights else math.hypot(*(height or 0.0 for height in heights))

    def check_in(self, cell: Cell) -> None:
        for part in self.parts:
            part.check_in(cell)

    def shortest_wavelength(self, cell: Cell) -> float:
        return min(part.shortest_wavelength(cell) for part in self.parts)

    def check_inputs(self, cell: Cell, length_unit: str | None) -> str:
        return "; ".join(filter(None, (part.check_inputs(cell, length_unit) for part in self.parts)))

    def heights(self, grid: SlabGrid, length_unit: str | None) -> np.ndarray:
        first, *others = self.parts
        total = first.heights(grid, length_unit)
        for other in others:
            total += other.heights(grid, length_unit)
        return total


def coordinates(grid: SlabGrid) -> tuple[np.ndarray, np.ndarray]:
    """Positions x (nx_local, 1) and y (1, ny) of the grid points, from 0 on."""
    x = grid.spacing[0] * np.arange(grid.rows.start, grid.rows.stop)[:, None]
    return x, grid.spacing[1] * np.arange(grid.shape[1])[None, :]


def refined_heights(surface: Surface, cell: Cell, grid: SlabGrid, length_unit: str | None) -> np.ndarray:
    """Heights (nx_local, ny) of a surface in a cell on `grid`, that of `cell.refined`, for contacts.  Collective.

    Raises InputError on all ranks, as `Surface.heights` does.
    """
    from pgfmd.grid.transfer import interpolate  # compiles loops

    surface = surface.whole
    if cell.refine == 1:
        return surface.heights(grid, length_unit)
    own = grid.like(grid.comm, cell.shape, cell.lengths)
    with own.freed():
        return interpolate(own, grid, surface.heights(own, length_unit))
