"""A layer bonded to a half-space of another material; the symbol is `homogeneous.layer_factor`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pgfmd.options.rules import POSITIVE
from pgfmd.options.section import key
from pgfmd.physics.solids.homogeneous import layer_factor
from pgfmd.physics.solids.solid import POISSON, Solid

if TYPE_CHECKING:
    from pgfmd.grid.slab_grid import SlabGrid


@dataclass(frozen=True, kw_only=True)
class Layered(Solid):
    """An elastic layer bonded to an elastic half-space. The moduli without "base" are those of the layer.

    Long waves meet the half-space, short ones the layer.  Displacements are those of the surface, as on a half-space.
    """

    kind = "layered"
    shown = ("contact_modulus", "poisson")
    long_waves = "base_modulus"
    needs_poisson = True

    thickness: float = key(POSITIVE, about="of the layer", unit="length", needed=True, example=10.0)
    base_modulus: float = key(POSITIVE, about="E' of the half-space", unit="pressure", needed=True, example=3.0)
    base_poisson: float = key(POISSON, about="ν of the half-space", unit="1", needed=True, example=0.3)

    no_border = ""

    def open_table(self, grid: SlabGrid) -> np.ndarray:
        from pgfmd.physics.solids.open_kernel import kept_table, layer_table

        ratio = f"{self.base_modulus / self.contact_modulus:.12g}"  # a change of units changes its last digits
        name = self.thickness, ratio, self.poisson, self.base_poisson
        return kept_table(grid, name, lambda: layer_table(grid, self, self.thickness))

    def factor(self, q: np.ndarray) -> np.ndarray:
        poisson = np.array([self.poisson, self.base_poisson])
        shear = (1 - poisson) * [self.contact_modulus, self.base_modulus]  # times 1/2
        return layer_factor(q * self.thickness, shear / max(shear), poisson)
