"""One call for every contact law and method."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np

from pgfmd.errors import SolverError, Uncertifiable
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set.nested_iteration import solve_hard_wall
from pgfmd.solvers.exponential_wall.nested_iteration import solve_exponential_wall
from pgfmd.solvers.gfmd import solve_gfmd
from pgfmd.solvers.options import Solver
from pgfmd.solvers.solution import ContactSolution, Monitor

SOLVERS: dict[str, Callable[..., ContactSolution]] = {
    "active-set": solve_hard_wall,
    "newton": solve_exponential_wall,
    "gfmd": solve_gfmd,
}
SMALLEST = 1e-290  # least sum of a start: the load over it does not overflow
RESCUE = 4000  # steps of dynamics after another method has failed
log = logging.getLogger("pgfmd")


def solve_contact(
    problem: ContactProblem,
    options: Solver = Solver(),  # noqa: B008  (frozen)
    start: np.ndarray | None = None,
    monitor: Monitor | None = None,
    overwrite_heights: bool = False,
) -> ContactSolution:
    """The contact, solved by the method and to the tolerance of the options.  Collective.

    start: a pressure (nx_local, ny) to begin with instead of coarse grids; it is ignored if its sum is 0 or not finite.
    If the method fails, it is tried once more without the start; if that fails and the method is "auto", dynamics are
    tried (neither if rounding alone keeps the error above the tolerance).  monitor(grid, state): called after outer
    steps.  overwrite_heights: their memory is used, and they are lost; then nothing is tried again.  Raises InputError
    for a method that the law does not take and for values out of range, SolverError if the tolerance cannot be reached.
    """
    options.check_law(problem.law)
    start = _usable(problem, start)
    method = problem.law.methods[0] if options.method == "auto" else options.method
    rescued = options.method == "auto" and "gfmd" in problem.law.methods
    limit = {"max_steps": options.max_iterations} if options.max_iterations else {}
    try:
        return SOLVERS[method](problem, options.tolerance, start, monitor, overwrite_heights, **limit)
    except SolverError as failure:
        if overwrite_heights or start is None and not rescued or isinstance(failure, Uncertifiable):
            raise
        again = "without the start" if start is not None else "by dynamics, slower but always convergent"
        if problem.grid.comm.rank == 0:
            log.info("%s; trying %s", failure, again)
    if start is not None:
        return solve_contact(problem, options, None, monitor)
    return solve_gfmd(problem, options.tolerance, None, monitor, max_steps=RESCUE)


def _usable(problem: ContactProblem, start: np.ndarray | None) -> np.ndarray | None:
    """The start with tensions set to 0, or None if its sum cannot be scaled to the load.  Collective."""
    if start is None:
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        start = np.maximum(start, 0.0)
        total = problem.grid.reduction.sum(start)
    return start if SMALLEST < total < np.inf else None
