"""`pgfmd certify`: the certificate of a pressure in a file, on the surface and the solid of a job."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence

import numpy as np

from pgfmd.application.files import FIELDS_FILE, load_name
from pgfmd.application.info import known
from pgfmd.application.job import Job, load, parse, tables_as_toml
from pgfmd.application.results import Results
from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.contact import Certified, certified
from pgfmd.options.text import printable, with_error
from pgfmd.parallel.mpi import ALONE
from pgfmd.physics.problem import ContactProblem
from pgfmd.surfaces.file import FromFile
from pgfmd.surfaces.heights_file import Source, read_heights


def job_on(surface: str, overrides: Sequence[str] = ()) -> Job:
    """The job of a result folder or in a TOML file, or one on the heights in any other file, whose cell is that of the
    file.  Raises InputError.
    """
    if surface.endswith(".toml"):
        return load(surface, list(overrides))
    if os.path.isdir(surface):
        return parse(Results(surface).provenance["effective_toml"], surface, list(overrides))
    heights = {"kind": "file", "path": os.path.abspath(surface)}
    tables = {"surface": heights, "load": {"pressure": 1.0}}
    return parse(tables_as_toml(tables), surface, list(overrides), folder=os.getcwd())


def certify_file(job: Job, path: str, mean_pressure: float | None = None) -> Certified:
    """The pressure in a file, certified on the surface of a job.  Of the job's load only the law matters.

    path: of what heights may be read from; or a result folder, whose first load counts, and DIR:2, its third.  Raises
    InputError and SolverError as `pgfmd.certify`, and InputError for a pressure that does not fit the heights.
    """
    grid = SlabGrid(ALONE, job.grid.shape, job.grid.lengths, transform=job.solver.transform)
    with grid.freed():
        job.solid.prepare(grid)
        heights = job.surface.whole.heights(grid, job.output.length_unit)
        turned = getattr(job.surface, "first_axis", "x") == "y"
        given, _ = read_heights(grid, _source(path), turned, 1, None)
        if not np.isfinite(given).all():
            at = ", ".join(map(str, np.argwhere(~np.isfinite(given))[0]))
            raise InputError(f"{printable(path, 400)}: the pressure at [{at}] is not finite")
        contact = certified(ContactProblem(grid, heights, job.solid, job.wall), given, mean_pressure)
    if contact.projection.doubt:
        raise InputError(f"{printable(path, 400)}: {contact.projection.doubt}")
    return contact


def _source(path: str) -> Source:
    """File and dataset of a pressure."""
    folder, _, index = path.rpartition(":") if not os.path.isdir(path) and path[-1:].isdigit() else (path, "", "0")
    if os.path.isdir(folder):
        return os.path.join(folder, FIELDS_FILE), f"{load_name(int(index))}/pressure"
    return FromFile(path=path).source


def line(contact: Certified) -> str:
    """The certificate in one line."""
    numbers = contact.summary()
    area, corrected, bar = (numbers[f"contact_area{end}"] for end in ("", "_corrected", "_error"))
    by = numbers["mean_pressure"] / numbers["given_mean_pressure"]
    return (
        f"certified error {numbers['certified_error']:.2e} of 2 E_el (pressure: about "
        f"{numbers['pressure_error']:.1e} of its rms)  mean pressure {numbers['mean_pressure']:.6g}  area {area:.5f} "
        f"(corrected {with_error(corrected, bar)})  made feasible: load × {by:.7g}, pressure changed by "
        f"{numbers['projection']:.1e}"
    )


def as_json(contact: Certified) -> str:
    """The same as JSON; null for what is not known."""
    return json.dumps(known(contact.summary()), indent=2)
