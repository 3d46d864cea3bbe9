"""The hard wall at imposed load: minimise ½⟨p, Gp⟩ − ⟨p, h⟩ over p ≥ 0 with mean p̄ (G: compliance, h: heights).

`relax` solves on one grid by a primal–dual active set (Hintermüller, Ito, Kunisch 2002,
doi:10.1137/S1052623401383558), whose unknowns are either the pressures of the points in contact (`pressure_steps`) or,
where contact is the rule, the gaps of the others (`gap_steps`).  Conjugate gradients on the set run in single
precision, with a particle–mesh approximation of the response (`mesh`), and only to a tenth of the residual; between
them the response is computed by full transforms, in single precision while that is good enough, then in double.

The stop is a certificate that holds for any feasible p, with g = Gp − h:

    ½‖p − p*‖²_G ≤ J(p) − J(p*) ≤ D(p) = ⟨p, g − min g⟩                      (duality gap of the quadratic programme)

or for a sharper one, where another p' of gap g' is known: ⟨p, g' − min g'⟩ + ½‖p − p'‖²_G (`PressureSteps.look`).

Quantities here are dimensionless: heights over their rms value, lengths over the grid spacing, pressures accordingly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pgfmd.errors import SolverError
from pgfmd.grid import kernels
from pgfmd.grid.callbacks import Rows
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set.contact_set import segments

INNER_REDUCTION = 0.1  # of the residual; less wastes outer steps, more is lost when the set changes
SINGLE_LIMIT = 1e-5  # certified error below which gaps in single precision are no longer exact enough
MOST_INNER, MOST_OUTER = 300, 200
STUCK = 3  # outer steps without halving the best error, after which gaps in single precision may be why
PATIENCE = 12  # outer steps without halving the best error, before giving up


@dataclass
class State:
    """Pressure and gap (nx_local, ny) on one grid, with the level at which contact lies and the certified relative
    error.
    """

    pressure: np.ndarray
    gap: np.ndarray
    level: float = 0.0
    energy: float = 0.0
    error: float = np.inf
    contact: int = 0
    iterations: int = 0


class Relaxation:
    """Relaxation of a dimensionless problem: looks at a state, improves it, until it is certified."""

    def __init__(self, problem: ContactProblem, exact: bool = True):
        """exact: the certificate must hold strictly; without, the grid only begins a finer one, and one to a few per
        cent will do.
        """
        grid = problem.grid
        self.grid, self.heights, self.load, self.exact = grid, problem.heights, problem.load, exact
        self.least = np.empty(segments(grid))  # gap of each segment
        self.compliance = {
            kind: problem.solid.apply_compliance(grid, kind, 1 / grid.size) for kind in (np.float32, np.float64)
        }

    def relax(self, state: State, tolerance: float, monitor: Callable[[State], None] | None = None) -> State:
        """Iterate until the certified error is at most `tolerance`.  Overwrites and returns `state`.  Collective.

        `state.pressure` must be feasible (p ≥ 0, sum = load) at the start.  Raises SolverError if the error stops
        falling above the tolerance.
        """
        precision, wanted = np.float32, INNER_REDUCTION
        best, patience = np.inf, PATIENCE
        for _ in range(MOST_OUTER):
            self.compute_gap(state, precision)
            self.look(state, tolerance)
            if best == np.inf and not self.exact:
                tolerance = self.goal(state, tolerance)
            if monitor is not None:
                monitor(state)
            if state.error <= tolerance:
                if precision is np.float64 or state.error > SINGLE_LIMIT:
                    return state
                precision = np.float64  # look again before working on
                continue
            patience = PATIENCE if state.error < 0.5 * best else patience - 1
            best = min(best, state.error)
            if state.error < SINGLE_LIMIT or patience <= PATIENCE - STUCK:
                precision = np.float64
            if patience == 0:
                break
            self.improve(state, wanted, tolerance, precision)
            # A set that will not settle wants more exact steps.
            wanted = INNER_REDUCTION ** (1 + (PATIENCE - patience) // 3)
        raise SolverError(
            f"hard wall: the certified error stays at {best:.1e}, above the tolerance {tolerance:.1e}, after "
            f"{state.iterations} iterations on {self.grid.shape[0]} x {self.grid.shape[1]} points; ask for less"
        )

    def goal(self, state: State, tolerance: float) -> float:
        """Certified error down to which a grid is solved that only begins a finer one, after the first look at it."""
        return tolerance

    def look(self, state: State, tolerance: float) -> None:
        """Certify the state.  Collective."""
        raise NotImplementedError

    def improve(self, state: State, wanted: float, tolerance: float, precision) -> None:
        """Change the pressure, which stays feasible at last when looked at.  Collective."""
        raise NotImplementedError

    def free(self) -> None:
        """Give the memory of coarser transforms back.  Collective."""
        raise NotImplementedError

    def compute_gap(self, state: State, precision) -> None:
        """gap = Gp − h for the state's pressure, of either sign.  Collective."""

        def drain(first: int, stop: int, rows: np.ndarray):
            gap = state.gap[first:stop]
            kernels.subtract_rows(rows, self.heights[first:stop], gap)
            kernels.least_of_segments(gap, self.least[first:stop])

        self.grid.convolve(self.source(state), self.compliance[precision], drain, precision)

    def source(self, state: State) -> Rows:
        """The state's pressure, row by row."""

        def fill(first: int, stop: int, rows: np.ndarray):
            rows[...] = state.pressure[first:stop]

        return fill

    def certify(self, state: State, sums: tuple[float, ...], reaction: float = 0.0) -> None:
        """Energy, number of contact points, and the bound on the error of a feasible state.  Collective.

        `sums`: Σ p g, Σ p (g + h), Σ p and the number of points with p > 0, of this rank.  `reaction`: of ⟨p, g⟩ over
        this rank's points to a change of the pressure that `state.gap` does not know of; the bound then is that of
        `PressureSteps.look` without its second order.
        """
        work, energy, load, count, reaction = self.grid.reduction.sums(*sums, reaction)
        lowest = self.grid.reduction.min(self.least)
        energy += reaction
        state.energy, state.contact = energy / 2, int(count)
        state.error = (work - lowest * load) / energy if energy > 0 else np.inf
        state.level = (work + reaction) / load
