"""The hard wall by the gaps of the points that are not in contact: minimise ½⟨g, Kg⟩ + ⟨p̄ + Kh, g⟩ over g ≥ 0.

This is the dual programme; its gradient p = p̄ + K(h + g) is the pressure.  K, the stiffness, falls off as r⁻³, so that
on the open set, whose points are few where contact is the rule, a handful of conjugate gradients suffice: they make
the pressure vanish there.  Then points that overlap leave the set and points in tension join it.
"""

from __future__ import annotations

import math

import numpy as np

from pgfmd.grid import kernels
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set.active_set import INNER_REDUCTION, MOST_INNER, SINGLE_LIMIT, Relaxation, State
from pgfmd.solvers.active_set.conjugate_gradients import solve_on_set
from pgfmd.solvers.active_set.contact_set import ContactSet, SetVector
from pgfmd.solvers.active_set.particle_mesh import inner_response
from pgfmd.solvers.active_set.stencil import RADIUS, Stencil, lattice_kernel

MOST_SWEEPS = 8  # between two certificates
SCREENING = 0.15  # wave number, in 1/pixel, below which the preconditioner takes compliance for constant
LEAST = 0.1  # of the stencil's centre: the smallest response to a wave, so that it is positive definite
RATE = 0.6  # of the error that the first sweep leaves, until there are two to tell


class GapSteps(Relaxation):
    """Relaxation that costs least where most points are in contact.

    Attributes: points, the open set (None at first); values (count,), the gap on it after the last sweep.
    """

    def __init__(self, problem: ContactProblem, exact: bool = True):
        super().__init__(problem, exact)
        grid, solid = problem.grid, problem.solid
        self.stiffness = {kind: solid.apply_stiffness(grid, kind, 1 / grid.size) for kind in (np.float32, np.float64)}
        self.inner = inner_response(grid, solid.half_space_stiffness, solid.stiffness, self.stiffness[np.float32])
        self.preconditioner = NearCompliance(grid, solid.half_space_compliance)
        self.points = self.values = None

    def free(self) -> None:
        """Give the memory of coarser transforms back.  Collective."""
        self.inner.free()

    def look(self, state: State, tolerance: float) -> None:
        """Certify the state.  Collective."""
        fields = state.pressure, state.gap, self.heights
        parts = self.grid.threads.collect(lambda a, b: kernels.contact_sums(*fields, a, b), len(state.gap))
        self.certify(state, tuple(map(math.fsum, zip(*parts, strict=True))))

    def improve(self, state: State, wanted: float, tolerance: float, precision) -> None:
        """Sweep until the last changes of the gap tell that the error is within the tolerance.  Collective.

        A gap that is wrong by δ anywhere lets the certificate grow by δ Σp, while the energy is wrong by δ² only.
        """
        if precision is np.float32:
            tolerance = max(tolerance, SINGLE_LIMIT / 2)
        self.restore_gap(state)
        before, left = None, np.inf
        for sweep in range(MOST_SWEEPS + 1):
            self.compute_pressure(state, precision)
            if left <= tolerance or sweep == MOST_SWEEPS:
                break
            residual = self.next_set(state)
            error = self.correct(state, residual, min(wanted, INNER_REDUCTION)) * self.load / (2 * state.energy)
            rate = RATE if before is None else min(1.0, max(error / before, INNER_REDUCTION))
            before, left = error, rate * error / 2  # half: sweeps converge faster and faster
        self.values = self.points.take(state.gap)
        self.make_feasible(state)

    def restore_gap(self, state: State) -> None:
        """The gap, of either sign on the open set and 0 off it, that the last sweep left; at first, from the state."""
        if self.points is None:
            self.split(lambda a, b: kernels.open_gap(state.pressure, state.gap, state.level, a, b))
        else:
            state.gap[...] = 0
            self.points.put(state.gap, self.values)

    def split(self, work) -> None:
        """work(first, stop) on parts of the rows, by all threads."""
        self.grid.threads.deal(work, self.grid.local_shape[0])

    def compute_pressure(self, state: State, precision) -> None:
        """p = p̄ + K(h + g) for the state's gap, of either sign.  Collective."""
        mean = self.load / self.grid.size

        def fill(first: int, stop: int, rows: np.ndarray):
            kernels.add_rows(self.heights[first:stop], state.gap[first:stop], rows)

        def drain(first: int, stop: int, rows: np.ndarray):
            np.add(rows, mean, out=state.pressure[first:stop])

        self.grid.convolve(fill, self.stiffness[precision], drain, precision)

    def next_set(self, state: State) -> SetVector:
        """Overlapping points leave the open set and points in tension join it; makes the gap feasible and returns the
        residual on the set.  Collective.

        The set is chosen from the gap with its overlaps; the pressure's reaction to cutting them off is computed on
        the set alone, approximately.
        """
        old, new = self.points, ContactSet(self.grid, state.gap, state.pressure, 0.0)
        residual = new.below(0.0, state.pressure)
        self.points = new
        if old is None:
            return residual
        change, overlaps = old.cut_negative(state.gap)
        if self.grid.reduction.any(overlaps):
            response = np.empty(new.count, np.float32)
            self.inner.apply(old, change, response, new)
            residual.own -= response
        return residual

    def correct(self, state: State, residual: SetVector, wanted: float) -> float:
        """Change the gap on the set by conjugate gradients, so that the pressure there, minus the residual, falls by
        the factor `wanted`.  Returns the largest change.  Collective.
        """
        change, steps = solve_on_set(self.points, residual, self.inner, self.preconditioner, wanted, MOST_INNER, False)
        self.points.add(state.gap, change)
        state.iterations += steps
        return self.grid.reduction.max([change.max(initial=0), -change.min(initial=0)])

    def make_feasible(self, state: State) -> None:
        """Pressure only where the gap is closed, nowhere tensile, of the right sum.  Collective."""
        threads, rows = self.grid.threads, self.grid.local_shape[0]
        parts = threads.collect(lambda a, b: kernels.close_pressure(state.pressure, state.gap, a, b), rows)
        threads.scale(state.pressure, self.load / self.grid.reduction.sum(parts))


class NearCompliance:
    """An approximate inverse of the stiffness on a set: the compliance with long waves screened, cut to a few
    pixels.
    """

    def __init__(self, grid: SlabGrid, half_space):
        """half_space(|q|): compliance of a half-space."""
        screen = SCREENING / np.sqrt(grid.pixel_area)
        kernel = lattice_kernel(grid, lambda q: half_space(np.hypot(q, screen)))
        padded = np.zeros((64, 64))
        padded[: len(kernel), : len(kernel)] = kernel
        waves = np.fft.fft2(np.roll(padded, (-RADIUS, -RADIUS), (0, 1))).real
        centre = kernel[RADIUS, RADIUS]
        kernel[RADIUS, RADIUS] += max(0, LEAST * centre - waves.min())  # oblong pixels need it
        self.stencil = Stencil(grid, kernel)

    def apply(self, points: ContactSet, residual: SetVector, out: SetVector) -> None:
        """out = M · residual on the set.  Collective."""
        self.stencil.apply(points, residual.exchange(), out.own)
