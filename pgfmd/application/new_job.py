"""`pgfmd new --heights FILE`: a short job on a file of heights, with what was found in the file."""

from __future__ import annotations

import math
import os

from pgfmd.application.job import parse
from pgfmd.errors import InputError
from pgfmd.grid.cell import Cell
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.options.text import as_toml_value, printable
from pgfmd.parallel.mpi import ALONE
from pgfmd.surfaces.file import ORDERS, FromFile, jumps, subtract_trend
from pgfmd.surfaces.heights_file import fill_missing, read_heights

LARGEST = 2**26  # points of files whose edges are compared, which reads them whole


def job_on_file(path: str) -> str:
    """The text of a job on a file of heights, as `path` or `path:dataset`.  Points, size and unit stay in the file.

    Missing points and edges that do not match are reported with the keys that treat them.  Raises InputError if the
    file cannot be read.
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
    if math.prod(cell.n) <= LARGEST:
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
