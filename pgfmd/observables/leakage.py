"""Leakage: how much of a viscous fluid flows through the gap, with bounds from both sides."""

import logging
import math
from dataclasses import dataclass

import numpy as np

from pgfmd.grid.cell import Cell
from pgfmd.grid.grid_cost import Cost
from pgfmd.observables.contact import Contact
from pgfmd.observables.discretisation import on_half_grid
from pgfmd.observables.observable import Observable
from pgfmd.observables.schema import TABLE, Dataset, Groups
from pgfmd.options.rules import choice, flag, number
from pgfmd.options.section import key
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.solution import ContactSolution

log = logging.getLogger("pgfmd")


@dataclass(frozen=True, kw_only=True)
class Leakage(Observable):
    """Reynolds flow, ∇·(g³∇p_f) = 0 for the fluid's pressure p_f, through the gap g, under a mean gradient along x and
    one along y.

    The conductivity K is 12 × viscosity × the flow per width over that gradient, a length cubed: g³ between parallel
    plates.  Over the cube of the mean gap it is the pressure flow factor of Patir and Cheng (1978,
    doi:10.1115/1.3453103).  Faces between points have the harmonic mean of g³.  The bounds hold for this grid.
    With a half grid the value is extrapolated to spacing 0 as if its error were of second order; the error bar reaches
    to what an order of .7 would give, since near closure the order falls below 1.  The change may be small by chance,
    so that it is taken, relative to the value, from the axis where it is larger.
    """

    name = "leakage"
    fields = ("flux_x", "flux_y")
    needs_period = "the mean gradient acts across the cell"
    layout = {
        TABLE: {
            f"{name}_{axis}{error}": Dataset(unit, f"{'error of the ' if error else ''}{what} along {axis}")
            for axis in "xy"
            for name, unit, what in (
                ("leakage", "{length}^3", "conductivity of the gap, 12 × viscosity × flow per width over gradient"),
                ("flow_factor", "1", "pressure flow factor, the conductivity over the cube of the mean gap"),
            )
            for error in ("", "_error")
        },
        "leakage": {
            name: Dataset(unit, about, ("axis",))
            for name, unit, about in (
                ("axis", "1", "direction of the mean gradient: 0 along x, 1 along y"),
                ("lower", "{length}^3", "bound of the conductivity from below, on this grid"),
                ("upper", "{length}^3", "bound from above"),
                ("iterations", "1", "of the solver"),
            )
        },
    }

    direction: str = key(choice("both", "x", "y"), "both", "of the mean gradient; fields are those of the first")
    width: float = key(number(above=0, below=1), 1e-3, "relative, asked of the bounds; rounding may widen it", unit="1")
    half_grid: bool = key(
        flag(), False,
        "extrapolate to spacing 0 by a grid with half the points each way, beyond the bounds; error: 4 × the change",
    )  # fmt: skip

    def cost(self, cell: Cell, cutoff: float | None) -> Cost:
        """Setting up and four (to 1e-3) or seven (to 1e-6) iterations of the multigrid in each direction; the faces and
        vectors of all levels.  Measured at 1024² to 4096².
        """
        from pgfmd.observables.network import SINGLE

        each = 55.0 - 10.0 * math.log10(self.width)
        directions = (2 if self.direction == "both" else 1) * (1 + 0.25 * self.half_grid)
        memory = 66.0 if self.width >= SINGLE else 74.0
        return Cost(each * directions + 5.0 * self.half_grid, memory)

    def axes(self) -> tuple[int, ...]:
        """0 for x, 1 for y."""
        return {"both": (0, 1), "x": (0,), "y": (1,)}[self.direction]

    def measure(self, contact: Contact) -> Groups:
        """Solves for the flow.  Collective."""
        from pgfmd.observables.network import Flow, flow_through

        contact.grid.free()
        grid, mean_gap = contact.grid, contact.mean_gap or math.nan
        wanted = any(field in contact.surface.fields for field in self.fields)

        def coarse_flows(coarse: ContactProblem, solution: ContactSolution) -> list[float]:
            mask = solution.pressure_in_contact() <= 0
            flows = [flow_through(coarse.grid, solution.gap, mask, axis, self.width) for axis in self.axes()]
            return [(found.lower + found.upper) / 2 for found in flows]

        halves = on_half_grid(contact.problem, contact.surface.solve, coarse_flows) if self.half_grid else None
        mask = contact.pressure_in_contact() <= 0
        flows, columns = list[Flow](), dict[str, float]()
        for axis in self.axes():
            found = flow_through(grid, contact.gap, mask, axis, self.width, wanted and not flows)
            if found.fluxes is not None:
                for name, field in zip(self.fields, found.fluxes, strict=True):
                    contact.keep(name, field)
            flows.append(found._replace(fluxes=None))
        values = np.array([(found.lower + found.upper) / 2 for found in flows])
        changes = (values - (halves or math.nan)) / 3 if self.half_grid else np.zeros(len(values))
        largest = np.max(abs(changes[values > 0]) / values[values > 0], initial=0)
        for axis, found, value, change in zip(self.axes(), flows, values, changes, strict=True):
            error = (found.upper - found.lower) / 2 + 4 * max(abs(change), value * largest)
            value = max(value + change, 0.0)
            if found.upper == 0 and grid.comm.rank == 0:
                log.info("leakage: no path through the gap percolates along %s: the flow factor is 0", "xy"[axis])
            for name, unit in (("leakage", 1.0), ("flow_factor", mean_gap)):  # whose cube may overflow
                relative, its_error = (number / unit / unit / unit for number in (value, error))
                columns |= {f"{name}_{'xy'[axis]}": relative, f"{name}_{'xy'[axis]}_error": its_error}
        rows = [(axis, flow.lower, flow.upper, flow.iterations) for axis, flow in zip(self.axes(), flows, strict=True)]
        bounds = dict(zip(self.layout["leakage"], map(np.array, zip(*rows, strict=True)), strict=True))
        return {TABLE: {name: np.array(number) for name, number in columns.items()}, "leakage": bounds}
