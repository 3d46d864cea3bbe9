"""What is to be solved: a rough surface pressed against an elastic solid."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.imposed import Imposed
from pgfmd.physics.laws.law import ContactLaw
from pgfmd.physics.solids.solid import Solid


@dataclass(frozen=True)
class ContactProblem:
    """A rigid surface of `heights` (nx_local, ny) on `grid`, pressed at `mean_pressure` against an elastic `solid`;
    `law` relates pressure and gap.  imposed: what the solver meets instead; `mean_pressure` is then a guess.
    """

    grid: SlabGrid
    heights: np.ndarray
    solid: Solid
    law: ContactLaw
    mean_pressure: float = 0.0
    imposed: Imposed | None = None

    def at(self, mean_pressure: float) -> ContactProblem:
        """The same surface at another mean pressure."""
        return dataclasses.replace(self, mean_pressure=mean_pressure)

    def imposing(self, imposed: Imposed | None, guess: float) -> ContactProblem:
        """The same surface where something else is imposed, with a guess of the mean pressure."""
        return dataclasses.replace(self, mean_pressure=guess, imposed=imposed)

    def on(self, grid: SlabGrid, heights: np.ndarray) -> ContactProblem:
        """The same solid, law and mean pressure with another surface."""
        return dataclasses.replace(self, grid=grid, heights=heights)

    def with_law(self, law: ContactLaw) -> ContactProblem:
        """The same problem under another law."""
        return dataclasses.replace(self, law=law)

    @property
    def load(self) -> float:
        """Σ p over all points."""
        return self.mean_pressure * self.grid.size

    @property
    def least_area(self) -> float:
        """p̄ over the largest pressure that the law admits: the relative contact area is at least that."""
        return max(self.mean_pressure, 0.0) / self.law.highest

    def check(self) -> None:
        """Raise InputError for a mean pressure that the law does not admit."""
        pressure, law = self.mean_pressure, self.law
        if not (pressure > law.lowest or law.releases and pressure == law.lowest) or math.isinf(pressure):
            least = f"above {law.lowest:g}" if law.lowest < 0 else "not negative" if law.releases else "positive"
            raise InputError(f"mean pressure = {pressure!r}: must be {least} and finite with a wall of kind {law.kind}")
        if not pressure < law.highest:
            raise InputError(f"mean pressure = {pressure!r}: must be below {law.highest:g}, the most the wall bears")
