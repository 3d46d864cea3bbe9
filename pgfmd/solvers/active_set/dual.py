"""The active-set step whose unknowns are the gaps of the points that are not in contact, under a hard wall: minimise
½⟨g, Kg⟩ + ⟨p̄ + Kh, g⟩ over g ≥ 0.

The gradient p = p̄ + K(h + g) is the pressure.  Conjugate gradients make it vanish on the open points, if few are open
in a few iterations, as K falls off as r⁻³.  Then gaps below 0 are cut, and points in tension become unknowns.

Where a mean gap is imposed, Σ g is given instead of p̄: the equation holds up to a constant, which is the change of p̄.

The certificate needs a feasible pressure.  `settle` makes one, p + c.  Its gap is g + Gc.
"""

from __future__ import annotations

import math

import numpy as np

from pgfmd.errors import SolverError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.problem import Aim, ContactProblem, Measured
from pgfmd.solvers.active_set.active_set import Precision, Relaxation, State
from pgfmd.solvers.active_set.conjugate_gradients import FREE, NEUTRAL, ConjugateGradients
from pgfmd.solvers.active_set.feasible import settle
from pgfmd.solvers.active_set.particle_mesh import inner_response
from pgfmd.solvers.active_set.stencil import RADIUS, Stencil, Symbol, lattice_kernel, power_of
from pgfmd.solvers.active_set.unknowns import Unknowns, add_points

SCREENING = 0.15  # wave number, in 1/pixel, below which the preconditioner takes the compliance as constant
LEAST = 0.1  # smallest eigenvalue of the stencil over its centre, so that it is positive definite
CLOSER = 0.7  # factor on the cut of a last step, as settling adds to the error: without it, 3 of 80 miss the tolerance
# Part of the settled level that is taken: without it, the mean gap is that before settling, whose error has the other
# sign and is a fourth to a tenth (8 contacts of 320² to 1024², areas .69 to .82).
SETTLED = 0.2
DEEPER = 0.15  # factor on the cut of pressures as unknowns: an iteration costs less here, and a step as much


class GapSteps(Relaxation):
    """Relaxation that costs least where most points are in contact.  mean: of h + g; factor: of the last `settle`."""

    mean, coarse_part, factor = 0.0, 0.005, 1.0
    _gap_before: np.ndarray  # of the unknowns, before the last certificate

    def __init__(self, problem: ContactProblem, exact: bool = True) -> None:
        super().__init__(problem, exact)
        grid, solid = problem.grid, problem.solid
        self.inner = inner_response(grid, solid.half_space_stiffness, solid.stiffness, self.stiffness[np.float32])
        self.preconditioner = near_compliance(grid, solid.half_space_compliance)

    def linearise(self, state: State, precision: Precision) -> ConjugateGradients:
        """Computes the pressure of the gap and settles it.  The system makes it vanish on the unknowns.  Collective."""
        if not state.clipped:
            if not state.estimated:
                self.compute_gap(state, precision)
                self.measure(state)
            self.clip_gap(state)
        if self.imposed is not None:
            self._hold_mean(state)
        shift = self.compute_pressure(state, precision)
        points = Unknowns(self.grid, (state.gap, state.pressure), -shift)
        residual, mean = points.below(-shift, state.pressure), FREE if self.imposed is None else NEUTRAL
        system = ConjugateGradients(residual, self.inner.apply, self.preconditioner.apply, mean)
        if self.imposed is not None:
            change, field = shift + system.constant, state.pressure
            self.problem = self.problem.at(self.problem.mean_pressure + change)
            self.grid.threads.deal(
                lambda a, b: np.add(field[a:b], change, out=field[a:b], casting="same_kind"), len(field)
            )
        fields = state.pressure, state.gap, self.heights
        self.factor, work, self.squares[0], count = settle(self.grid, fields, self.problem.load)
        state.energy, state.load = (work - self.mean * self.problem.load) / 2, self.problem.load
        state.contact = state.between = count
        state.level = 0.0
        pressure = self.next_pressure(state, system.square)
        self.load_changed = pressure > 0
        if self.load_changed:
            system.lower(pressure - self.problem.mean_pressure)
            self.problem = self.problem.at(pressure)
        return system

    def _hold_mean(self, state: State) -> None:
        """Scales the gap to the imposed mean; clipping changed it little.  Collective."""
        assert self.imposed is not None
        state.aim, gap, threads = state.aim or Aim(self.imposed), state.gap, self.grid.threads
        parts = threads.collect(lambda a, b: float(gap[a:b].sum(dtype=np.float64)), len(gap), self.grid.band)
        if not (total := self.grid.reduction.sum(parts)) > 0:
            raise SolverError("full contact: no gap is left; allow a larger load.gap_tolerance")
        threads.scale(gap, -self.imposed.approach * self.grid.size / total)

    def measured(self, state: State) -> Measured:
        """As `Relaxation.measured`; the level of a clipped gap is that of its mean."""
        found = super().measured(state)
        return found._replace(level=-self.mean) if state.clipped else found

    def clip_gap(self, state: State) -> None:
        """Clips the gap (`State.clipped`)."""

        def part(_: int, first: int, stop: int) -> None:
            gap = state.gap[first:stop]
            gap[...] = np.where(state.pressure[first:stop] > 0, 0.0, np.maximum(gap - state.level, 0.0))

        self.grid.threads.share(part, len(state.gap), self.grid.band)
        state.clipped, state.estimated, state.base = True, False, 0.0

    def compute_pressure(self, state: State, precision: Precision) -> float:
        """p = p̄ + K(h + g), of either sign; returns the change of p̄ for a given mean gap, else 0.  Collective."""
        mean, sums = self.problem.mean_pressure, []
        works: dict[int, tuple[float, ...]] = {}

        def fill(first: int, stop: int, rows: np.ndarray) -> None:
            displacement = np.add(self.heights[first:stop], state.gap[first:stop], dtype=np.float64)
            rows[...] = displacement
            sums.append((first, float(displacement.sum()), float(np.vdot(displacement, displacement))))

        def drain(first: int, stop: int, rows: np.ndarray) -> None:
            np.add(rows, mean, out=state.pressure[first:stop])
            if self.imposed is not None:
                works[first] = (float(np.vdot(rows, state.gap[first:stop])),)

        self.grid.convolve(fill, self.stiffness[precision], drain, precision)
        total, self.squares[1] = self.grid.reduction.sums(*np.sum(sorted(sums), axis=0)[1:])
        self.mean = float(total) / self.grid.size
        if self.imposed is None:
            return 0.0
        return -float(self.grid.reduction.sums_of_blocks(works, 1)[0] / total) - mean  # then Σ p g = 0

    def certify(self, state: State, system: ConjugateGradients, precision: Precision) -> float:
        """As `Relaxation.certify`, with the gap of the settled pressure; before the system is solved.  Collective."""
        self._gap_before = system.points.values(state.gap)

        def fill(first: int, stop: int, rows: np.ndarray) -> None:
            np.multiply(state.pressure[first:stop], 1 - 1 / self.factor, out=rows, casting="same_kind")
            add_points(system.residual.own, system.points.lists, first, rows)  # −p before settling, where that set 0

        def drain(first: int, stop: int, rows: np.ndarray) -> None:
            state.gap[first:stop] += rows

        self.grid.convolve(fill, self.compliance[np.float32], drain, np.float32)
        state.base = -self.mean  # Gp = h + g − mean + Gc
        self.measure(state)
        state.clipped = False
        error = self.bound(state, precision)
        state.level *= SETTLED
        return error

    def improve(self, state: State, system: ConjugateGradients, wanted: float, enough: float) -> None:
        """Reduces the pressure on the open set by a part of `wanted`, and makes the gap feasible.  Collective."""
        last = wanted**2 < 1.01 * enough
        if not state.clipped:  # a certificate failed: the gap before it belongs to the system
            state.gap[...] = 0.0
            system.points.add(state.gap, self._gap_before)
            state.clipped, state.base, state.level = True, 0.0, 0.0
        change, steps = system.solve((CLOSER if last else DEEPER) * wanted)
        system.points.add(state.gap, change)
        state.iterations += steps
        self.grid.threads.deal(lambda a, b: np.maximum(state.gap[a:b], 0.0, out=state.gap[a:b]), len(state.gap))


def near_compliance(grid: SlabGrid, half_space: Symbol) -> Stencil:
    """An approximate inverse of the stiffness on a set: half_space(|q|), the compliance, screened and truncated."""
    compliance, power = power_of(half_space)
    kernel = compliance * lattice_kernel(grid.spacing, power, SCREENING / math.sqrt(grid.pixel_area))
    waves = np.fft.fft2(np.roll(np.pad(kernel, (0, 64 - len(kernel))), (-RADIUS, -RADIUS), (0, 1))).real
    centre = kernel[RADIUS, RADIUS]
    kernel[RADIUS, RADIUS] += max(0, LEAST * centre - waves.min())  # needed for oblong pixels
    return Stencil(kernel)
