"""A wall at imposed load: minimise J(p) = ½⟨p, Gp⟩ − ⟨p, h⟩ over 0 ≤ p ≤ σ_Y with Σ p = P (G: compliance, h:
heights, σ_Y: largest pressure, infinite for a hard wall).

`Relaxation.relax` solves on one grid by a primal–dual active set (Hintermüller, Ito, Kunisch 2002,
doi:10.1137/S1052623401383558).  The unknowns are the pressures of the points between the bounds (`primal`) or, if most
points are, the gaps of the others (`dual`).  Each step computes the response to a feasible state by full transforms,
chooses the unknowns, solves for them by conjugate gradients in single precision with a particle–mesh response, and
makes the state feasible again.

The stop is a certificate, ½⟨ε, Kε⟩, of second order in the error of the gap, for any field ε with

    ε = g − λ  where 0 < p < σ_Y,        ε ≤ g − λ  where p = 0,        ε ≥ g − λ  where p = σ_Y

(proof in NUMERICS.md).  Where p is at a bound, ε may be chosen; smooth fields give the lowest bound (`continuation`).

Quantities here are dimensionless (`nondimensional`): pressures over their mean, heights in a unit of about their size.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pgfmd.errors import SolverError, Uncertifiable
from pgfmd.grid.aligned import widened
from pgfmd.grid.kernels import jit, u
from pgfmd.grid.transforms import in_chunks, source
from pgfmd.physics.problem import Aim, ContactProblem, Measured
from pgfmd.solvers.active_set.conjugate_gradients import ConjugateGradients, Mean
from pgfmd.solvers.active_set.continuation import (
    BESIDE,
    STRIDES,
    BlockMeans,
    Limits,
    average_between,
    residual_limits,
)
from pgfmd.solvers.active_set.particle_mesh import FullResponse, MeshResponse
from pgfmd.solvers.active_set.unknowns import PIECE, Fields
from pgfmd.solvers.second_order import LEAST_ERROR, Rounding, certified, energy_of_residual
from pgfmd.solvers.solution import SOLVER_SHARE, STEPS, Patience, Precision, uncertifiable

LEAST_CUT, MOST_CUT = 0.2, 0.14  # factor on the residual in one step, at errors above 4 % and below 2 %
CUT_POWER = 0.7  # after a step with the factor f on the error, the next one takes f^0.7 or less on the residual
MARGIN = 0.4  # part of the tolerance at which the last step aims
WITHIN = 0.45  # a step aims at the tolerance if the factor for that is at least this part of the useful one
MOST_STEPS = 200  # before giving up
WORST = 0.4  # largest error of a start that counts
MOVED = 1e-4  # the same where an area or a gap is sought; at 1e-5 searches cost 5 % more
ROUGH, LOOSER = 5e-3, 3  # error of a start from which roughness that only this grid resolves makes most of it
FINEST = 1e-8  # smallest one: single precision reaches it on any grid
UNSEEN = 0.05  # part of the tolerance below which rounding does not decide the next step
MOST_UNSEEN = 0.3  # the same where fields are stored in single precision, since no step can be in double there


@dataclass
class State:
    """Pressure and gap (nx_local, ny) on one grid, under a hard wall in single precision while that suffices.

    Unless `clipped`, the gap is Gp − h − base, and λ = base + level, the level that of points in contact.  The base is
    an earlier λ, so that gaps in contact are small, and lose no digits in single precision.  clipped: true if `gap` is
    measured from λ, at least 0, and 0 where the pressure lies between its bounds.  estimated: true if it comes from a
    coarser grid.  load: Σ p.  aim: what is prescribed where no load is given.  energy: ½⟨p, Gp⟩.  error: of the energy
    over 2 · energy, certified or estimated.  contact: number of points with p > 0; between: of those with 0 < p < σ_Y.
    iterations: of conjugate gradients.  pressure_error: ‖Kε‖/‖p‖ of a certificate.  shift: row i of the fields is
    row i + shift of the periodic cell (`balance`).
    """

    pressure: np.ndarray
    gap: np.ndarray
    clipped: bool = False
    base: float = 0.0
    level: float = 0.0
    load: float = 0.0
    energy: float = 0.0
    error: float = math.inf
    contact: int = 0
    between: int = 0
    iterations: int = 0
    pressure_error: float = 0.0
    shift: int = 0
    estimated: bool = False
    aim: Aim | None = None


class Relaxation:
    """Relaxation of a dimensionless problem.  exact: whether errors are certified; on coarse grids they are estimated.

    Attributes: highest, the largest pressure σ_Y; squares, Σ p² and Σ u² of the last response; heights_squared, see
    `Rounding.bound`, where p > 0; summit, the largest height.  precision: the one to begin with; patience: steps
    without halving the least error before giving up; enough: the error at which to end.  inner: the response between
    unknowns.  load_changed: whether the system of the last state is for a new load, so that its residual is no error of
    the state (`GapSteps`).
    """

    precision: Precision = np.float32
    patience = STEPS
    spare = math.inf  # compliance: a pressure p counts as 0 in certificates, at a price, where g − λ > spare · p
    coarse_part = 0.05  # tolerance of a coarse grid over the error of its start: long waves left there cost most later
    inner: MeshResponse | FullResponse
    enough = 0.0
    load_changed = False

    def __init__(self, problem: ContactProblem, exact: bool = True) -> None:
        grid, solid = problem.grid, problem.solid
        self.grid, self.heights, self.problem, self.exact = grid, problem.heights, problem, exact
        self.highest, self.kind, self.imposed = problem.law.highest, problem.law.kind, problem.imposed
        precisions: tuple[Precision, Precision] = (np.float32, np.float64)
        self.compliance = {real: solid.apply_compliance(grid, real, 1 / grid.modes) for real in precisions}
        self.stiffness = {real: solid.apply_stiffness(grid, real, 1 / grid.modes) for real in precisions}
        self.squares, self.heights_squared = np.zeros(2), 0.0
        self.rounding = Rounding(grid, solid) if exact else None
        self.summit = float(grid.reduction.max(problem.heights))

    def relax(self, state: State, tolerance: float, monitor: Callable[[State], None] | None = None) -> State:
        """Iterate until the error is at most `tolerance`.  Overwrites and returns `state`.  Collective.

        `state.pressure` must be feasible.  Raises SolverError if the error stops falling above the tolerance, and
        Uncertifiable if that is due to rounding in the precision in which fields are stored.
        """
        precision, patience = self.precision, Patience(self.patience)
        asked, can_widen = tolerance, self.grid.storage is np.float64
        unseen = UNSEEN if can_widen else MOST_UNSEEN
        before, raised = math.inf, 1.0  # the last estimate; factor on estimates, since certificates were higher
        for step in range(MOST_STEPS):
            if precision is np.float64:
                self.widen(state)
            system, self.enough = self.linearise(state, precision), tolerance
            # Where the preconditioner is good, ½⟨r, Mr⟩ is .3 to .7 of the bound.
            estimate = raised * system.square / (2 * state.energy) if state.energy > 0 else math.inf
            if step == 0 and not self.exact:
                tolerance = self.goal(estimate, tolerance, WORST if state.aim is None or state.clipped else MOVED)
            if self.imposed is not None and self.exact:
                tolerance = min(asked, max(self.imposed.needed(self.measured(state)), LEAST_ERROR))
            rounding = self.rounding_bound(state, precision) / (2 * state.energy) if state.energy > 0 else 0.0
            negligible = precision is np.float64 or rounding <= unseen * tolerance
            state.error = max(estimate, rounding)
            ready = negligible and not self.load_changed and self.met(state)
            if self.exact and ready and estimate <= tolerance:
                state.error = self.certify(state, system, precision)
                raised *= max(1.0, state.error / (max(estimate, MARGIN * tolerance) or tolerance))
            if monitor is not None:
                monitor(state)
            if ready and state.error <= tolerance:
                return state
            if precision is np.float64 and rounding > max(tolerance, estimate):
                raise uncertifiable(rounding, tolerance)
            if not patience.take(estimate, state.error):
                break
            enough = MARGIN * tolerance / max(estimate, tolerance)
            wanted, before = self.next_cut(estimate, before, math.sqrt(enough)), estimate
            # Before rounding would show in the next estimate, precision changes.
            shows = rounding > unseen * max(tolerance, self.left(wanted, enough) * estimate)
            if shows and not can_widen:
                raise Uncertifiable(
                    f"the error cannot be certified below about {rounding / unseen / SOLVER_SHARE:.1e}, by rounding in "
                    'single precision; allow a larger tolerance, or take solver.storage = "float64"'
                )
            if shows:
                precision = np.float64
            self.improve(state, system, wanted, enough)
        raise patience.failure(self.kind, self.grid, state.iterations, tolerance)

    def widen(self, state: State) -> None:
        """Brings a state to double precision and base 0, the load of a single one to the last digit.  Collective."""
        if state.pressure.dtype == np.float32:
            rows, factor = self.grid.band, 1.0
            if self.imposed is None:
                factor = self.problem.load / self.grid.reduction.sum(state.pressure)
            state.pressure = widened(state.pressure, np.multiply, factor, rows)
            state.gap = widened(state.gap, np.add, state.base, rows)
        elif state.base:
            state.gap += state.base
        state.level, state.base = state.level + state.base, 0.0

    def left(self, wanted: float, enough: float) -> float:
        """The part of the estimate that a step with these arguments of `improve` probably leaves."""
        return wanted**2

    @staticmethod
    def next_cut(estimate: float, before: float, last: float) -> float:
        """Factor by which the next step multiplies the residual of its system.  A smaller one is wasted if the change
        of the set, which the last two errors predict, leaves a larger error; with `last` the tolerance is met.
        """
        if not estimate < math.inf:
            return LEAST_CUT
        changes = min(LEAST_CUT, max(MOST_CUT, math.sqrt(estimate)))
        if 0 < before < math.inf:
            changes = min(changes, (estimate / before) ** CUT_POWER)
        return last if last >= WITHIN * changes else changes

    @classmethod
    def goal(cls, estimate: float, tolerance: float, worst: float = WORST) -> float:
        """Tolerance for a coarse grid: a part of the estimated error of its start, since interpolation to the next grid
        will make such an error again; at least `FINEST` and a quarter of the tolerance.
        """
        part = cls.coarse_part * (LOOSER if estimate > ROUGH else 1)
        return max(part * min(estimate, worst), tolerance / 4, FINEST)

    def linearise(self, state: State, precision: Precision) -> ConjugateGradients:
        """Computes the response to a feasible state.  Returns the system for the unknowns it chooses.  Collective."""
        raise NotImplementedError

    def improve(self, state: State, system: ConjugateGradients, wanted: float, enough: float) -> None:
        """Reduces the residual of the system by the factor `wanted`, and makes the state feasible.  Steps without full
        transforms may follow, until `system.square` has fallen by the factor `enough`.  Collective.
        """
        raise NotImplementedError

    def free(self) -> None:
        """Frees the inner solver and its transforms.  Collective."""
        self.inner.free()
        del self.inner

    def measure(self, state: State) -> None:
        """Sets the state's level, energy and counts from a pressure and its gap, and Σ p².  Collective."""
        fields, limits = (state.pressure, state.gap, self.heights), (self.highest, self.summit, state.base)
        parts = self.grid.threads.collect(lambda a, b: contact_sums(fields, limits, a, b), len(self.heights))
        totals = self.grid.reduction.sums(*map(math.fsum, zip(*parts, strict=True)))
        work, load, between, energy, self.squares[0], self.heights_squared, count = totals
        state.energy, state.contact, state.between = float(energy) / 2, int(count), int(between)
        state.load = float(load)
        if between:
            state.level = float(work / load)
        else:  # all points are at a bound: any level between the gaps at σ_Y and those at 0 is right
            full, free = state.gap[state.pressure > 0], state.gap[state.pressure == 0]
            state.level = (self.grid.reduction.max(full) + self.grid.reduction.min(free)) / 2

    def measured(self, state: State) -> Measured:
        """The numbers of a state that was `measure`d, for what is imposed."""
        size = self.grid.size
        return Measured(state.base + state.level, state.load / size, state.energy / size, state.contact, size)

    def met(self, state: State) -> bool:
        """Whether the state is at the imposed load, or at what is imposed instead."""
        return state.aim is None or not self.exact or state.aim.target.missed(self.measured(state)) <= 1

    def next_pressure(self, state: State, square: float) -> float:
        """The mean pressure for the next step of a search for an area, if it is to change and the area is known well
        enough (`Aim`); else 0.  square: about twice the error of the energy.
        """
        if not (self.exact and state.aim is not None and state.aim.target.area and state.energy > 0):
            return 0.0
        error = max(square / (2 * state.energy) - self.enough, 0.0)
        return state.aim.pressure if state.aim.moves(self.measured(state), error) else 0.0

    def imposed_level(self, state: State, least: float = -math.inf) -> tuple[float, Mean]:
        """The level λ by which an imposed approach is sought, at least `least`, and how the system treats Σ x.  Makes
        and moves the aim of a state that was `measure`d.  Raises SolverError if contact is lost.
        """
        assert self.imposed is not None
        if not (state.load > 0 and state.energy > 0):
            raise SolverError("contact is lost; allow a larger tolerance")
        at, compliance = self.measured(state), self.imposed.compliance / self.grid.size
        state.aim = state.aim or Aim(self.imposed)
        state.aim.follow(at, least)
        return state.aim.level, Mean(False, compliance, 1 / (at.range / state.load + compliance))

    def compute_gap(self, state: State, precision: Precision) -> None:
        """Sets the state's gap, of either sign; its base: the last λ, or 0 in double precision.  Collective."""
        squares: dict[int, tuple[float, ...]] = {}
        state.base = base = state.base + state.level if state.gap.dtype == np.float32 else 0.0

        def drain(first: int, stop: int, rows: np.ndarray) -> None:
            squares[first] = (gap_of(rows, self.heights[first:stop], base, state.gap[first:stop]),)

        self.grid.convolve(source(state.pressure), self.compliance[precision], drain, precision)
        (self.squares[1],) = self.grid.reduction.sums_of_blocks(squares, 1)

    def certify(self, state: State, system: ConjugateGradients, precision: Precision) -> float:
        """`bound` of a state while it is solved.  system: from `linearise`.  Collective."""
        return self.bound(state, precision)

    @cached_property
    def means(self) -> BlockMeans:
        """Where ε begins.  Collective on first use."""
        return BlockMeans(self.grid)

    def bound(self, state: State, precision: Precision) -> float:
        """A bound of the energy error over 2 · energy of a state that was `measure`d, rounding included.  Collective.

        Sets `state.pressure_error` = ‖Kε‖/‖p‖.  If every point is an unknown, p* − p = −Kε; else it is an estimate.
        """
        margin, own = BESIDE, (state.pressure, state.gap)
        p, g = self.grid.neighbours(own, margin)
        pieces = ((p[:margin], g[:margin]), 0), (own, margin), ((p[margin:], g[margin:]), margin + len(own[0]))
        real, wide, ny = state.gap.dtype.type, STRIDES[0], self.grid.shape[1]
        limits, paid = (real(state.level), real(self.highest), real(self.spare)), dict[int, float]()
        edges, wraps = np.r_[:wide, wide + ny : 2 * wide + ny], self.grid.domain.wraps
        within = wide + self.grid.domain.indices(edges - wide, ny)
        values, start = self.means.of(own, limits)

        def make(first: int, stop: int) -> np.ndarray:
            stop, at = min(stop, len(own[0])), 0
            work = np.empty((4, stop - first + 2 * margin, ny + 2 * wide), np.float32)
            for fields, begin in pieces:
                part = slice(max(first - begin, 0), max(stop + 2 * margin - begin, 0))
                piece = fields[0][part], fields[1][part]
                residual_limits(piece, limits, (at, wide), (values, start + first - margin + at), work)
                at += len(piece[0])
            if not wraps:  # ε = 0 beyond the border
                outside = np.arange(first, stop + 2 * margin) - margin + self.grid.rows.start
                work[:, (outside < 0) | (outside >= self.grid.shape[0])] = 0
            for done, stride in enumerate(STRIDES):
                field, means = work[2 + done % 2], work[3 - done % 2]
                field[:, edges] = field[:, within] if wraps else 0.0
                average_between(field, work[:2], stride, wide, means)
            found = means[margin:-margin, wide:-wide]
            if self.spare < math.inf:
                paid[first] = excess((own[0][first:stop], own[1][first:stop]), limits, found)
            return found

        rows = in_chunks(make, max(2 * self.grid.band, 2 * margin), self.grid.threads.count)
        square, change = energy_of_residual(self.grid, rows, self.stiffness[np.float32])
        state.pressure_error = math.sqrt(change / self.squares[0])
        more = self.grid.reduction.sum([paid[first] for first in sorted(paid)]) if self.spare < math.inf else 0.0
        return (certified(square, self.rounding_bound(state, precision)) + more) / (2 * state.energy)

    def rounding_bound(self, state: State, precision: Precision) -> float:
        """A bound of ½‖e‖²_K for the rounding error e of the state's gap, computed in a precision; 0 if not `exact`."""
        if self.rounding is None:
            return 0.0
        squares = self.squares.copy()
        if state.gap.dtype == np.float32:  # rounds gaps in contact, near `level`, once more
            squares[1] += state.contact * state.level**2
        return self.rounding.bound(squares, self.heights_squared, 2 * state.energy, precision)


@jit
def gap_of(displacement: np.ndarray, heights: np.ndarray, base: float, gap: np.ndarray) -> float:
    """gap = u − (h + base) for rows of a displacement u; returns Σ u²."""
    total = 0.0
    for i in range(gap.shape[0]):
        for j in range(gap.shape[1]):
            value = np.float64(displacement[i, u(j)])
            gap[i, u(j)] = value - (heights[i, u(j)] + base)
            total += value * value
    return total


@jit
def contact_sums(
    fields: tuple[np.ndarray, np.ndarray, np.ndarray], limits: tuple[float, float, float], first: int, stop: int
) -> tuple[float, float, int, float, float, float, int]:
    """(Σ p g, Σ p and number of points where 0 < p < highest; Σ p (g + base + h), Σ p², Σ h² + (h − summit)² and number
    of points where p > 0) over rows first … stop−1.  fields: p, g, h; limits: highest, summit, base.
    """
    (pressure, gap, heights), (highest, summit, base) = fields, limits
    work = load = energy = squares = heights_squared = 0.0
    between = count = 0
    for i in range(first, stop):
        row = pressure[i]
        for begin in range(0, row.size, PIECE):
            end, some = min(begin + PIECE, row.size), row[u(0)] * 0
            for j in range(begin, end):  # vectorised; the sum is 0 where no pressure is above 0
                some += row[u(j)]
            for j in range(begin, end if some != 0 else begin):
                p = np.float64(row[u(j)])
                if p > 0:
                    g, h = np.float64(gap[i, u(j)]), heights[i, u(j)]
                    energy += p * (g + base + h)
                    squares += p * p
                    heights_squared += h * h + (h - summit) ** 2
                    count += 1
                    if p < highest:
                        work += p * g
                        load += p
                        between += 1
    return work, load, between, energy, squares, heights_squared, count


@jit
def excess(fields: Fields, limits: Limits, residual: np.ndarray) -> float:
    """Σ p (g − λ − ε) of points that pay for ε < g − λ, and Σ (σ_Y − p)(ε − g + λ) of those for ε > g − λ."""
    (pressure, gap), (level, highest, spare) = fields, limits
    total = 0.0
    for i in range(gap.shape[0]):
        for j in range(gap.shape[1]):
            p, rest = pressure[i, u(j)], gap[i, u(j)] - level
            rounded, chosen = np.float32(rest), residual[i, u(j)]  # as in `residual_limits`
            if p > 0 and rounded > spare * p:
                total += p * (rest - chosen)
            elif p < highest and -rounded > spare * (highest - p):
                total += (highest - p) * (chosen - rest)
    return total
