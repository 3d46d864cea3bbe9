"""The hard wall at imposed load: minimise ½⟨p, Gp⟩ − ⟨p, h⟩ over p ≥ 0 with mean p̄ (G: compliance, h: heights).

`relax` solves on one grid by a primal–dual active set (Hintermüller, Ito, Kunisch 2002,
doi:10.1137/S1052623401383558): on a contact set the gap is made constant by conjugate gradients; then points in
tension leave and points that overlap join.  Conjugate gradients run in single precision and only to a tenth of the
residual; the gap between them is computed in single precision while that is good enough, then in double.

The stop is a certificate that holds for any feasible p, with g = Gp − h:

    ½‖p − p*‖²_G ≤ J(p) − J(p*) ≤ D(p) = ⟨p, g − min g⟩                      (duality gap of the quadratic programme)

Quantities here are dimensionless: heights over their rms value, lengths over the grid spacing, pressures accordingly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .. import kernels
from ..elasticity import Elasticity
from ..errors import SolverError
from ..grid import SlabGrid
from ..transforms import Columns
from .conjugate_gradients import solve_on_set
from .contact_set import ContactSet
from .mesh import MeshCompliance
from .preconditioner import TwoLevelStiffness

INNER_REDUCTION = (
    0.1  # of the residual by conjugate gradients; less wastes outer steps, more is lost when the set changes
)
FIRST_REDUCTION = 0.2  # in the first step the set still changes most
SINGLE_LIMIT = 1e-5  # certified error below which gaps in single precision are no longer exact enough
MOST_INNER, MOST_OUTER = 300, 200
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


class FullCompliance:
    """u = S G Sᵀ p by full transforms."""

    def __init__(self, action: Columns):
        self.action = action

    def apply(self, points: ContactSet, values: np.ndarray, out: np.ndarray) -> None:
        """out = the response to `values`, both (count,).  Collective."""
        points.convolve(values, self.action, out)

    def free(self) -> None:
        """Nothing to give back."""


class Relaxation:
    """Active-set relaxation of heights (nx_local, ny) on `grid` under the total load Σp."""

    def __init__(self, grid: SlabGrid, heights: np.ndarray, elasticity: Elasticity, load: float):
        self.grid, self.heights, self.load = grid, heights, load
        self.compliance = {
            kind: elasticity.apply_compliance(grid, kind, 1 / grid.size) for kind in (np.float32, np.float64)
        }
        half_space = elasticity.half_space_compliance, elasticity.compliance
        self.inner = (
            MeshCompliance(grid, *half_space)
            if MeshCompliance.serves(grid, *half_space)
            else FullCompliance(self.compliance[np.float32])
        )
        self.preconditioner = TwoLevelStiffness(grid, elasticity.half_space_stiffness, elasticity.stiffness)

    def relax(self, state: State, tolerance: float, monitor: Callable[[State], None] | None = None) -> State:
        """Iterate until the certified error is at most `tolerance`.  Overwrites and returns `state`.  Collective.

        `state.pressure` must be feasible (p ≥ 0, sum = load) at the start.  Raises SolverError if the error stops
        falling above the tolerance.
        """
        precision, points, wanted = np.float32, None, FIRST_REDUCTION
        last = best = np.inf
        patience = PATIENCE
        for _ in range(MOST_OUTER):
            self.compute_gap(state, precision)
            points = self.next_set(state, points)
            self.certify(state)
            if monitor is not None:
                monitor(state)
            if state.error <= tolerance:
                if precision is np.float64 or state.error > SINGLE_LIMIT:
                    return state
                precision = np.float64  # look again before working on
                continue
            if state.error < SINGLE_LIMIT or (state.error > 0.5 * last and last < 1e-3):
                precision = np.float64
            last = state.error
            patience = PATIENCE if last < 0.5 * best else patience - 1
            best = min(best, last)
            if patience == 0:
                break
            self.correct(state, points, wanted)
            # A set that will not settle wants more exact steps.
            wanted = INNER_REDUCTION ** (1 + (PATIENCE - patience) // 3)
        raise SolverError(
            f"hard wall: the certified error stays at {best:.1e}, above the tolerance {tolerance:.1e}, after "
            f"{state.iterations} iterations on {self.grid.shape[0]} x {self.grid.shape[1]} points; ask for less"
        )

    def free(self) -> None:
        """Give the memory of coarser transforms back.  Collective."""
        self.inner.free()
        self.preconditioner.free()

    def compute_gap(self, state: State, precision) -> None:
        """gap = Gp − h for the state's pressure, of either sign.  Collective."""

        def fill(first: int, stop: int, rows: np.ndarray):
            rows[...] = state.pressure[first:stop]

        def drain(first: int, stop: int, rows: np.ndarray):
            np.subtract(rows, self.heights[first:stop], out=state.gap[first:stop])

        self.grid.convolve(fill, self.compliance[precision], drain, precision)

    def next_set(self, state: State, points: ContactSet | None) -> ContactSet:
        """The set after points in tension have left and overlapping points joined; makes the state feasible.
        Collective.

        `points` is the set that the pressure was solved on (None at the start).  The set is chosen from the pressure
        with its
        tensions: once these are cut off, the gap reacts everywhere, and a set chosen from it would oscillate.
        """
        total = self.grid.reduction.sums
        if points is None:
            start = ContactSet(self.grid, state.pressure, state.gap, -np.inf)
            inside, count = total(start.take(state.gap).sum(), start.count)
            return ContactSet(self.grid, state.pressure, state.gap, inside / count)
        pressure, gap = points.take(state.pressure), points.take(state.gap)
        inside, count = total(gap.sum(), points.count)
        new = ContactSet(self.grid, state.pressure, state.gap, inside / count)
        cut = np.maximum(pressure, 0)
        kept, lost = total(cut.sum(), np.count_nonzero(pressure < 0))
        cut *= self.load / kept
        points.put(state.pressure, cut)
        if lost:
            self.shift_gap(state, points, cut - pressure)
        return new

    def shift_gap(self, state: State, points: ContactSet, change: np.ndarray) -> None:
        """gap += G · change of the pressure on a set.  Collective."""

        def drain(first: int, stop: int, rows: np.ndarray):
            state.gap[first:stop] += rows

        source = points.fill(change.astype(np.float32))
        self.grid.convolve(source, self.compliance[np.float32], drain, np.float32)

    def certify(self, state: State) -> None:
        """Energy, number of contact points, and the bound on the error of a feasible state.  Collective."""
        parts = []
        self.grid.threads.split(
            lambda a, b: parts.append(kernels.contact_sums(state.pressure, state.gap, self.heights, a, b)),
            self.grid.local_shape[0],
        )
        work, energy, load, count, lowest = zip(*parts, strict=True)
        work, energy, load, count = self.grid.reduction.sums(sum(work), sum(energy), sum(load), sum(count))
        lowest = self.grid.reduction.min(lowest)
        state.energy, state.contact = energy / 2, int(count)
        state.error = (work - lowest * load) / energy if energy > 0 else np.inf
        state.level = work / load

    def correct(self, state: State, points: ContactSet, wanted: float) -> None:
        """Change the pressure on the set by conjugate gradients, so that the gap there gets flatter by the factor
        `wanted`.
        """
        gap = points.take(state.gap)
        inside, count = self.grid.reduction.sums(gap.sum(), points.count)
        residual = (inside / count - gap).astype(np.float32)
        change, steps = solve_on_set(
            points, residual, self.inner, self.preconditioner, wanted, MOST_INNER
        )  # fmt: skip
        points.put(state.pressure, points.take(state.pressure) + change)
        state.iterations += steps
