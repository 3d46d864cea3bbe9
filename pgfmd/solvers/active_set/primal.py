"""The active-set step whose unknowns are the pressures between their bounds.

Conjugate gradients make the gap constant on these points.  Then pressures beyond a bound are cut, and points that their
gap drives away from a bound become unknowns.  Under a hard wall this is repeated with the gap that the mesh computes
for the change so far, before the gap is computed by full transforms.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np

from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set.active_set import CUT_POWER, Precision, Relaxation, State
from pgfmd.solvers.active_set.conjugate_gradients import NEUTRAL, ConjugateGradients, Mean
from pgfmd.solvers.active_set.feasible import Feasible
from pgfmd.solvers.active_set.particle_mesh import MeshResponse, inner_response
from pgfmd.solvers.active_set.preconditioner import MultilevelStiffness
from pgfmd.solvers.active_set.unknowns import SetVector, Unknowns

CLOSE = 3e-5  # least part of the energy error that one step can leave: of the mesh's response, see `near_kernel`
LEAST_PART = 5e-5  # the least that the first of two steps aims at
SURE = 0.005  # after a reduction of the energy error to this part or more, the mesh does not check the set
MOST_LEFT = 0.5  # largest factor on the residual that is asked for once the mesh has updated the gap
NEAR = 3.0  # gap over the rms residual up to which the mesh updates gaps: points farther away did not come into contact
LIGHTEST = 0.02  # least approach since first contact on coarse grids, whose highest point is lower, over its height
MOVE_CUT = 0.1  # factor on the residual in the step that changes the load; .3 and .03 cost 1.5 and 3.5 % more in all
NEAR_CUT = 0.5  # factor on the residual in the iteration that adapts a start


class PressureSteps(Relaxation):
    """Relaxation that costs least where few points are in contact.  next_load: Σ p after the next step; 0: as is."""

    next_load = 0.0

    def __init__(self, problem: ContactProblem, exact: bool = True) -> None:
        super().__init__(problem, exact)
        grid, solid = problem.grid, problem.solid
        mean, action = 0.0 if grid.domain.wraps else solid.mean_mode(grid), self.compliance[np.float32]
        self.inner = inner_response(grid, solid.half_space_compliance, solid.compliance, action, mean)
        self.feasible = Feasible(grid)
        self.preconditioner = MultilevelStiffness(grid, solid.half_space_stiffness, solid.stiffness)

    def free(self) -> None:
        """Frees the transforms of the inner solver.  Collective."""
        super().free()
        self.preconditioner.free()
        del self.preconditioner

    def _begin(self, state: State) -> None:
        """Adapts the start to roughness that only this grid resolves: one iteration with the near part of the response.
        Blocks of pixels keep their loads, since the coarser grid has long waves right.  Collective.
        """
        state.estimated = False
        if isinstance(self.inner, MeshResponse):
            points = Unknowns(self.grid, (state.pressure, state.gap), 0.0, self.highest)
            near = self.inner.stencil.apply, partial(self.preconditioner.apply, near_only=True)
            self._solve(state, ConjugateGradients(points.below(0.0, state.gap), *near), NEAR_CUT)

    def linearise(self, state: State, precision: Precision) -> ConjugateGradients:
        """Computes the gap.  The system makes it constant on the unknowns, after a start on loaded points only: others
        are short of λ mostly by long waves, which the first step removes.  Collective.
        """
        if started := state.estimated:
            self._begin(state)
        self.compute_gap(state, precision)
        return self._system(state, started and self.highest == math.inf)

    def compute_gap(self, state: State, precision: Precision) -> None:
        """As `Relaxation.compute_gap`; the mesh's transforms make room for the grid's, and these for the system.
        Collective.
        """
        with self._memory_for_transforms():
            super().compute_gap(state, precision)

    def certify(self, state: State, system: ConjugateGradients, precision: Precision) -> float:
        """As `Relaxation.certify`, with room as in `compute_gap`.  Collective."""
        with self._memory_for_transforms(system):
            return super().certify(state, system, precision)

    @contextmanager
    def _memory_for_transforms(self, system: ConjugateGradients | None = None) -> Iterator[None]:
        """Frees what can be made anew of the mesh, the preconditioner and the system before the block, and the
        transforms of the grid after it, if they are large.  Collective.
        """
        if not (self.exact and isinstance(self.inner, MeshResponse)):
            yield
            return
        self.inner.make_room()
        self.preconditioner.make_room()
        if system is not None:
            system.make_room()
        yield
        self.grid.make_room()

    def _system(self, state: State, loaded_only: bool = False) -> ConjugateGradients:
        """The system for a gap that is known.  Where an area that is sought asks for another load, the
        level is shifted by about what that load needs; `_solve` scales the change to that load.  Collective.
        """
        self.measure(state)
        if self.imposed is None:
            touching = -math.inf if loaded_only else state.level
            system = self._aimed_at(state, state.level, touching, NEUTRAL)
            if loaded_only or not (pressure := self.next_pressure(state, system.square)):
                return system
            del system  # its vectors
            at, self.next_load = self.measured(state), pressure * self.grid.size
            level = state.level + at.range * (self.next_load / state.load - 1)
            return self._aimed_at(state, level, touching, Mean(False, 0.0, state.load / at.range))
        level, mean = self.imposed_level(state, -math.inf if self.exact else (LIGHTEST - 1) * self.summit)
        level -= state.base
        return self._aimed_at(state, level, -math.inf if loaded_only else level, mean)

    def _aimed_at(self, state: State, level: float, touching: float, mean: Mean) -> ConjugateGradients:
        """The system that brings the gap of unknowns to `level`; gaps below `touching` are unknowns.  Collective."""
        points = Unknowns(self.grid, (state.pressure, state.gap), touching, self.highest)
        return ConjugateGradients(points.below(level, state.gap), self.inner.apply, self.preconditioner.apply, mean)

    def left(self, wanted: float, enough: float) -> float:
        """As `Relaxation.left`; where one step cannot leave `enough` (`CLOSE`), the first of two does most."""
        if not isinstance(self.inner, MeshResponse) or self.highest < math.inf:
            return super().left(wanted, enough)
        return enough if enough > CLOSE else max(math.sqrt(enough) / 10, LEAST_PART)

    def improve(self, state: State, system: ConjugateGradients, wanted: float, enough: float) -> None:
        """Makes the gap constant on the unknowns, with a mesh on new ones as they change, until `system.square` has
        probably fallen to the part `left`.  Collective.
        """
        if not isinstance(self.inner, MeshResponse) or self.highest < math.inf or system.square <= 0:
            self._solve(state, system, wanted)
            return
        goal = self.left(wanted, enough) * system.square
        while True:
            square, wanted = system.square, max(wanted, math.sqrt(goal / system.square))
            change = self._solve_for_change(state, system, wanted)
            if goal > SURE * square and wanted**2 * square < 1.1 * goal:
                self._apply_change(state, system.points, change)
                return
            near = Unknowns(self.grid, (state.pressure, state.gap), state.level + NEAR * system.rms)
            before = near.values(state.pressure)
            self._apply_change(state, system.points, change)
            del change
            self._respond(state, near, before)
            del near, before  # the next system needs their room
            system = self._system(state)
            if not 1.1 * goal <= system.square <= square / 2:  # NaN ends as well
                return
            wanted = min(MOST_LEFT, (system.square / square) ** CUT_POWER)

    def _respond(self, state: State, near: Unknowns, before: np.ndarray) -> None:
        """Adds to the gap of the points `near` the mesh's response to the change of their pressures, which were
        `before` (count,).  Collective.
        """
        change, response = SetVector(near), np.empty(near.count, np.float32)
        change.own[...] = near.values(state.pressure) - before  # of pressures of double precision, if they have it
        self.inner.apply(change, response)
        near.add(state.gap, response)

    def _solve(self, state: State, system: ConjugateGradients, wanted: float) -> None:
        """`_solve_for_change` and `_apply_change`."""
        self._apply_change(state, system.points, self._solve_for_change(state, system, wanted))

    def _solve_for_change(self, state: State, system: ConjugateGradients, wanted: float) -> np.ndarray:
        """The change (count,) of the pressure that cuts the system's residual by the factor `wanted`.  Collective."""
        change, steps = system.solve(MOVE_CUT if self.next_load else wanted)
        if self.next_load:
            total = self.grid.reduction.sum(change.sum(dtype=np.float64))
            factor = max((self.next_load - state.load) / total, 0.0) if total else 0.0  # never the other way
            change *= np.float32(factor)
            self.problem = self.problem.at((state.load + factor * total) / self.grid.size)
            self.next_load = 0.0
        state.iterations += steps
        return change

    def _apply_change(self, state: State, points: Unknowns, change: np.ndarray) -> None:
        """Adds a change (count,) to the pressure, and makes that feasible.  Collective."""
        points.add(state.pressure, change)
        self.feasible.make(self.problem, points, (state.pressure, state.gap))
