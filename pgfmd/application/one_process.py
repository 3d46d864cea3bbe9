"""Commands that make a surface in one process: `certify`, `new --heights`, and the doubts of `check`."""

import math
import os
from collections.abc import Sequence

import numpy as np

from pgfmd.application.files import FIELDS_FILE, load_name
from pgfmd.application.job import Job, load, parse, tables_as_toml
from pgfmd.application.results import Results
from pgfmd.errors import InputError, Unreachable
from pgfmd.grid.cell import Cell
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.contact import Certified, certified
from pgfmd.options.text import as_toml_value, printable, with_error
from pgfmd.parallel.mpi import ALONE
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.load_control import LoadControl
from pgfmd.surfaces.file import ORDERS, FromFile, Source, fill_missing, jumps, read_heights, subtract_trend
from pgfmd.surfaces.readers import opened
from pgfmd.surfaces.rigid_surface import refined_heights

MOST_COMPARED = 2**26  # points of a file up to which its edges are compared: that reads it whole
MOST_TESTED = 2**22  # points of all surfaces up to which `doubts` makes them: a few seconds


def job_on(surface: str, overrides: Sequence[str] = ()) -> Job:
    """The job of a result folder or TOML file; of any other file, a job on its heights and cell.  Raises InputError."""
    if surface.endswith(".toml"):
        return load(surface, list(overrides))
    if os.path.isdir(surface):
        return parse(Results(surface).provenance["effective_toml"], surface, list(overrides))
    heights = {"kind": "file", "path": os.path.abspath(surface)}
    tables = {"surface": heights, "load": {"pressure": 1.0}}
    return parse(tables_as_toml(tables), surface, list(overrides), folder=os.getcwd())


def certify_file(job: Job, path: str, mean_pressure: float | None = None) -> Certified:
    """The pressure in a file, certified on the surface of a job, whose load is not used.

    path: any file that heights can be read from; or a result folder DIR, for its first load, DIR:2 for the third.
    Raises InputError and SolverError as `pgfmd.certify`, and InputError for a pressure that does not fit the heights.
    """
    grid = SlabGrid(ALONE, job.cell.shape, job.cell.lengths, transform=job.solver.transform, domain=job.cell.domain)
    with grid.freed():
        job.solid.prepare(grid)
        heights = refined_heights(job.surface, job.grid, grid, job.output.length_unit)
        turned = getattr(job.surface, "first_axis", "x") == "y"
        with opened(*_source(path)) as found:
            if (shape := found.shape[:: -1 if turned else 1]) != grid.shape:
                needed = " x ".join(map(str, grid.shape))
                raise InputError(f"holds {shape[0]} x {shape[1]} pressures, the heights are {needed}")
        given, _ = read_heights(grid, _source(path), turned, 1, None)
        if not np.isfinite(given).all():
            at = ", ".join(map(str, np.argwhere(~np.isfinite(given))[0]))
            raise InputError(f"{printable(path, 400)}: the pressure at [{at}] is not finite")
        contact = certified(ContactProblem(grid, heights, job.solid, job.wall), given, mean_pressure)
    if contact.projection.doubt:
        raise InputError(f"{printable(path, 400)}: {contact.projection.doubt}")
    return contact


def _source(path: str) -> Source:
    """File and dataset of a pressure, as of `certify_file`."""
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


def job_on_file(path: str) -> str:
    """The text of a job on a file of heights, as `path` or `path:dataset`.  Points, size and unit stay in the file.

    Missing points and edges that do not match are reported with the keys that treat them.  Raises InputError.
    """
    surface = FromFile(path=path, missing="interpolate", detrend="plane")
    extent = surface.extent()
    cell = Cell(n=extent.n, length=extent.lengths)
    said = surface.check_inputs(cell, None)
    grid_table = ""
    keys = [('detrend = "plane"', "the tilt of the specimen is taken out")]
    try:
        FromFile(path=path).check_inputs(cell, None)
    except InputError:
        keys.append(('missing = "interpolate"', "many points were not measured: contacts there are lost"))
    if math.prod(cell.n) <= MOST_COMPARED:
        grid = SlabGrid(ALONE, cell.n, cell.lengths)
        with grid.freed():
            heights, _ = read_heights(grid, surface.source, False, 1, None)
            fill_missing(grid, heights)
            subtract_trend(grid, heights, ORDERS["plane"], 1)
            if jumps(grid, heights):
                about = "opposite edges do not match; or close the cell: periodic under [surface]"
                grid_table = f'\n[grid]\nboundary = "open"              # {about}\n'
    if extent.lengths is None:
        keys.append(("", "the file says no size: give length or spacing under [grid], else the spacing is 1"))
    lines = [f"{key:<31}# {about}" for key, about in keys]
    unit = f" ({extent.unit})" if extent.unit else ""
    text = f"""\
# {printable(os.path.basename(path), 200)}: {said}.
# Points, size and unit{unit} are those of the file; a key of [grid] or [output] that is given is compared with it.
[surface]
kind = "file"
path = {as_toml_value(path)}
{chr(10).join(lines)}
{grid_table}
[solid]
contact_modulus = 1.0          # E/(1 − ν²), in your unit of pressure; 1.0: pressures are in units of it

[load]
contact_area = [0.05, 0.1]     # parts of the cell; or pressure = […], in the unit of the modulus

[output]
fields = ["height", "pressure", "gap"]
observables = ["histogram", "spectra", "patches"]
"""
    parse(text, "new job", folder=os.getcwd())
    return text


def doubts(job: Job) -> list[str]:
    """A line for each target of a job that cannot be reached, or is wrong input for a seed of an ensemble; one line if
    there are too many points for this test.  The surfaces are made in this process alone.

    Raises InputError for a target or a surface that a run would refuse before its first solution.
    """
    if job.imposed.control == "pressure" or not job.wall.convex:
        return []  # any surface bears it
    seeds = job.surface.seeds
    if math.prod(job.cell.shape) * max(1, len(seeds)) > MOST_TESTED:
        return [f"whether each {job.load.control} can be reached is tested up to {MOST_TESTED} points only"]
    jobs = [job.of_seed(seed) for seed in seeds] or [job]
    lines: dict[str, None] = {}
    for seed, each in zip(seeds or (0,), jobs, strict=True):
        grid = SlabGrid(ALONE, job.cell.shape, job.cell.lengths, domain=job.cell.domain)
        heights = refined_heights(each.surface, job.grid, grid, job.output.length_unit)
        problem = ContactProblem(grid, heights, job.solid, job.wall)
        control = LoadControl(job.load, problem).control
        for target in job.load.targets:
            try:
                control.check_target(target)
                control.check_reachable(target)
            except Unreachable as failure:
                lines[str(failure)] = None
            except InputError as failure:
                if not seeds:
                    raise
                lines[f"seed {seed}: {failure}"] = None  # its other loads are solved
        grid.free()
    return list(lines)
