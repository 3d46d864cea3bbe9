"""The exponential wall on one grid: a smoothed active-set Newton method on the dual problem.

With p̂ = p/p̄, G the compliance per p̂ and heights h, minimise J(p̂) = ½⟨p̂, Gp̂⟩ − ⟨h, p̂⟩ + ζ⟨p̂, ln p̂⟩ over p̂ > 0
of mean 1.  Newton's equation for the change δp̂ = √p̂ y is

    (ζ + √p̂ G √p̂) y = −√p̂ (g + ζ ln p̂ − c),  g = Gp̂ − h.

Its spectrum decays fast from the largest eigenvalues on, no entry overflows however small p̂ is, and conjugate gradients
take one convolution per iteration.

The step is not taken in p̂, which would have to stay positive, but point by point in x = α p̂ + ζ ln p̂ (α: compliance of
a few points).  In contact that is a step in p̂, outside it is one in ln p̂; and ln p̂ of the old state cancels:

    α p̂ + ζ ln p̂ = α (p̂ + δp̂) − (g + Gδp̂) + c.

As ζ → 0 this becomes the primal–dual active set of the hard wall.  c carries the load.

The certificate: the wall's answer to the gap, σ̂ = exp(−g/ζ)/⟨exp(−g/ζ)⟩, against the pressure.  For any feasible p̂

    J(p̂) − J(p̂*) ≤ D(p̂) = ζ ⟨p̂ ln(p̂/σ̂)⟩,

the duality gap to the primal ½⟨u, Ku⟩ + ζ ln⟨exp(−(u − h)/ζ)⟩ at u = Gp̂ (Fenchel for the quadratic form, Gibbs'
variational principle for the other term).  It is ζ times a relative entropy, and tends to that of the hard wall,
⟨p̂, g − min g⟩.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from pgfmd.errors import SolverError
from pgfmd.grid import kernels
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.elasticity import Elasticity
from pgfmd.solvers.exponential_wall import kernels as entropy

REACH = 8  # pixels across the region whose compliance is α: with less, points that join a patch together overshoot
MOST_INNER, MOST_OUTER = 1000, 200
PATIENCE = 12  # outer steps without halving the best error, before giving up


@dataclass
class WallState:
    """p̂ and g (nx_local, ny) on one grid, and what is known about them; `error` is D/⟨p̂, Gp̂⟩."""

    pressure: np.ndarray
    gap: np.ndarray
    error: float = np.inf
    objective: float = np.inf
    work: float = 0.0  # ⟨p̂, Gp̂⟩
    level: float = 0.0  # c: at the solution ζ ln p̂ = c − g
    contact: int = 0  # points that carry more than the mean
    iterations: int = 0


class WallRelaxation:
    """Newton iterations for `heights` (nx_local, ny); `compliance_unit`: mean pressure over the unit of height."""

    def __init__(self, grid: SlabGrid, heights: np.ndarray, elasticity: Elasticity, compliance_unit: float):
        self.grid, self.heights = grid, heights
        factor = compliance_unit / grid.size
        self.compliance = {kind: elasticity.apply_compliance(grid, kind, factor) for kind in (np.float32, np.float64)}
        self.reach = compliance_unit / float(elasticity.stiffness(2 / (REACH * max(grid.spacing))))

    def relax(
        self, state: WallState, zeta: float, tolerance: float, monitor: Callable[[WallState], None] | None = None
    ) -> WallState:
        """Iterate until the certified error is at most `tolerance`.  Overwrites and returns `state`.  Collective.

        Raises SolverError if the error stops falling above the tolerance.
        """
        self.compute_gap(state)
        self.certify(state, zeta)
        best, patience, wanted = state.error, PATIENCE, 0.1
        for _ in range(MOST_OUTER):
            if monitor is not None:
                monitor(state)
            if state.error <= tolerance:
                return state
            before = state.error
            self.advance(state, zeta, max(wanted, 0.3 * math.sqrt(tolerance / before)))
            wanted = 0.03 if state.error < 0.1 * before else 0.1
            patience = PATIENCE if state.error < 0.5 * best else patience - 1
            best = min(best, state.error)
            if patience == 0:
                break
        raise SolverError(
            f"exponential wall: the certified error stays at {best:.1e}, above the tolerance {tolerance:.1e}, after "
            f"{state.iterations} iterations on {self.grid.shape[0]} x {self.grid.shape[1]} points; ask for less"
        )

    def compute_gap(self, state: WallState) -> None:
        """g = Gp̂ − h in double precision.  Collective."""

        def fill(first: int, stop: int, rows: np.ndarray):
            rows[...] = state.pressure[first:stop]

        def drain(first: int, stop: int, rows: np.ndarray):
            kernels.subtract_rows(rows, self.heights[first:stop], state.gap[first:stop])

        self.grid.convolve(fill, self.compliance[np.float64], drain)

    def total(self, kernel, *arguments) -> np.ndarray:
        """The sums over all rows of all ranks of what a kernel returns for some rows.  Collective."""
        parts = self.grid.threads.collect(
            lambda a, b: np.atleast_1d(kernel(*arguments, a, b)), self.grid.local_shape[0]
        )
        return self.grid.reduction.sums(*np.sum(parts, axis=0))

    def certify(self, state: WallState, zeta: float) -> None:
        """Objective, energy and certified error of a feasible state; ζ = 0 is the hard wall.  Collective."""
        count = self.grid.size
        least = self.grid.reduction.min(state.gap)
        fields = state.pressure, state.gap, self.heights
        weight, potential, work, loaded = self.total(entropy.moments, *fields, zeta, least)
        if zeta > 0:
            log_scale = -math.log(weight / count)
            (apart,) = self.total(entropy.divergence, state.pressure, state.gap, zeta, least, log_scale)
            bound, state.level = zeta * apart, zeta * log_scale + least
        else:
            bound, state.level = potential, potential / count + least
        state.contact = int(loaded)
        state.work, state.objective = work / count, (potential - work / 2) / count + least
        state.error = bound / work if work > 0 else np.inf

    def advance(self, state: WallState, zeta: float, wanted: float) -> None:
        """One Newton step, shortened while it would raise both the objective and the error.  Collective."""
        old = WallState(state.pressure.copy(), state.gap.copy(), state.error, state.objective)
        self.respond(state, self.newton_target(state, zeta, wanted), zeta)
        self.compute_gap(state)
        self.certify(state, zeta)
        for _ in range(10):
            if state.error <= old.error or state.objective <= old.objective:
                return
            # The objective is convex, and the gap linear, on the way back: no convolution is needed.
            self.grid.threads.split(
                lambda a, b: entropy.mix(old.pressure, old.gap, 0.25, state.pressure, state.gap, a, b), len(old.gap)
            )
            self.certify(state, zeta)

    def newton_target(self, state: WallState, zeta: float, wanted: float) -> np.ndarray:
        """α (p̂ + δp̂) − (g + Gδp̂) of a Newton step in single precision, its residual × `wanted`.  Collective."""
        grid, rows = self.grid, self.grid.local_shape[0]
        root, residual, direction, product, change, response = np.zeros((6, *grid.local_shape), np.float32)
        level = self.total(entropy.level_sum, state.pressure, state.gap, zeta)[0] / grid.size
        (square,) = self.total(entropy.newton_start, state.pressure, state.gap, zeta, level, root, residual)
        goal, beta = wanted**2 * square, 0.0

        def fill(first: int, stop: int, block: np.ndarray):
            np.multiply(root[first:stop], direction[first:stop], out=block)

        def drain(first: int, stop: int, block: np.ndarray):
            product[first:stop] = block

        for _ in range(MOST_INNER):
            if square <= goal:
                break
            grid.threads.split(partial(entropy.next_direction, residual, np.float32(beta), direction), rows)
            grid.convolve(fill, self.compliance[np.float32], drain, np.float32)
            curved, length, along = self.total(entropy.curvature_sums, root, direction, product)
            size = square / (curved + zeta * length)
            numbers = (np.float32(value) for value in (along / grid.size, zeta, size))
            (new,) = self.total(entropy.step, root, direction, product, *numbers, change, response, residual)
            beta, square = new / square, new
            state.iterations += 1
        target = np.empty(grid.local_shape)
        fields = state.pressure, state.gap, root, change, response
        grid.threads.split(partial(entropy.newton_target, *fields, self.reach, target), rows)
        return target

    def respond(self, state: WallState, target: np.ndarray, zeta: float) -> None:
        """p̂ with α p̂ + ζ ln p̂ = target + c, c such that its mean is 1; from the state's c on.  Collective."""
        count, level, low, high = self.grid.size, state.level, -np.inf, np.inf
        # What is missing is made up by a factor; to the hard wall's certificate that is an error of first order.
        enough = 1e-9 * count if zeta > 0 else 0.0
        for _ in range(200):
            total, slope = self.total(entropy.respond, target, self.reach, zeta, level, state.pressure)
            if abs(total - count) <= enough:
                break
            low, high = (level, high) if total < count else (low, level)
            if total > 0:  # Newton for Σ p̂, which is nearly linear in c, or for its logarithm: the shorter step
                steps = (count - total) / slope, math.log(count / total) * total / slope
                trial = level + min(steps, key=abs)
            else:  # all underflowed: up to where the highest point alone would carry its share
                trial = self.reach - self.grid.reduction.max(target)
            if abs(trial - level) <= 1e-15 * abs(level):
                break
            level = trial if low < trial < high else (low + high) / 2
        state.pressure *= count / total
        state.level = level
