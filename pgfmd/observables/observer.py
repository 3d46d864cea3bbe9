"""`Observer`: everything that a job asks to be measured on its solved contacts."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable

import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.io.schema import Groups
from pgfmd.observables.acf import Acf
from pgfmd.observables.lowpass import TOLERANCE
from pgfmd.observables.observable import Observable
from pgfmd.observables.rough_surface import RoughSurface
from pgfmd.observables.solved_contact import Solve, SolvedContact
from pgfmd.observables.spectra import Spectra
from pgfmd.observables.statistics.correlations import lag_bins, lag_rings, mode_rings, wave_number_bins
from pgfmd.observables.table import OBSERVABLES
from pgfmd.physics.elasticity import Elasticity
from pgfmd.solvers.active_set.nested_iteration import solve_hard_wall
from pgfmd.solvers.solution import ContactSolution


class Observer:
    """Measures solved contacts of one rough surface.  Making one costs half a transform (a whole one for
    autocorrelations). Collective.

    heights (nx_local, ny) are kept, not copied.  cutoff: wave number beyond which the surface has no modes (None:
    none). seconds: time spent so far on each observable; what several share counts for the first.
    """

    def __init__(
        self,
        grid: SlabGrid,
        heights: np.ndarray,
        elasticity: Elasticity,
        observables: Iterable[Observable] = (),
        cutoff: float | None = None,
        solve: Solve | None = None,
    ):
        asked = {observable.name: observable for observable in observables}
        self.asked = {name: asked[name] for name in OBSERVABLES if name in asked}
        self.contact_modulus, self.seconds = elasticity.contact_modulus, dict[str, float]()
        spectra, acf = asked.get("spectra", Spectra()), asked.get("acf")
        assert isinstance(spectra, Spectra)
        q_max = None if spectra.all_modes else cutoff
        modes = mode_rings(grid, wave_number_bins(grid, spectra.spacing, spectra.bins, q_max))
        lags = lag_rings(grid, lag_bins(grid, acf.spacing, acf.bins)) if isinstance(acf, Acf) else None
        self.surface = RoughSurface(grid, heights, cutoff, modes, lags)

        def hard(grid: SlabGrid, heights: np.ndarray, load: float, start: np.ndarray | None) -> ContactSolution:
            return solve_hard_wall(grid, heights, load, elasticity, TOLERANCE, start, overwrite_heights=True)

        self._solve = solve or hard
        _ = self.surface.rms_slope

    def contact(self, solution: ContactSolution) -> SolvedContact:
        """What is measured on one load."""
        return SolvedContact(self.surface, solution, self.asked, self._solve)

    def row(self, contact: SolvedContact) -> dict[str, float]:
        """The numbers of `schema.LOADS`; the same on all ranks.  Collective."""
        area, solution = contact.area, contact.solution
        load = solution.mean_pressure
        return {
            "mean_pressure": load,
            "contact_area": area.fraction,
            "contact_area_corrected": area.corrected,
            "kappa": area.fraction * self.contact_modulus * self.surface.rms_slope / load if load > 0 else math.nan,
            "mean_gap": solution.mean_gap,
            "elastic_energy": solution.elastic_energy,
            "certified_error": solution.certified_error,
            "max_violation": solution.max_violation,
            "iterations": solution.iterations,
            "transforms": solution.transforms,
            "seconds": solution.seconds,
        }

    def groups(self, contact: SolvedContact) -> Groups:
        """The groups of datasets of all observables, complete on rank 0.  Collective."""
        groups: dict = {}
        for name, observable in self.asked.items():
            began = time.perf_counter()
            groups |= observable.measure(contact)
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began
        return groups
