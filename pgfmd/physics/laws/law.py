"""What a contact law is: the relation between the pressure p on a point and the gap g there.

A convex law is given by its dual energy per area φ(p), which is infinite for pressures that it does not admit; the gap
at a pressure is −dφ/dp.  The contact at an imposed mean pressure is then the minimum of

    J(p) = ½⟨p, Gp⟩ − ⟨p, h⟩ + ⟨φ(p)⟩        (G: compliance of the solid, h: heights)

over the pressures of that mean.  A new law is one file here that defines a `ContactLaw`, and its line in `table`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from pgfmd.options.section import Section

if TYPE_CHECKING:
    from pgfmd.physics.solids.solid import Solid

SHARE = 0.01
"""Least pressure of a point in contact over ⟨p²⟩/⟨p⟩.  Under an exponential wall the area so counted differs from that
of a hard wall (.09 to .11) by 0 to 1 % at ζ = 5e-5 and 5e-4 rms heights, 12 to 17 % at 5e-3, and is twice as large at
.05 (`tests/test_exponential`).
"""


class Units(NamedTuple):
    """From a dimensionless contact (p̂, ĝ) to the physical one: p = pressure · p̂, gap = height · (ĝ − level) + offset,
    where the solver finds the level.  highest: the largest physical pressure.
    """

    height: float
    pressure: float
    offset: float
    highest: float = math.inf


@dataclass(frozen=True, kw_only=True)
class ContactLaw(Section):
    """A contact law; its dataclass fields are the keys of the table [wall].  Arrays of points are (nx_local, ny).

    methods: the solvers that can take it, by their names in `solvers.dispatch`; the first is the fastest.
    releases: whether the mean pressure may be 0; otherwise it must be positive.
    effort: time of dynamics under this law over that under a hard wall, for `pgfmd check`.
    newton_effort: time of Newton's method under this law over that under an exponential wall.
    convex: whether the energy of every contact is convex.  Then it has one minimum, a certificate bounds the distance
    to it, and the area and the gap are monotonic in the load.  A law that is not convex, or admits pressures below 0
    (`lowest`), needs a solver of its own, and of the methods below only `contact_above`.

    `respond`, `moments`, `excess` and `finish` are called on the law that `in_units` returns: p and g are then p̂ and ĝ.
    """

    where: ClassVar[str] = "wall"
    methods: ClassVar[tuple[str, ...]] = ()
    releases: ClassVar[bool] = True
    effort: ClassVar[float] = 1.0
    newton_effort: ClassVar[float] = 1.0
    convex: ClassVar[bool] = True

    @property
    def lowest(self) -> float:
        """The least admissible pressure: 0 for a wall that only repels, negative for one that attracts."""
        return 0.0

    @property
    def highest(self) -> float:
        """The largest admissible pressure."""
        return math.inf

    @property
    def ends(self) -> tuple[float, float]:
        """The smallest and the largest gap of a point that bears pressure."""
        return 0.0, 0.0

    @property
    def reach(self) -> float:
        """Largest difference between gaps of points that bear pressure: that of `ends`, 0 for a hard wall."""
        return self.ends[1] - self.ends[0]

    @property
    def length_scale(self) -> float:
        """The length of the law, if it has a single one, else the unit."""
        return 1.0

    def softness(self, pressure: np.ndarray) -> float:
        """Σ p² φ''(p) of rows of points, which is Σ p × range, with the range −p/(dp/dgap) at each pressure."""
        return 0.0

    def range_at(self, pressure: float) -> float:
        """The length over which a pressure > 0 changes with the gap, −p/(dp/dgap); 0 where all have one gap."""
        return self.softness(np.full((1, 1), pressure)) / pressure

    def up_to(self, pressure: float) -> ContactLaw:
        """A law that agrees with this one up to that pressure: a simpler one if there is one, else itself."""
        return self

    def gap(self, pressure: float, solid: Solid) -> float:
        """The gap −dφ/dp at which a point carries that pressure."""
        raise NotImplementedError

    def pressure_at(self, gap: float, solid: Solid) -> float:
        """The pressure that a point bears at a gap, to begin a search; 0 for a hard wall."""
        return 0.0

    def in_units(self, units: Units) -> ContactLaw:
        """The law between p̂ and ĝ, with the offset chosen so that ĝ = 0 at p̂ = 1."""
        raise NotImplementedError

    def respond(self, target: np.ndarray, pressure: np.ndarray, compliance: float, level: float) -> tuple[float, float]:
        """The resolvent: sets p, in rows of points, to the solution of compliance · p − gap(p) = target + level, or to
        the admissible pressure nearest to it.  Returns Σ p and Σ dp/dlevel.
        """
        raise NotImplementedError

    def softer(self, factor: float) -> ContactLaw:
        """The same law, which is one in units, with gaps ĝ larger by that factor."""
        raise NotImplementedError

    def gap_and_slope(self, pressure: np.ndarray, gap: np.ndarray, slope: np.ndarray) -> None:
        """Fills rows with the gap at each pressure and −dp/dgap, inf if the wall is hard; slope may be `pressure`."""
        raise NotImplementedError

    def moments(self, pressure: np.ndarray, gap: np.ndarray, threshold: float) -> tuple[float, float, int, float]:
        """(Σ p (g − gap(p)), Σ p, points with p > threshold, `softness`) of rows; the first two where p < `highest`."""
        raise NotImplementedError

    def excess(
        self, pressure: np.ndarray, gap: np.ndarray, residual: np.ndarray, compliance: float, level: float
    ) -> float:
        """The share of these rows in the certificate: fills `residual` with ε = compliance · (p − p⁺), p⁺ from
        compliance · p⁺ − gap(p⁺) = compliance · p − (g − level); returns the sum of the excess (defined in
        `solvers.second_order`; 0 where the law is obeyed) of pressures p and gaps g − level − ε.
        """
        raise NotImplementedError

    def contact_above(self, mean: float, mean_square: float) -> float:
        """The pressure above which a point counts as in contact.  mean, mean_square: ⟨p⟩ and ⟨p²⟩ of all points.

        0 where the wall releases points.  Else all points bear pressure, and the threshold is `SHARE` of ⟨p²⟩/⟨p⟩, the
        mean pressure weighted with the pressure.  As the range of the law → 0, the points above it become those in
        contact with a hard wall, except the 0.2 to 0.8 % of them that bear less there.
        """
        return 0.0 if self.releases else SHARE * mean_square / mean

    def finish(self, pressure: np.ndarray, gap: np.ndarray, level: float, units: Units) -> float:
        """Converts rows of a dimensionless solution to physical units, in place.  Returns the largest violation of the
        law before that, in units of `units.height`.
        """
        raise NotImplementedError
