"""One call for every contact law and method."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial

import numpy as np

from pgfmd.errors import SolverError, Uncertifiable
from pgfmd.parallel.collectives import shared
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set.cropping import solve_hard_wall
from pgfmd.solvers.adhesive_branch import solve_adhesive
from pgfmd.solvers.exponential_wall.newton_from_coarse import solve_exponential_wall
from pgfmd.solvers.gfmd import RESCUE, solve_gfmd
from pgfmd.solvers.options import Solver
from pgfmd.solvers.solution import ContactSolution, Monitor

SOLVERS: dict[str, Callable[..., ContactSolution]] = {
    "active-set": solve_hard_wall,
    "newton": solve_exponential_wall,
    "gfmd": solve_gfmd,
    "adhesive": solve_adhesive,
}
SMALLEST = 1e-290  # least sum of a start: the load over it does not overflow
LEFT = 1e-12, 1e-9  # parts of p̄: pressures below them are taken off points in turn, until the rest is certified
log = logging.getLogger("pgfmd")


def solve_contact(
    problem: ContactProblem,
    options: Solver = Solver(),  # noqa: B008  (frozen)
    start: np.ndarray | None = None,
    monitor: Monitor | None = None,
) -> ContactSolution:
    """The contact, solved by the method and to the tolerance of the options.  Collective.

    start: a pressure (nx_local, ny) to begin with instead of coarse grids; it is ignored if its sum is 0 or not finite.
    If the method fails, it is tried once more without the start; if the active set then fails, the method is "auto" and
    fields are in double precision, dynamics are tried (neither if rounding alone keeps the error above the tolerance).
    monitor(grid, state): called after outer steps.  Raises InputError for a method that the law does not take and for
    values out of range, SolverError if the tolerance cannot be reached.
    """
    options.check_law(problem.law)
    options.check_domain(problem.law, problem.solid, problem.grid.domain)
    if not problem.law.convex:
        return SOLVERS[problem.law.methods[0]](problem, options.tolerance, start, monitor)
    problem = problem.with_law(problem.law.up_to(problem.load))  # no point bears more than all of the load
    start = _usable(problem, start)
    method = problem.law.methods[0] if options.method == "auto" else options.method
    if problem.imposed is not None:
        if method != "active-set":
            raise SolverError(f"{method} needs a given mean pressure")
        return solve_hard_wall(problem, options.tolerance, start, monitor)
    rescued = options.method == "auto" and method == "active-set" and problem.grid.domain.wraps
    rescued &= "gfmd" in problem.law.methods and problem.grid.storage is np.float64
    limit = {"max_steps": options.max_iterations} if options.max_iterations else {}
    solver = partial(SOLVERS[method], problem, monitor=monitor, **limit)
    try:
        return _certified(solver, options.tolerance, start)
    except SolverError as failure:
        if start is None and not rescued or isinstance(failure, Uncertifiable):
            raise
        if not shared(problem.grid.comm, failure):
            raise
        again = "without the start" if start is not None else "by dynamics, slower but always convergent"
        if problem.grid.comm.rank == 0:
            log.info("%s; trying %s", failure, again)
    if start is not None:
        return solve_contact(problem, options, None, monitor)
    return _certified(partial(solve_gfmd, problem, monitor=monitor, max_steps=RESCUE), options.tolerance, None)


def _certified(solver: Callable[..., ContactSolution], tolerance: float, start: np.ndarray | None) -> ContactSolution:
    """The solver's answer, certified.  Collective.

    Solvers see points that cannot touch higher up than they are (`Dimensionless`; their heights are then intact).  A
    trace of pressure left there may bring the error above the tolerance; the solver then goes on without it.
    """
    found = solver(tolerance=tolerance, start=start)
    for part in LEFT:
        if found.certified_error <= tolerance:
            break
        start = np.where(found.pressure > part * found.mean_pressure, found.pressure, 0.0)
        found = solver(tolerance=tolerance, start=start)
    if found.certified_error <= tolerance:
        return found
    raise SolverError(
        f"the certified error stays at {found.certified_error:.1e}, above the tolerance {tolerance:.1e}, by pressure "
        "on points that cannot touch; allow a larger tolerance"
    )


def _usable(problem: ContactProblem, start: np.ndarray | None) -> np.ndarray | None:
    """The start with tensions set to 0, or None if its sum cannot be scaled to the load.  Collective."""
    if start is None:
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        if problem.grid.reduction.min(start) < 0:
            start = np.maximum(start, 0.0)
        total = problem.grid.reduction.sum(start)
    return start if SMALLEST < total < np.inf else None
