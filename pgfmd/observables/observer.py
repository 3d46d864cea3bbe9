"""`Observer`: everything that a job asks to be measured on its solved contacts."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np

from pgfmd.errors import InputError, SolverError
from pgfmd.grid.cell import Cell
from pgfmd.observables.lowpass import LOWPASS_TOLERANCE
from pgfmd.observables.measured_contact import MeasuredContact
from pgfmd.observables.observable import Observable
from pgfmd.observables.observable_kinds import OBSERVABLES
from pgfmd.observables.rough_surface import RoughSurface, lag_rings
from pgfmd.observables.schema import TABLE
from pgfmd.observables.spectra import Acf, Spectra
from pgfmd.parallel.collectives import shared
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.dispatch import solve_contact
from pgfmd.solvers.options import Solver
from pgfmd.solvers.solution import ContactSolution, Solve

log = logging.getLogger("pgfmd")


class Observer:
    """Measures solved contacts of one rough surface.  Making one is collective.

    It takes half a transform, or a whole one if autocorrelations are asked for.

    problem: its heights are kept, not copied; its load does not matter.  cutoff: wave number beyond which the surface
    has no modes; None: not known.  solve: solves the further contacts of "lowpass" and "discretisation";
    None: the first method of the law.  fields: that observables are to keep.  seconds: time spent so far on each
    observable; work that several share is counted for the first of them.
    """

    def __init__(
        self,
        problem: ContactProblem,
        observables: Iterable[Observable] = (),
        cutoff: float | None = None,
        solve: Solve | None = None,
        fields: Iterable[str] = (),
    ):
        grid = problem.grid
        asked = {observable.name: observable for observable in observables}
        self.asked = {name: asked[name] for name in (*OBSERVABLES, *asked) if name in asked}
        self.problem, self.seconds, self.fields = problem, dict[str, float](), frozenset(fields)
        for observable in self.asked.values():
            observable.check_in(grid.domain)
            observable.check_contact(problem)
        spectra, acf = asked.get("spectra", Spectra()), asked.get("acf")
        assert isinstance(spectra, Spectra)
        cell = Cell(n=grid.shape, length=grid.lengths)
        edges = spectra.edges(cell, cutoff)
        lags = lag_rings(grid, acf.edges(cell)) if isinstance(acf, Acf) else None
        correlated = grid.domain.wraps and bool(asked.keys() & {"spectra", "acf"})
        self.surface = RoughSurface(grid, problem.heights, cutoff, edges, lags, correlated)
        options = Solver(method=problem.law.methods[0], tolerance=LOWPASS_TOLERANCE)
        self._given_solve = solve or partial(solve_contact, options=options, overwrite_heights=True)
        _ = self.surface.rms_slope  # measures the heights now, so that no observable is charged for it

    def contact(self, solution: ContactSolution) -> MeasuredContact:
        """The solved contact of one load, for `row` and `groups` to measure."""
        problem = self.problem.at(solution.mean_pressure)
        return MeasuredContact(problem, self.surface, solution, self.asked, self._solve, self.fields)

    def _solve(self, problem: ContactProblem, **options: Any) -> ContactSolution | None:
        """A further contact; None, and a warning in the log, if it cannot be solved: the load itself is.  Collective.
        """
        try:
            return self._given_solve(problem, **options)
        except (InputError, SolverError) as failure:
            if not shared(problem.grid.comm, failure):
                raise
            if problem.grid.comm.rank == 0:
                log.warning("an observable lacks a contact that it asks for: %s", failure)
            return None

    def row(self, contact: MeasuredContact) -> dict[str, float]:
        """The numbers of `schema.LOADS`; the same on all ranks.  Collective."""
        area, solution = contact.area, contact.solution
        return {
            "mean_pressure": solution.mean_pressure,
            "contact_area": area.fraction,
            "contact_area_corrected": area.corrected,
            "contact_perimeter": area.perimeter / math.prod(self.problem.grid.lengths),
            "contact_line": float(contact.line is not None),
            "kappa": contact.kappa,
            "mean_gap": solution.mean_gap,
            "mean_plastic_depth": solution.mean_plastic_depth,
            "elastic_energy": solution.elastic_energy,
            "certified_error": solution.certified_error,
            "pressure_error": solution.pressure_error,
            "max_violation": solution.max_violation,
            "iterations": solution.iterations,
            "transforms": solution.transforms,
            "seconds": solution.seconds,
        }

    def groups(self, contact: MeasuredContact) -> dict[str, Mapping[str, np.ndarray]]:
        """The groups of datasets of all observables, complete on rank 0; under "loads" the numbers that they add to the
        row, on all ranks.  Collective.
        """
        groups: dict[str, Mapping[str, np.ndarray]] = {}
        columns: dict[str, np.ndarray] = {}
        for name, observable in self.asked.items():
            began = time.perf_counter()
            measured = dict(observable.measure(contact))
            columns |= measured.pop(TABLE, {})
            groups |= measured
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began
        columns = contact.grid.comm.bcast(columns)
        return groups | ({TABLE: columns} if columns else {})
