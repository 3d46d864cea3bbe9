"""The active-set step for solids that are soft to long waves, as a thin plate on a free base.

There sets that are chosen from loosely solved, clipped pressures cycle.  So each step solves its system accurately, in
double precision, and the next set comes from the solution as it is: points of the set with p > 0, and others with a gap
below λ, by the gap that conjugate gradients carry along on all points.  Only then pressures are clipped.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property

import numpy as np

from pgfmd.grid.transforms import sink, source
from pgfmd.physics.problem import ContactProblem
from pgfmd.physics.solids.solid import SOFT
from pgfmd.solvers.active_set.active_set import Precision, Relaxation, State
from pgfmd.solvers.active_set.conjugate_gradients import NEUTRAL, Mean
from pgfmd.solvers.active_set.feasible import scale_to_load
from pgfmd.solvers.active_set.particle_mesh import mesh_response
from pgfmd.solvers.active_set.sparse_stiffness import LARGEST, SparseStiffness
from pgfmd.solvers.active_set.unknowns import SetVector, Unknowns

SOFTEST = 5e-4  # `Solid.softest` below which all systems are solved to `FINE`: of a free slab of .023 of the cell
CUT, FINE = 1e-4, 1e-5  # factor on the residual of a system
LAST, LOOSEST = 0.1, 0.03  # part of the energy error still to go at which the last systems end; largest factor
MOST_ITERATIONS = 400
BY_MESH = 0.02  # least factor on a residual that the mesh answers at once: its response is off by about a per cent


def is_thin(problem: ContactProblem) -> bool:
    """Whether `ThinSteps` serve the problem best; they take hard walls on periodic grids of up to `LARGEST` points."""
    solid, grid = problem.solid, problem.grid
    taken = problem.law.highest == math.inf and grid.domain.wraps
    return taken and grid.size <= LARGEST and solid.softest(grid.lengths, grid.spacing) < SOFT


class ThinSystem:
    """S G Sᵀ x = λ − g on the points of a mask (nx_local, ny), in double precision.  square: ⟨r, M r⟩."""

    def __init__(self, solver: ThinSteps, mask: np.ndarray, residual: np.ndarray, mean: Mean) -> None:
        self.solver, self.mask, self.residual, self.mean = solver, mask, residual, mean
        self.reduction = solver.grid.reduction
        self.count = int(self.reduction.sum(np.count_nonzero(mask)))
        solver.preconditioner.prepare(mask)
        # With M·1 the sum of M·r is made 0, or the sum of M·1 the capacity.
        self.z, self.uniform = np.empty_like(residual), np.empty_like(residual)
        solver.preconditioner.apply(mask.astype(float), self.uniform)
        total = self.reduction.sum(self.uniform)
        self.share = max(mean.capacity / total - 1, 0.0) / total if total > 0 else 0.0
        if mean.neutral and total > 0:
            self.share = -1 / total
        self.square = self._precondition()

    def _precondition(self) -> float:
        """z = M · residual, with the part of the mean; returns ⟨residual, z⟩.  Collective."""
        self.solver.preconditioner.apply(self.residual, self.z)
        total = self.reduction.sum(self.z)
        self.z += self.uniform * (total * self.share)
        return float(self.reduction.dot(self.residual, self.z))

    def solve(self, state: State, wanted: float) -> None:
        """Adds the solution to the state's pressure, and the response to its gap on all points.  With a mesh it answers
        the residual first, which full transforms compute anew each time; if that fails, they do it alone.  Collective.
        """
        goal, given = wanted**2 * self.square, self.solver.mesh is not None
        while self.square > goal:
            before, residual, rest = self.square, self.residual.copy(), math.sqrt(goal / self.square)
            part = rest if not given or rest > BY_MESH else max(math.sqrt(rest), BY_MESH)
            change, product = self._iterate(state, part, self._by_mesh if given else self._by_transforms)
            if given:
                self._by_transforms(change, product)
                self.residual = residual - self._on_set(product, self.reduction.sum(change))
                self.square = self._precondition()
                if not self.square < before / 4:
                    self.residual, given = residual, False
                    self.square = self._precondition()
                    continue
            state.pressure += change
            state.gap += product
            if not given:
                return

    def _iterate(self, state: State, part: float, respond: Callable) -> tuple[np.ndarray, np.ndarray]:
        """Reduces the residual by a factor; returns the change of the pressure and its response.  Collective."""
        direction, product, change, response = np.zeros((4, *self.residual.shape))
        goal, before = part**2 * self.square, math.inf
        for _ in range(MOST_ITERATIONS):
            if self.square <= goal or not self.square > 0:
                break
            direction *= self.square / before
            direction += self.z
            before = self.square
            respond(direction, product)
            load, curvature = self.reduction.sums(direction.sum(), np.vdot(direction, product))
            curvature += self.mean.compliance * load**2
            if not curvature > 0:
                break
            step = before / curvature
            change += step * direction
            response += step * product
            self.residual -= step * self._on_set(product, load)
            self.square = self._precondition()
            state.iterations += 1
        return change, response

    def _on_set(self, product: np.ndarray, load: float) -> np.ndarray:
        """The response on the set, that of the mean mode included."""
        return np.where(self.mask, product + self.mean.compliance * load, 0.0)

    def _by_transforms(self, direction: np.ndarray, product: np.ndarray) -> None:
        self.solver.grid.convolve(source(direction), self.solver.compliance[np.float64], sink(product))

    def _by_mesh(self, direction: np.ndarray, product: np.ndarray) -> None:
        values, out = SetVector(self.points), np.empty(self.points.count, np.float32)
        values.own[:] = direction[self.mask]
        assert self.solver.mesh is not None
        self.solver.mesh.apply(values, out)
        product[self.mask] = out

    @cached_property
    def points(self) -> Unknowns:
        """The set, for the mesh.  Collective."""
        fields = self.mask.astype(np.float32), np.ones(self.mask.shape, np.float32)
        return Unknowns(self.solver.grid, fields, -math.inf)


class ThinSteps(Relaxation):
    """Relaxation by accurately solved systems, whose sets come from their solutions."""

    precision, patience = np.float64, 30

    def __init__(self, problem: ContactProblem, exact: bool = True) -> None:
        super().__init__(problem, exact)
        self.soft = problem.solid.softest(problem.grid.lengths, problem.grid.spacing) < SOFTEST
        self.preconditioner = SparseStiffness(problem.grid, self.compliance[np.float64])
        self.mask: np.ndarray | None = None
        self.mesh = mesh_response(problem.grid, problem.solid.compliance)

    def free(self) -> None:
        """Frees the transforms of the mesh.  Collective."""
        if self.mesh is not None:
            self.mesh.free()

    @classmethod
    def goal(cls, estimate: float, tolerance: float, worst: float = 0.0) -> float:
        """Coarse grids are solved to the tolerance: what they leave is long waves, which here cost most."""
        return tolerance

    def linearise(self, state: State, precision: Precision) -> ThinSystem:  # type: ignore[override]
        """Computes the gap.  The system makes it constant on the set of the last solution.  Collective."""
        self.compute_gap(state, precision)
        self.measure(state)
        mask = state.pressure > 0 if self.mask is None else self.mask
        level, mean = (state.level, NEUTRAL) if self.imposed is None else self.imposed_level(state)
        system = ThinSystem(self, mask, np.where(mask, level - state.gap, 0.0), mean)
        if pressure := self.next_pressure(state, system.square):
            self._move_load(state, pressure)
            system = ThinSystem(self, mask, np.where(mask, state.level - state.gap, 0.0), NEUTRAL)
        return system

    def _move_load(self, state: State, mean_pressure: float) -> None:
        """Scales the pressures to this load.  Collective."""
        factor, rest = mean_pressure * self.grid.size / state.load, self.heights

        def part(_: int, first: int, stop: int) -> None:
            rows = slice(first, stop)
            state.pressure[rows] *= factor
            state.gap[rows] += (factor - 1) * (state.gap[rows] + (rest[rows] + state.base))

        self.grid.threads.share(part, len(state.gap), self.grid.band)
        self.problem = self.problem.at(mean_pressure)
        self.measure(state)

    def improve(self, state: State, system: ThinSystem, wanted: float, enough: float) -> None:  # type: ignore[override]
        """Solves the system, takes the next set from the solution, and makes the pressure feasible.  Collective."""
        system.solve(state, FINE if self.soft else max(CUT, min(math.sqrt(LAST * enough), LOOSEST)))
        mask, reduction = system.mask, self.grid.reduction
        level = reduction.sum(state.gap[mask]) / max(system.count, 1)
        self.mask = np.where(mask, state.pressure > 0, state.gap < level)
        np.maximum(state.pressure, 0.0, out=state.pressure)
        if self.imposed is None:
            scale_to_load(self.problem, (state.pressure, state.gap))
