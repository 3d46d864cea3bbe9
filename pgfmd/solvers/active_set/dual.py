"""The active-set step whose unknowns are the gaps of the points with a pressure at a bound: minimise
½⟨g, Kg⟩ + ⟨p̄ + Kh, g⟩ over gaps g that are ≥ 0 where p = 0, ≤ 0 where p = σ_Y, and 0 where 0 < p < σ_Y.

This is the dual programme; its gradient p = p̄ + K(h + g) is the pressure.  Conjugate gradients bring the pressure of
the unknowns to its bound.  The stiffness K falls off as r⁻³, so that they converge in a few iterations if the unknowns
are few.  Then gaps of the wrong sign are cut, and points with a pressure beyond a bound become unknowns.

The certificate needs a feasible pressure.  So p = p̄ + K(h + g) is settled: set to its bound where the gap is not 0, cut
to its bounds elsewhere, and changed to bear the load.  If settling changes p by c, the gap becomes g + Gc.
"""

from __future__ import annotations

import math

import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set import kernels as set_kernels
from pgfmd.solvers.active_set.active_set import MOST_INNER, Precision, Relaxation, State
from pgfmd.solvers.active_set.conjugate_gradients import ConjugateGradients
from pgfmd.solvers.active_set.contact_set import ContactSet, SetVector
from pgfmd.solvers.active_set.feasible import share_of_load
from pgfmd.solvers.active_set.particle_mesh import inner_response
from pgfmd.solvers.active_set.stencil import RADIUS, Stencil, Symbol, lattice_kernel

SCREENING = 0.15  # wave number, in 1/pixel, below which the preconditioner takes the compliance as constant
LEAST = 0.1  # smallest eigenvalue of the stencil over its centre, so that it is positive definite


class GapSteps(Relaxation):
    """Relaxation that costs least where most pressures lie between their bounds.

    Attributes: share, how settling changes the pressure that `look` computed (`share_of_load`); mean, that of h + g.
    """

    def __init__(self, problem: ContactProblem, exact: bool = True) -> None:
        super().__init__(problem, exact)
        grid, solid = problem.grid, problem.solid
        self.inner = inner_response(grid, solid.half_space_stiffness, solid.stiffness, self.stiffness[np.float32])
        self.preconditioner = NearCompliance(grid, solid.half_space_compliance)
        self.share, self.mean = (1.0, 0.0, 0.0), 0.0

    def free(self) -> None:
        """Frees the transforms of the mesh.  Collective."""
        self.inner.free()

    def look(self, state: State, precision: Precision) -> ConjugateGradients:
        """Computes the pressure from the gap.  The system brings it to its bound on the unknowns.  Collective."""
        if not state.opened:
            self.compute_gap(state, precision)
            self.measure(state)
            self.open_gap(state)
        self.mean = self.compute_pressure(state, precision)
        fields, heights, top = (state.pressure, state.gap), self.heights, self.top
        parts = self.grid.threads.collect(
            lambda a, b: set_kernels.settled_sums(*fields, heights, top, a, b), len(heights)
        )
        sums = self.grid.reduction.sums(*map(math.fsum, zip(*parts, strict=True)))
        between, _, _, work, saturated_work, count = map(float, sums)
        self.share = share_of_load(sums[:3], self.load, self.load / self.grid.size)
        state.energy = (self.share[0] * work + saturated_work - self.mean * self.load) / 2
        state.contact, state.level = int(count), 0.0
        points = ContactSet(self.grid, fields, top=top, by_gaps=True)
        state.between = self.grid.size - int(self.grid.reduction.sum(points.count))
        return ConjugateGradients(points.beyond(fields, top), self.inner, self.preconditioner, False)

    def open_gap(self, state: State) -> None:
        """Makes the gap Gp − h feasible: measured from the level, 0 where the pressure lies between its bounds."""
        fields, level, top = (state.pressure, state.gap), state.level, self.top
        self.grid.threads.deal(lambda a, b: set_kernels.open_rows(*fields, level, top, a, b), len(state.gap))
        state.opened = True

    def compute_pressure(self, state: State, precision: Precision) -> float:
        """Sets the state's pressure to p̄ + K(h + g), which may lie beyond its bounds.  Returns the mean of h + g.
        Collective.
        """
        mean, sums, squares = self.load / self.grid.size, {}, {}

        def fill(first: int, stop: int, rows: np.ndarray) -> None:
            sums[first] = set_kernels.add_heights(self.heights[first:stop], state.gap[first:stop], rows)

        def drain(first: int, stop: int, rows: np.ndarray) -> None:
            squares[first] = set_kernels.add_mean(rows, mean, state.pressure[first:stop])

        self.grid.convolve(fill, self.stiffness[precision], drain, precision)
        parts = [(*sums[first], squares[first]) for first in sorted(sums)]
        total, self.squares[1], self.squares[0] = self.grid.reduction.sums(*np.sum(parts, axis=0))
        return float(total) / self.grid.size

    def settle(self, state: State) -> None:
        """Settles the pressure, unless a certificate has done so."""
        if state.opened:
            fields = state.pressure, state.gap
            self.grid.threads.deal(
                lambda a, b: set_kernels.settle_rows(*fields, self.top, self.share, a, b), len(state.gap)
            )

    def certify(self, state: State, precision: Precision) -> float:
        """Settles the pressure, makes the gap Gp − h again, and certifies them as `Relaxation` does.  Collective."""
        fields = state.pressure, state.gap

        def fill(first: int, stop: int, rows: np.ndarray) -> None:
            pressure, gap = (field[first:stop] for field in fields)
            set_kernels.settling_rows(pressure, gap, self.top, self.share, rows)

        def drain(first: int, stop: int, rows: np.ndarray) -> None:
            set_kernels.settle_rows(*fields, self.top, self.share, first, stop)
            state.gap[first:stop] += rows
            state.gap[first:stop] -= self.mean

        self.grid.convolve(fill, self.compliance[np.float32], drain, np.float32)
        self.measure(state)
        state.opened = False
        return super().certify(state, precision)

    def improve(self, state: State, system: ConjugateGradients, wanted: float) -> None:
        """Reduces the distance of the pressure from its bounds on the unknowns by the factor `wanted`, and makes the
        gap feasible.  Collective.
        """
        if not state.opened:  # a certificate has changed the gap
            self.open_gap(state)
            return
        change, steps = system.solve(wanted, MOST_INNER)
        system.points.add(state.gap, change)
        state.iterations += steps
        system.points.cut_gaps((state.pressure, state.gap))


class NearCompliance:
    """An approximate inverse of the stiffness on a set: the compliance, screened at long waves and truncated to two
    pixels.
    """

    def __init__(self, grid: SlabGrid, half_space: Symbol) -> None:
        """half_space(|q|): compliance of a half-space."""
        screen = SCREENING / np.sqrt(grid.pixel_area)
        kernel = lattice_kernel(grid, lambda q: half_space(np.hypot(q, screen)))
        padded = np.zeros((64, 64))
        padded[: len(kernel), : len(kernel)] = kernel
        waves = np.fft.fft2(np.roll(padded, (-RADIUS, -RADIUS), (0, 1))).real
        centre = kernel[RADIUS, RADIUS]
        kernel[RADIUS, RADIUS] += max(0, LEAST * centre - waves.min())  # needed for oblong pixels
        self.stencil = Stencil(grid, kernel)

    def apply(self, points: ContactSet, residual: SetVector, out: SetVector) -> None:
        """out = M · residual on the set.  Collective."""
        self.stencil.apply(points, residual.exchange(), out.own)
