"""Newton's method on the dual problem, on one grid, for any law whose pressure decreases with the gap, p = P(e).

With p̂ = p/p̄, G the compliance per p̂, heights h, the law's gap e at p̂ and w = √(−P'(e)), Newton's equation for the
change δp̂ = w y is

    (1 + w G w) y = −w (g − e − c),  g = Gp̂ − h,  Σ w y = 0.

Under the exponential wall, P = exp(−e/ζ), w is √(p̂/ζ).  The spectrum of this operator decays fast from the largest
eigenvalues on, and conjugate gradients take one convolution per iteration.

The step is taken point by point in x = α p̂ − e(p̂) (α: compliance of a region `REACH` pixels across), so that p̂ stays
positive.  In contact this is a step in p̂, outside it is one in the gap.  The old e cancels:

    α p̂ − e(p̂) = α (p̂ + δp̂) − (g + Gδp̂) + c.

For a law that becomes hard this becomes the primal–dual active set of the hard wall.  The constant c (`level` in the
code) is chosen so that the pressures bear the load.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from pgfmd.errors import SolverError
from pgfmd.grid.transforms import sink
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.exponential_wall import loops
from pgfmd.solvers.law_operations import LawOperations, LawState, local_compliance
from pgfmd.solvers.solution import Patience, Precision, uncertifiable

REACH = 8  # diameter in pixels of the region whose compliance is α: if smaller, points that join a patch overshoot
MOST_INNER, MOST_OUTER = 1000, 200
LEAST_CUT, MOST_CUT = 0.1, 0.03  # factor on the linear residual in a step; MOST_CUT after one that cut the error by 10
STIFFEST = 1e6  # −P' over 1/α at most: where the wall is hard, −P' is infinite
STIFF_LOAD = 1e12  # compliance per p̂ over the heights, whose cube single precision cannot hold (3e38)


class Newton(LawOperations):
    """Newton iterations for a dimensionless problem."""

    precision: Precision = np.float32  # of the linear equation

    def __init__(self, problem: ContactProblem):
        super().__init__(problem)
        self.alpha = local_compliance(problem, REACH)
        if self.alpha > STIFF_LOAD:
            self.precision = np.float64

    def relax(self, state: LawState, tolerance: float, monitor: Callable[[LawState], None] | None = None) -> LawState:
        """Iterate until the certified error is at most `tolerance`.  Overwrites and returns `state`.  Collective.

        Raises SolverError if the error stops falling above the tolerance, Uncertifiable if that is due to rounding.
        """
        self.compute_gap(state)
        self.certify(state)
        patience, wanted = Patience(), LEAST_CUT
        patience.take(state.error)
        for _ in range(MOST_OUTER):
            if monitor is not None:
                monitor(state)
            if self.arrived(state, tolerance):
                return state
            before = state.error
            enough = min(LEAST_CUT, 0.3 * math.sqrt(tolerance / before))  # the error is of second order in the residual
            self.respond(state, self.newton_target(state, max(wanted, enough)), self.alpha)
            self.compute_gap(state)
            self.certify(state)
            wanted = MOST_CUT if state.error < 0.1 * before else LEAST_CUT
            if not patience.take(state.error):
                break
        raise self.failure(patience, state, tolerance)

    def failure(self, patience: Patience, state: LawState, tolerance: float) -> SolverError:
        """What to raise when the error stops falling."""
        if not state.rounding <= tolerance:
            return uncertifiable(state.rounding, tolerance)
        return patience.failure(self.law.kind, self.grid, state.iterations, tolerance)

    def newton_target(self, state: LawState, wanted: float) -> np.ndarray:
        """α (p̂ + δp̂) − (g + Gδp̂) of a Newton step.  Collective."""
        root, change, response = self.newton_step(state, wanted)
        target = self.grid.new_field()

        def aim(pressure: np.ndarray, gap: np.ndarray, *step: np.ndarray) -> None:
            root, change, response, target = step
            target[...] = self.alpha * (pressure + root * change) - (gap + response)

        self.each(aim, state.pressure, state.gap, root, change, response, target)
        return target

    def linearise(self, pressure: np.ndarray, gap: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """g − e and −P'(e), at most `STIFFEST`/α, of some rows."""
        away, slope = np.empty(gap.shape), np.empty(gap.shape)
        self.law.gap_and_slope(pressure, away, slope)
        return np.subtract(gap, away, out=away), np.minimum(slope, STIFFEST / self.alpha, out=slope)

    def start(self, state: LawState, root: np.ndarray, residual: np.ndarray) -> tuple[float, float]:
        """Fills w and −w (g − e − c), c such that Σ w × that is 0; returns Σ of its squares, and Σ w².  Collective."""

        def sums(pressure: np.ndarray, gap: np.ndarray) -> tuple[float, float]:
            away, slope = self.linearise(pressure, gap)
            return float(slope.sum()), float(np.vdot(slope, away))

        mass, moment = self.total(sums, state.pressure, state.gap)
        level = moment / mass if mass > 0 else 0.0

        def fill(pressure: np.ndarray, gap: np.ndarray, root: np.ndarray, residual: np.ndarray) -> None:
            away, slope = self.linearise(pressure, gap)
            np.sqrt(slope, out=root, casting="same_kind")
            np.multiply(root, level - away, out=residual, casting="same_kind")

        self.each(fill, state.pressure, state.gap, root, residual)
        return float(self.grid.reduction.dot(residual, residual)), max(float(mass), np.finfo(float).tiny)

    def newton_step(self, state: LawState, wanted: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """w, y and Gwy (nx_local, ny) of a step δp̂ = w y; its linear residual falls by `wanted`.  Collective."""
        grid, real = self.grid, self.precision
        root, residual, direction, product, change, response = np.zeros((6, *grid.local_shape), real)
        square, mass = self.start(state, root, residual)
        goal, beta = wanted**2 * square, 0.0

        def fill(first: int, stop: int, block: np.ndarray) -> None:
            np.multiply(root[first:stop], direction[first:stop], out=block)

        def step(first: int, stop: int) -> float:
            rows = slice(first, stop)
            system, sums = (direction[rows], product[rows]), (change[rows], response[rows])
            return loops.step(root[rows], system, sums, residual[rows], numbers)

        def turn(residual: np.ndarray, direction: np.ndarray) -> None:
            direction *= real(beta)
            direction += residual

        for _ in range(MOST_INNER):
            if square <= goal:
                break
            self.each(turn, residual, direction)
            grid.convolve(fill, self.compliance[real], sink(product), real)
            curved, norm, along = self.total(loops.curvature_sums, root, direction, product)
            length = square / (curved + norm)
            numbers = real(along / mass), real(length)
            new = grid.reduction.sum(grid.threads.collect(step, len(root)))
            beta, square = new / square, new
            state.iterations += 1
        return root, change, response
