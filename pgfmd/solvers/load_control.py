"""Which mean pressure to impose: given, or found from a contact area, a mean gap, or a displacement of the far side.

Under a hard wall the solver meets the target by itself (`physics.imposed`).  Else p̄ is found by secants, kept inside a
bracket, in coordinates in which the relation, which is monotonic, is nearly straight.  Solutions on the way have a
loose tolerance, and start from the previous one if its p̄ is near.  The load at which the gap ceases to percolate is
bisected.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Callable, Iterable

import numpy as np

from pgfmd.errors import InputError, SolverError, Uncertifiable, Unreachable
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transfer import SubGrid, restrict_locally
from pgfmd.parallel.collectives import shared
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set.thin import is_thin
from pgfmd.solvers.adhesive_branch import Branch
from pgfmd.solvers.controls import CONTROLS, ContactArea
from pgfmd.solvers.dispatch import solve_contact
from pgfmd.solvers.options import Load, Solver
from pgfmd.solvers.second_order import LEAST_ERROR
from pgfmd.solvers.solution import ContactSolution

SolveAt = Callable[[ContactProblem, np.ndarray | None, float], ContactSolution]
"""(problem, pressure to start from or None, tolerance) → solution."""

Percolates = Callable[[SlabGrid, np.ndarray], bool]
"""(grid, mask (nx_local, ny)) → whether a path in it winds around the cell.  Collective."""

# Loads this close start from each other, under hard walls, and under others or on thin solids; over larger steps coarse
# grids are cheaper.
NEIGHBOURS, SOFT_NEIGHBOURS = math.log(1.002), math.log(1.05)
LOOSE = 1e-5  # certified error of intermediate solutions
SURE = 0.3  # part of the target's tolerance that may be due to the solution's certified error
FARTHER = 4.0  # far from a target: its error over the part that the solution's certified error may make
ROUNDING = 1e-15  # width of a bracket in ln p̄ below which it is rounding
JUMP = 1e-4  # width of a bracket in ln p̄ below which an area that differs between its ends counts as jumping
SHARP = {np.float64: 1e-12, np.float32: 1e-10}  # certified error of both ends of such a bracket
ABOUT, LEAST_SIDE = 1e-2, 64  # tolerance of a gap on the coarser grid that gives a first guess, and its least side
STEP = 3.0  # largest first change of ln p̄
MOST_SOLVES = 80
FIRST_STEP = 0.1  # of ln p̄ in the search of closure; doubled until both sides of it are known
LOWEST = 40.0  # below the first guess of ln p̄, where the gap must percolate
SHARPNESS = 1e-2  # certified error over the square of the accuracy of the load of closure
log = logging.getLogger("pgfmd")


class LoadControl:
    """Finds contacts of one surface at targets of what `load` imposes, in any order.  Collective to make.

    solver: solves at a given mean pressure; `solve_contact` if not given.  percolates: tells whether a mask percolates;
    needed where percolation is asked for.
    """

    percolates: Percolates | None = None

    def __init__(self, load: Load, problem: ContactProblem, tolerance: float = 1e-8, solver: SolveAt | None = None):
        load.check_law(problem.law)
        self.control, self.name = CONTROLS[load.control](problem, load), load.control
        self.problem, self.grid, self.tolerance = problem, problem.grid, tolerance
        self.solver = solver or (lambda at, start, tolerance: solve_contact(at, Solver(tolerance=tolerance), start))
        self._previous: tuple[float, np.ndarray] | None = None  # p̄ and pressure of the last solution
        self._resumed: np.ndarray | None = None
        self._totals = np.zeros(3)
        self._slope = 1.0  # with which the next search begins: that at the end of the last one

    def check_targets(self, targets: Iterable[float]) -> None:
        """Raises InputError for the first target that is wrong input on this surface.  Collective."""
        for target in targets:
            self.control.check_target(target)

    def displacement(self, found: ContactSolution) -> float:
        """Approach of the far side from where the undeformed solid touches the highest point."""
        return self.control.displacement(found)

    def resume(self, pressure: np.ndarray | None) -> None:
        """The next target starts from this pressure (nx_local, ny) of an unfinished solution."""
        self._resumed = pressure

    def solution(self, target: float) -> ContactSolution:
        """The contact at that target, with iterations, transforms and seconds of the whole search.  Collective.

        Raises InputError for a target that is wrong input, Unreachable for one that no load gives, SolverError if it is
        not met to its tolerance.
        """
        self.control.check_target(target)
        self._totals = np.zeros(3)
        if self.name == "pressure":
            found = self._solved(target, self.tolerance, target)
            self._previous = found.mean_pressure, found.pressure
        elif (moved := self.control.separation(target)) is not None:  # the solid, undeformed, before first contact
            found = self._solved(0.0, self.tolerance, target)
            found.gap += moved
            found = dataclasses.replace(found, mean_gap=found.mean_gap + moved, approach=found.approach - moved)
        else:
            self.control.check_reachable(target)
            found = self._aimed(target) or (self._closure if self.name == "percolation" else self._search)(target)
        iterations, transforms, seconds = map(float, self._totals)
        return dataclasses.replace(found, iterations=int(iterations), transforms=transforms, seconds=seconds)

    def _solved(self, mean_pressure: float, tolerance: float, target: float) -> ContactSolution:
        """The contact at that mean pressure; the previous one starts it if their p̄ are `NEIGHBOURS`.  If it fails, the
        message says which key of the job asked for the tolerance.  Collective.
        """
        (before, pressure), start = self._previous or (0.0, None), self._resumed
        self._resumed = self._previous = None
        farthest = SOFT_NEIGHBOURS if self.problem.law.reach > 0 or is_thin(self.problem) else NEIGHBOURS
        near = min(before, mean_pressure) > 0 and abs(math.log(mean_pressure) - math.log(before)) <= farthest
        if start is None and pressure is not None and near:  # kept while the next is solved: in single precision
            start = np.divide(pressure, before, out=np.empty(pressure.shape, np.float32), casting="same_kind")
        del pressure
        try:
            found = self.solver(self.problem.at(mean_pressure), start, tolerance)
        except SolverError as failure:
            asked = f"solver.tolerance = {self.tolerance:g}"
            if tolerance < self.tolerance:
                asked = f"{self.control.tolerance_text} needs a certified error of {tolerance:.1e}"
            elif tolerance > self.tolerance:
                asked = f"not even a certified error of {tolerance:g} is reached on the way"
            failure.args = (f"{self.control.asked(target)}: {asked}: {failure}",)
            raise
        self._totals += found.iterations, found.transforms, found.seconds
        return found

    def _aimed(self, target: float) -> ContactSolution | None:
        """The contact at a target that the solver meets by itself; None if it does not.  Collective."""
        if (imposed := self.control.imposed(target)) is None:
            return None
        start, lowest = self._resumed, np.array(2 * math.pi / max(self.grid.lengths))  # wave number
        # To begin with, the mean pressure of full contact with waves as long as the cell, which have the rms height.
        guess = self.control.rms_height * float(self.problem.solid.stiffness(lowest))
        if start is not None and 0 < (total := self.grid.reduction.sum(start)) < math.inf:
            guess = total / self.grid.size
        try:
            tolerance = min(self.tolerance, imposed.tolerance)
            found = self.solver(self.problem.imposing(imposed, guess), start, tolerance)
        except SolverError as failure:
            if not shared(self.grid.comm, failure):
                raise
            if self.grid.storage is np.float32 and isinstance(failure, Uncertifiable) and tolerance >= self.tolerance:
                keys = f"{self.control.tolerance_text} and solver.tolerance = {self.tolerance:g}"
                failure.args = (f"{self.control.asked(target)}: {keys} need a smaller error: {failure}",)
                raise  # a search needs as small an error
            return None
        self._totals += found.iterations, found.transforms, found.seconds
        if self.control.error(found, target) + self.control.uncertainty(found, target) > 1:
            self._previous = found.mean_pressure, found.pressure
            return None
        self._resumed = None
        self._note_pixel(found, target)
        return found

    def _note_pixel(self, found: ContactSolution, target: float) -> None:
        """Says that an area is met to one pixel, if that is more than its tolerance.  Collective."""
        control = self.control
        if not isinstance(control, ContactArea):
            return
        missed = abs(control.area(found) - target) > control.options.area_tolerance * target
        if missed and self.grid.comm.rank == 0:
            log.info("%s: met to one pixel, which is more than %s", control.asked(target), control.tolerance_text)

    def _search(self, target: float) -> ContactSolution:
        """Solves at one p̄ after another until the target is met, the solution's own error included.  Collective."""
        control, tolerance = self.control, max(LOOSE, self.tolerance)
        sharpest = min(self.tolerance, SHARP[self.grid.storage]) if control.jumps else self.tolerance
        highest = self.problem.law.highest
        search = _Search(self._first_guess(target), math.log(highest))
        search.slope = self._slope
        best: tuple[float, ContactSolution | None] = math.inf, None
        for _ in range(MOST_SOLVES):
            found = self._solved(min(math.exp(search.at), math.nextafter(highest, 0.0)), tolerance, target)
            error, unsure = control.error(found, target), control.uncertainty(found, target)
            if error + unsure <= 1 and tolerance <= self.tolerance:
                self._note_pixel(found, target)
                self._slope = search.slope
                return found
            if control.jumps and tolerance <= sharpest and error <= best[0]:  # of equal ones the last, next to the jump
                best = error, found
            narrow = search.width <= (JUMP if control.jumps else ROUNDING)  # at a jump, or no p̄ left in between
            if narrow and tolerance <= sharpest:
                break
            known = max(found.certified_error, LEAST_ERROR)
            wanted, sure = sharpest if narrow else self.tolerance, SURE
            if not (narrow or control.jumps) and error / FARTHER > SURE:  # far from the target, that is wasted
                wanted, sure = tolerance, error / FARTHER
            finer = min(wanted, known * (sure / unsure) ** 2 if unsure > sure else math.inf)
            if finer < tolerance and (error <= max(1.0, unsure) or narrow):
                if finer == 0:  # no certificate knows the value
                    break
                tolerance = finer
                search.restart(1.0 if narrow else search.slope)
                best = math.inf, None
            else:  # otherwise the sign of its distance to the target is not certain
                search.add(control.distance(found, target))
            self._previous = found.mean_pressure, found.pressure
            del found  # before the next is solved
        if best[1] is None or not (control.jumps and search.width <= JUMP):
            raise SolverError(f"{control.asked(target)}: not met to {control.tolerance_text}; allow a larger one")
        if self.grid.comm.rank == 0:
            log.info("%s: the area jumps across this at one load; the nearer is taken", control.asked(target))
        return best[1]

    def _closure(self, target: float) -> ContactSolution:
        """The contact at the highest p̄ found at which the gap percolates.  Its details hold that p̄, and the least at
        which it does not.  Contact grows with the load, so that bisection finds them.  Collective.
        """
        assert self.percolates is not None
        accuracy, asked = self.control.options.percolation_accuracy, self.control.asked(target)
        tolerance, highest = min(self.tolerance, SHARPNESS * accuracy**2), self.problem.law.highest
        at, step = self._first_guess(target), FIRST_STEP
        low, high, guess = -math.inf, math.log(highest), at
        for _ in range(MOST_SOLVES):
            found = self._solved(min(math.exp(at), math.nextafter(highest, 0.0)), tolerance, target)
            self._previous = found.mean_pressure, found.pressure
            if self.percolates(self.grid, found.pressure_in_contact() <= 0):
                low = at
                if high - low <= accuracy:
                    bracket = {"closing_pressure_lower": found.mean_pressure, "closing_pressure_upper": math.exp(high)}
                    return dataclasses.replace(found, details={**found.details, **bracket})
            elif at > low:
                high = at
            else:  # it did when it was solved from another start
                low, high, step = -math.inf, at, accuracy
            del found  # before the next is solved
            if high < guess - LOWEST:
                raise Unreachable(f"{asked}: the gap does not percolate at any load, down to {math.exp(high):g}")
            at = low if high - low <= accuracy else min(max((low + high) / 2, at - step), at + step)
            step *= 2
        raise SolverError(f"{asked}: not found to {self.control.tolerance_text}; allow a larger one")

    def _first_guess(self, target: float) -> float:
        """ln p̄ of the solution that is resumed or near, or else the estimate of the control.  Collective."""
        if self._previous is not None and self._previous[0] > 0:
            return math.log(self._previous[0])
        if self._resumed is not None:
            total = self.grid.reduction.sum(self._resumed)
            if 0 < total < math.inf:
                return math.log(total / self.grid.size)
        return self._guess_from_coarse(target) or self.control.guess(target)

    def _guess_from_coarse(self, target: float) -> float | None:
        """ln p̄, about, and the slope, from a patch of half the points each way; None if there is none.  Collective."""
        control, problem = self.control, self.problem
        if self.grid.domain.wraps or problem.law.kind != "hard" or min(self.grid.shape) < 2 * LEAST_SIDE:
            return None
        place, options = SubGrid.coarse(self.grid), dataclasses.replace(control.options, gap_tolerance=ABOUT)
        heights = restrict_locally(self.grid, place, problem.heights)

        def find(grid: SlabGrid) -> tuple[float, float, float]:
            search = LoadControl(options, problem.on(grid, heights), LOOSE)
            pressure = search.solution(target).mean_pressure
            return pressure, search._slope, float(search._totals[1])

        try:
            pressure, self._slope, transforms = place.on_all(find)
        except (SolverError, InputError) as failure:
            if not shared(self.grid.comm, failure):  # others do not come to free the grid
                raise
            pressure = transforms = 0.0
        place.free()
        self._totals[1] += transforms * place.size / self.grid.size
        return math.log(pressure) if pressure > 0 else None


def load_control(load: Load, problem: ContactProblem, tolerance: float = 1e-8) -> LoadControl | Branch:
    """What finds the contacts that a load asks for, under any law.  Collective to call."""
    return (LoadControl if problem.law.convex else Branch)(load, problem, tolerance)


class _Search:
    """Finds the zero of an increasing function of ln p̄: the caller adds the function's value at `at`, again and again.
    at: ln p̄ where the value is wanted next, below `limit`.  slope: last estimate of the derivative.
    """

    def __init__(self, at: float, limit: float = math.inf):
        self.limit, self.at = limit, at if at < limit else limit - 1
        self.restart(1.0)

    def restart(self, slope: float) -> None:
        """Forgets all values, which were not accurate enough, and begins with this slope."""
        self.slope, self.step = slope, STEP
        self.low, self.high = -math.inf, math.inf
        self.points: list[tuple[float, float]] = []

    @property
    def width(self) -> float:
        """Width of the bracket; inf as long as there is none."""
        return self.high - self.low

    def add(self, value: float) -> None:
        """Adds the value at `at`, and moves `at` by a secant, inside the bracket or else by a limited step."""
        self.points.append((self.at, value))
        if value < 0:
            self.low = max(self.low, self.at)
        else:
            self.high = min(self.high, self.at)
        if len(self.points) > 1 and self.points[-2][0] != self.at:
            slope = (value - self.points[-2][1]) / (self.at - self.points[-2][0])
            self.slope = slope if slope > 0 else self.slope
        trial = self.at - value / self.slope
        if self.width < math.inf:
            # Every fourth step, later every second one, halves the bracket: secants alone converge slowly to a
            # zero of a strongly curved function.
            inside = self.low < trial < self.high and len(self.points) % (4 if len(self.points) < 10 else 2)
            self.at = trial if inside else (self.low + self.high) / 2
        else:
            trial = self.at + max(-self.step, min(self.step, trial - self.at))
            self.at = trial if trial < self.limit else (self.at + self.limit) / 2
            self.step *= 2
