"""Solids whose stiffness is given as a table: graded ones, and any other that is isotropic along its surface."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pgfmd.options.section import path_key
from pgfmd.options.text import printable
from pgfmd.parallel.collectives import from_root
from pgfmd.physics.solids.solid import Solid
from pgfmd.surfaces.readers import read_curve

if TYPE_CHECKING:
    from pgfmd.grid.cell import Cell
    from pgfmd.grid.slab_grid import SlabGrid

log = logging.getLogger("pgfmd")
SAME = 1e-9  # relative distance from an end of the table within which a wave number belongs to it


@dataclass(frozen=True, kw_only=True)
class Graded(Solid):
    """A graded solid: a table of the factor F(q) between its stiffness to waves and that of a half-space with these
    moduli. Beyond its ends F is that of the end.

    Between the entries ln F is the monotone cubic in ln q of Fritsch and Butland (1984), SciPy's PchipInterpolator.
    ln F is smooth where F is a power of q, as for slabs under long waves, and constant beyond the ends.
    """

    kind = "table"
    long_waves = "path"

    path: str = path_key("text of two columns, or .npy (m, 2): q (radians per length), increasing, and F, all > 0",
                         "factor.csv")  # fmt: skip

    @cached_property
    def table(self) -> tuple[np.ndarray, np.ndarray]:
        """q and F, each (m,).  Raises InputError if the file holds no such table."""
        return read_curve(self.path, "F(q)")

    @cached_property
    def curve(self) -> Callable[[np.ndarray], np.ndarray]:
        """ln F as a function of ln q, between the ends."""
        from scipy.interpolate import PchipInterpolator  # slow to import

        return PchipInterpolator(*map(np.log, self.table))

    def check_inputs(self, cell: Cell, length_unit: str | None) -> str:
        q, factor = self.table
        ends = f"q from {q[0]:.6g} to {q[-1]:.6g}, F from {factor[0]:.4g} to {factor[-1]:.4g}"
        return f"table of {len(q)} entries, {ends}"

    def prepare(self, grid: SlabGrid) -> None:
        q, factor = vars(self)["table"] = from_root(grid.comm, lambda: self.table)
        lowest, highest = 2 * math.pi / max(grid.lengths), math.hypot(*(math.pi / step for step in grid.spacing))
        if grid.comm.rank == 0 and not q[0] * (1 - SAME) <= lowest <= highest <= q[-1] * (1 + SAME):
            log.info(
                "solid: %s: waves of the grid have q = %.6g to %.6g; below %.6g F is %.6g, above %.6g it is %.6g",
                printable(self.path, 400), lowest, highest, q[0], factor[0], q[-1], factor[-1],
            )  # fmt: skip

    @property
    def surface_modulus(self) -> float:
        return self.contact_modulus * float(self.table[1][-1])

    def factor(self, q: np.ndarray) -> np.ndarray:
        return np.exp(self.curve(np.log(np.clip(q, self.table[0][0], self.table[0][-1]))))
