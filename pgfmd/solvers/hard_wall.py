"""The hard wall at imposed load: minimise ½⟨p, Gp⟩ − ⟨p, h⟩ over p ≥ 0 with mean p̄ (G: compliance, h: heights).

`relax` solves on one grid by a primal–dual active set (Hintermüller, Ito, Kunisch 2002,
doi:10.1137/S1052623401383558): on a contact set the gap is made constant by conjugate gradients; then points in
tension leave and points that overlap join.  Conjugate gradients run in single precision, with a particle–mesh
approximation of the compliance (`mesh`), and only to a twentieth of the residual; the gap between them is computed by
full transforms, in single precision while that is good enough, then in double.

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

INNER_REDUCTION = 0.05  # of the residual; less wastes outer steps, more is lost when the set changes
FIRST_REDUCTION = 0.2  # in the first step the set still changes most
SINGLE_LIMIT = 1e-5  # certified error below which gaps in single precision are no longer exact enough
MOST_INNER, MOST_OUTER = 300, 200
CLOSE = 3.0  # times the tolerance: errors below are worth an exact look
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


class FullCompliance:
    """u = S G Sᵀ p by full transforms."""

    def __init__(self, action: Columns):
        self.action = action

    def apply(self, points: ContactSet, values: np.ndarray, out: np.ndarray, targets: ContactSet | None = None) -> None:
        """out = the response to `values` (count,) on the set, there or on `targets`.  Collective."""
        points.convolve(values, self.action, out, targets)

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
        best, patience = np.inf, PATIENCE
        for _ in range(MOST_OUTER):
            self.compute_gap(state, precision)
            points, residual = self.next_set(state, points, tolerance)
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
            self.correct(state, points, residual, wanted)
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

    def next_set(self, state: State, points: ContactSet | None, tolerance: float) -> tuple[ContactSet, np.ndarray]:
        """The set after points in tension have left and overlapping points joined, and the residual on it; makes the
        state feasible and certifies it.  Collective.

        `points` is the set that the pressure was solved on (None at the start).  The set is chosen from the pressure
        with its tensions: once these are cut off, the gap reacts everywhere, and a set chosen from it would oscillate.
        That reaction is computed on the set alone, approximately, while the error is far from the tolerance; a state
        within it has an exact one.
        """
        total = self.grid.reduction.sums
        old = points or ContactSet(self.grid, state.pressure, state.gap, -np.inf)
        inside, count = total(old.take(state.gap).sum(), old.count)
        new = ContactSet(self.grid, state.pressure, state.gap, inside / count)
        change = None if points is None else self.cut_tension(state, old)
        if change is None:
            self.certify(state)
            return new, self.residual(state, new)
        response = np.empty(new.count, np.float32)
        self.inner.apply(old, change, response, new)
        self.certify(state, float(np.dot(new.take(state.pressure), response)))
        if state.error > CLOSE * tolerance:
            return new, self.residual(state, new) - response
        self.shift_gap(state, old, change)
        self.certify(state)
        return new, self.residual(state, new)

    def residual(self, state: State, points: ContactSet) -> np.ndarray:
        """How far the gap (count,) lies below the level of contact on a set, in single precision."""
        return (state.level - points.take(state.gap)).astype(np.float32)

    def cut_tension(self, state: State, points: ContactSet) -> np.ndarray | None:
        """Make the pressure, which is tensile in places of the set, feasible.  Returns its change (count,), or None if
        there was no tension.  Collective.
        """
        pressure = points.take(state.pressure)
        cut = np.maximum(pressure, 0)
        kept, lost = self.grid.reduction.sums(cut.sum(), np.count_nonzero(pressure < 0))
        cut *= self.load / kept
        points.put(state.pressure, cut)
        cut -= pressure
        return cut.astype(np.float32) if lost else None

    def shift_gap(self, state: State, points: ContactSet, change: np.ndarray) -> None:
        """gap += G · change of the pressure on a set.  Collective."""

        def drain(first: int, stop: int, rows: np.ndarray):
            state.gap[first:stop] += rows

        self.grid.convolve(points.fill(change), self.compliance[np.float32], drain, np.float32)

    def certify(self, state: State, extra: float = 0.0) -> None:
        """Energy, number of contact points, and the bound on the error of a feasible state.  Collective.

        `extra`: of ⟨p, g⟩ over this rank's points, by a change of the gap that `state.gap` does not hold.
        """
        parts = []
        self.grid.threads.split(
            lambda a, b: parts.append(kernels.contact_sums(state.pressure, state.gap, self.heights, a, b)),
            self.grid.local_shape[0],
        )
        work, energy, load, count, lowest = zip(*parts, strict=True)
        work, energy, load, count = self.grid.reduction.sums(
            sum(work) + extra, sum(energy) + extra, sum(load), sum(count)
        )
        lowest = self.grid.reduction.min(lowest)
        state.energy, state.contact = energy / 2, int(count)
        state.error = (work - lowest * load) / energy if energy > 0 else np.inf
        state.level = work / load

    def correct(self, state: State, points: ContactSet, residual: np.ndarray, wanted: float) -> None:
        """Change the pressure on the set by conjugate gradients, so that the gap, whose residual (count,) is
        overwritten, gets flatter there by the factor `wanted`.
        """
        change, steps = solve_on_set(points, residual, self.inner, self.preconditioner, wanted, MOST_INNER)
        points.add(state.pressure, change)
        state.iterations += steps
