"""Partial slip under a tangential load, by the difference of two normal contacts."""

import math
from dataclasses import dataclass

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.cell import Cell
from pgfmd.grid.grid_cost import Cost
from pgfmd.grid.transforms import sink, source
from pgfmd.observables.contact import Contact
from pgfmd.observables.observable import Observable, is_rough
from pgfmd.observables.schema import TABLE, Dataset, Groups
from pgfmd.options.rules import POSITIVE, number
from pgfmd.options.section import key
from pgfmd.physics.laws.law import ContactLaw
from pgfmd.physics.problem import ContactProblem
from pgfmd.physics.solids.open_kernel import tangential_action
from pgfmd.physics.solids.solid import Solid
from pgfmd.solvers.fixed_contact import increment
from pgfmd.solvers.options import Solver

TOLERANCE = 3e-13  # of the second contact: the stick area of rough contacts then moves as one to 1e-6 of the shift
MOST_TRIALS, ENOUGH = 12, 1e-6  # contacts until a shift is met, and its relative error


@dataclass(frozen=True, kw_only=True)
class PartialSlip(Observable):
    """Tractions under a tangential load Q along x at constant normal load P, with Coulomb's friction μ.

    τ = μ(p(P) − p(P*)), P* = P − Q/μ (Ciavarella 1998, J. Appl. Mech. 65, 998; Jäger 1998, doi:10.1007/s004190050179):
    where p(P*) > 0 the bodies stick, in the rest of the contact they slip.  With c = (2 − ν)/(2 − 2ν), the tangential
    over the normal compliance, the shift is cμ times the approach from P* to P, and the stiffness K(P*)/c.  For bodies
    of like material this is exact at ν = 0; else slip is not quite parallel to τ, and stick_violation is the rms
    variation of the displacement over the stick area, by the kernel of tangential tractions, over the shift.  Between
    −Q and Q the loop follows Masing's rule, and loses 4Qδ − 8∫δ dQ.
    """

    name = "partial_slip"
    needs_double = True  # a difference of two contacts
    fields = ("traction",)
    attraction = False
    layout = {
        TABLE: {
            "tangential_traction": Dataset("{pressure}", "mean tangential traction, Q over the area of the cell"),
            "stick_area": Dataset("1", "relative area of the points that stick"),
            "slip_area": Dataset("1", "relative area of the points in contact that slip"),
            "tangential_shift": Dataset("{length}", "tangential displacement of the bodies"),
            "tangential_stiffness": Dataset("{pressure}/({length})", "d(traction)/d(shift) at the end of the load"),
            "cycle_loss": Dataset("{pressure}*{length}", "energy lost in a cycle of −Q … Q, per area of the cell"),
            "stick_violation": Dataset("1", "rms variation of the displacement over the stick area, over the shift"),
        }
    }

    friction: float | None = key(POSITIVE, about="μ; needed", unit="1", example=0.3)
    load_share: float = key(number(above=0, below=1), 0.5, "Q/(μP), if no shift is given", unit="1")
    shift: float | None = key(POSITIVE, about="tangential displacement, instead of load_share", unit="length")

    def cost(self, cell: Cell, cutoff: float | None) -> Cost:
        """A second contact, its stiffness, two convolutions, at 1024²; some contacts if a shift is to be met."""
        once = 55.0 if is_rough(cell, cutoff) else 36.0
        return Cost(transforms=once if self.shift is None else 4 * once, memory=50.0)

    def check_contact(self, solid: Solid, law: ContactLaw) -> None:
        """Raises InputError without friction or Poisson's ratio, and unless wall is hard and solid a half-space."""
        if self.friction is None:
            raise InputError("output.partial_slip.friction is missing: the coefficient of friction")
        if law.kind != "hard":
            raise InputError(f"output.partial_slip: of a hard wall, not {law.kind}")
        if solid.poisson is None:
            raise InputError("output.partial_slip: the kernel depends on Poisson's ratio: give solid.poisson")
        if not math.isinf(getattr(solid, "thickness", 0.0)):
            raise InputError("output.partial_slip: of half-spaces, not of a slab or a layered solid")

    def measure(self, contact: Contact) -> Groups:
        """Solves the contact at the lower load.  Collective."""
        problem, grid, mu = contact.problem, contact.grid, float(self.friction or 0.0)
        nu, mean, load = float(problem.solid.poisson or 0.0), contact.mean_pressure, math.nan
        ratio = (2 - nu) / (2 - 2 * nu) * mu  # of a shift to an approach
        options = Solver(tolerance=TOLERANCE)
        for trial in range(MOST_TRIALS):
            other = problem.at((1 - self.load_share) * mean if trial == 0 else load)
            found = contact.surface.solve(other, start=None, options=options)
            if found is None:  # the log says why
                return {TABLE: {name: np.array(math.nan) for name in self.layout[TABLE]}}
            lower, stiffness = found.mean_pressure, sum(increment(other, found.pressure, 1e-3)[1:3]) / 2
            shift = ratio * (contact.approach - found.approach)
            if self.shift is None or abs(missed := shift - self.shift) <= ENOUGH * self.shift:
                break
            load = min(max(lower + stiffness * missed / ratio, lower / 4), (lower + mean) / 2)
        else:
            raise InputError(f"output.partial_slip.shift = {self.shift:g}: gross slip begins at a smaller shift")
        total = mu * (mean - lower)
        # ∫ approach dp̄ from the lower load to the upper one follows from the energies: dE_el = p̄ d(approach)
        work = contact.approach * mean - found.approach * lower - contact.elastic_energy + found.elastic_energy
        loss = 4 * total * shift - 8 * ratio * (contact.approach * total - mu * work)
        stick, traction = found.pressure > 0, found.pressure
        del found, other
        np.subtract(contact.pressure, traction, out=traction)
        traction *= mu
        contact.keep("traction", traction)
        counts = grid.reduction.sums(*(float(np.count_nonzero(each)) for each in (stick, contact.pressure > 0)))
        columns = {
            "tangential_traction": total,
            "stick_area": counts[0] / grid.size,
            "slip_area": (counts[1] - counts[0]) / grid.size,
            "tangential_shift": shift,
            "tangential_stiffness": stiffness * mu / ratio,
            "cycle_loss": loss,
            "stick_violation": self._variation(problem, traction, stick) / shift if shift else math.nan,
        }
        return {TABLE: {name: np.array(value) for name, value in columns.items()}}

    @staticmethod
    def _variation(problem: ContactProblem, traction: np.ndarray, stick: np.ndarray) -> float:
        """Rms variation of the relative displacement over the stick area.  Collective."""
        grid, nu, variance = problem.grid, float(problem.solid.poisson or 0.0), 0.0
        displacement = grid.new_field()
        for along in (True, False):
            grid.convolve(source(traction), tangential_action(grid, nu, along), sink(displacement))
            values = displacement[stick]
            total, count = grid.reduction.sums(float(values.sum()), len(values))
            centred = values - total / max(count, 1)
            variance += grid.reduction.dot(centred, centred) / max(count, 1)
        return math.sqrt(variance) / (problem.solid.contact_modulus * (1 - nu))
