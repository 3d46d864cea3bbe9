"""Nested iteration by active sets: the start on each grid, and full contact, which needs no iteration."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from pgfmd.errors import SolverError
from pgfmd.grid.kernels import jit, u
from pgfmd.grid.transfer import Interpolation
from pgfmd.grid.transforms import sink, source
from pgfmd.parallel.collectives import shared
from pgfmd.physics.problem import Aim, ContactProblem, Measured
from pgfmd.physics.solids.solid import multiply
from pgfmd.solvers.active_set.active_set import Relaxation, State
from pgfmd.solvers.active_set.balance import balanced
from pgfmd.solvers.active_set.dual import GapSteps
from pgfmd.solvers.active_set.feasible import scale_to_load
from pgfmd.solvers.active_set.primal import LIGHTEST, PressureSteps
from pgfmd.solvers.active_set.thin import ThinSteps, is_thin
from pgfmd.solvers.active_set.unknowns import Fields
from pgfmd.solvers.controls import stress_of_full_contact
from pgfmd.solvers.nested_iteration import Coarse, NestedIteration
from pgfmd.solvers.options import gaps_from
from pgfmd.solvers.second_order import Rounding
from pgfmd.solvers.solution import Monitor

GAP_FROM, AREA_FROM = 0.4, 0.65  # `gaps_from` where a mean gap or an area is imposed
MOST_ROWS = 512  # of which a stress is measured: a part of a hundred of a transform at 8192²
PUNCH = 2.6  # Â(0) p̄/δ of a square punch on a half-space, 2.244 · 1.1523; 1 on a thin slab
ROUGHER = 0.3  # part of the heights resolved by the finer grid only that its start assumes flattened


def _new_state(problem: ContactProblem) -> State:
    """Fields not yet set, in single precision unless there is a largest pressure, which is met to its last digit."""
    real = np.float32 if problem.law.highest == np.inf else np.float64
    return State(problem.grid.new_field(real), problem.grid.new_field(real))


def _full_contact(problem: ContactProblem) -> State | None:
    """The state of full contact, p = p̄ + Kh, or None if that is beyond a bound somewhere, or not known: where the
    domain has a border, K acts on displacements beyond it too.  Collective.
    """
    grid, heights = problem.grid, problem.heights
    if not grid.domain.wraps:
        return None
    pressure = grid.new_field()
    stiffness = multiply(grid, np.float64, lambda q: problem.solid.stiffness(q) / grid.size)  # no loop is compiled
    grid.convolve(source(heights), stiffness, sink(pressure))
    energy = grid.reduction.dot(pressure, heights) / 2  # without the mean pressure, which may be far larger
    squares = np.array([grid.reduction.dot(field, field) for field in (pressure, heights)])
    pressure += problem.mean_pressure
    if grid.reduction.min(pressure) < 0 or grid.reduction.max(pressure) > problem.law.highest:
        return None
    measured = 2 * squares[1] + grid.size * grid.reduction.max(heights) ** 2  # Σ h² + (h − max h)², as Σ h is 0
    error = Rounding(grid, problem.solid).bound(squares, measured, 2 * energy) / (2 * energy)
    gap = np.zeros(grid.local_shape, grid.storage)
    return State(pressure, gap, clipped=True, energy=energy, error=error, contact=grid.size, between=grid.size)


def stress_of_rows(problem: ContactProblem, rms: float) -> float:
    """Rms of Kh along some of the rows of heights, whose rms is `rms`; heights that hardly change along rows count as
    waves of the length of the cell, 1/30 as high.  Collective.
    """
    grid, (nx, ny) = problem.grid, problem.grid.shape
    every = max(1, nx // MOST_ROWS)
    rows = problem.heights[-grid.rows.start % every :: every]
    if not grid.domain.wraps:
        rows = rows * np.hanning(ny)
    stiffness = problem.solid.stiffness(2 * math.pi / grid.lengths[1] * np.arange(max(ny // 2, 1) + 1))
    squares = math.fsum(float(np.sum(np.abs(stiffness[: ny // 2 + 1] * np.fft.rfft(row)) ** 2)) for row in rows)
    total, count = grid.reduction.sums(squares, len(rows))
    return math.sqrt(2 * float(total) / float(count) / ny**2 + 1e-3 * float(stiffness[1] * rms) ** 2)


class ActiveSetIteration(NestedIteration[State]):
    """Nested iteration by active sets."""

    def __init__(self, tolerance: float, monitor: Monitor | None) -> None:
        super().__init__(tolerance, monitor)
        self.stresses: dict[int, float] = {}  # `stress_of_rows` by number of points, if an area is imposed

    def coarser(self, problem: ContactProblem) -> Coarse | None:
        """The next coarser grid, or None if the solution there would be no good start.  Collective."""
        if problem.imposed is not None and problem.imposed.area:
            self.stresses[problem.grid.size] = stress_of_rows(problem, self.rms)
        return super().coarser(problem)

    def resume(self, problem: ContactProblem, start: np.ndarray) -> State:
        """Full contact, if it starts there and stays, or else from the pressure made feasible."""
        grid, highest, state = problem.grid, problem.law.highest, _new_state(problem)
        if grid.reduction.min(start) > 0 and (full := _full_contact(problem)) is not None:
            return full
        np.clip(start * (problem.load / grid.reduction.sum(start)), 0.0, highest, out=state.pressure)
        np.negative(problem.heights, out=state.gap)
        scale_to_load(problem, (state.pressure, state.gap))
        state.base = -grid.reduction.dot(state.pressure, problem.heights) / problem.load  # λ without ⟨p u⟩/p̄
        state.between = int(grid.reduction.sum((state.pressure > 0) & (state.pressure < highest)))
        return self.relax(problem, state)

    def energy(self, state: State, size: int) -> float:
        """The state's energy is that of all points."""
        return state.energy / size

    def coarsest(self, problem: ContactProblem, exact: bool) -> State:
        """From a uniform pressure."""
        if problem.imposed is not None:
            grid, imposed = problem.grid, problem.imposed
            guess = imposed.guess(stress_of_full_contact(problem), self.rms, grid.size)
            if not (imposed.area or grid.domain.wraps):  # a flat punch as high bears more
                summit = grid.reduction.max(problem.heights)
                most = PUNCH * max(imposed.approach + summit, LIGHTEST * summit)
                guess = min(guess, most / grid.reduction.max(problem.solid.modes(grid)))
            state = self.coarsest(problem.imposing(None, guess), True)
            state.clipped = False
            if problem.imposed.area:
                state.aim = Aim(problem.imposed, self.stresses, pressure=guess)
            return self.relax(problem, state, exact)
        if (full := _full_contact(problem)) is not None:
            return full
        state = _new_state(problem)
        state.pressure[...], state.gap[...] = problem.mean_pressure, 0.0
        return self.relax(problem, state, exact)

    def prolong(self, coarse: Coarse, found: State, problem: ContactProblem) -> tuple[State, bool]:
        """Full contact and True, if both grids have it; else a start from the coarse state and False.  The start is in
        contact where the interpolated pressure, acting on one coarse pixel, displaces it by more than the gap to the
        fine heights (`start_rows`).  So the edge of a patch is right to a fraction of a coarse pixel.

        In coarse contact the gap is taken as 0: what the coarse grid left there is mostly long waves, and a pixel's
        compliance would answer them with far too large pressures.
        """
        full_before = problem.imposed is None and found.between == coarse.place.size
        if full_before and (full := _full_contact(problem)) is not None:
            return full, True
        grid, state, highest = problem.grid, _new_state(problem), problem.law.highest
        fields, real = (state.pressure, state.gap), state.pressure.dtype
        aim, size = found.aim, coarse.place.size
        if aim is not None:
            at = Measured(found.base + found.level, found.load / size, found.energy / size, found.contact, size)
            aim = aim.refine(at)
            problem = problem.at(aim.pressure or at.pressure)

        def close(first: int, stop: int) -> None:
            gap, p = found.gap[first:stop], found.pressure[first:stop]
            gap -= found.level
            gap[(p > 0) & (p < highest)] = 0

        grid.threads.deal(close, len(found.gap), grid.band)
        given = [field.astype(real, copy=False) for field in (found.pressure, found.gap, coarse.heights)]
        interpolation = Interpolation(coarse.place, grid, given)
        compliance = real.type(max(coarse.place.spacing) / problem.solid.surface_modulus)

        def part(thread: int, first: int, stop: int) -> None:
            rows, read = slice(first, stop), partial(interpolation.rows, first=first, stop=stop, thread=thread)
            heights, own = problem.heights[rows].astype(real), (state.pressure[rows], state.gap[rows])
            start_rows((read(0), read(1), read(2)), heights, compliance, own)

        grid.threads.share(part, grid.local_shape[0], grid.band)
        scale_to_load(problem, fields)
        state.between = round(found.between / size * grid.size)
        state.base, state.estimated, state.aim = found.base + found.level, True, aim
        return state, False

    def relax(self, problem: ContactProblem, state: State, exact: bool = True) -> State:
        """Relaxes a state with pressures or gaps as unknowns, whichever cost less (`gaps_from`).  Collective."""
        if problem.imposed is not None and problem.imposed.area:
            known = self.stresses or {problem.grid.size: 1.0}
            state.aim = state.aim or Aim(problem.imposed, known, pressure=problem.mean_pressure)
            problem = problem.imposing(None, state.aim.pressure)
        given = problem.imposed is None
        part = (gaps_from(problem.grid.size) if state.aim is None else AREA_FROM) if given else GAP_FROM
        by_gaps = problem.imposed is None or problem.imposed.is_gap
        by_gaps &= problem.law.highest == np.inf and problem.grid.domain.wraps
        by_gaps &= state.between > part * problem.grid.size
        steps: type[Relaxation] = GapSteps if by_gaps else PressureSteps
        if is_thin(problem):
            steps = ThinSteps
        with balanced(problem, state, gaps=steps is GapSteps):
            solver = steps(problem, exact)
            try:
                solver.relax(state, self.tolerance, self.watch(problem))
            except SolverError as failure:
                if shared(problem.grid.comm, failure):
                    solver.free()
                raise
            solver.free()
        if exact:
            problem.grid.make_room()
            if problem.grid.storage is np.float64:
                solver.widen(state)
        return state


solve_hard_wall = ActiveSetIteration.contact
"""The contact with a hard wall, or one of limited hardness: see `NestedIteration.contact`.  Collective."""


@jit
def start_rows(coarse: tuple[np.ndarray, ...], heights: np.ndarray, compliance: float, fields: Fields) -> None:
    """Fills pressure and gap that start a finer grid, from pressure, gap and heights of the coarse one interpolated.
    With new = h − coarse h, the gap is g = coarse g − new.  Where compliance · coarse p > g the point is in contact:
    its pressure is max(coarse p + ROUGHER · new/compliance, tiny), its gap g + ROUGHER · new.  Elsewhere p = 0.
    """
    (coarse_pressure, coarse_gap, coarse_heights), (pressure, gap) = coarse, fields
    for i in range(pressure.shape[0]):
        for j in range(pressure.shape[1]):
            p, new = coarse_pressure[i, u(j)], heights[i, u(j)] - coarse_heights[i, u(j)]
            g = coarse_gap[i, u(j)] - new
            closed = compliance * p > g
            gap[i, u(j)] = g + ROUGHER * new if closed else g
            p += ROUGHER / compliance * new
            pressure[i, u(j)] = (p if p > 1e-30 else 1e-30) if closed else 0.0
