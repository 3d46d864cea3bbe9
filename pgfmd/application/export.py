"""`pgfmd export`: results as NetCDF, in the layout of contact.engineering, or heights as .x3p.  No MPI here.

The fields of a load are related by

    gap = displacement − (heights − ⟨heights⟩) − mean_displacement

less the plastic depth under a wall of limited hardness.  Pressures are in units of the contact modulus.  The layout is
NetCDF 3: SurfaceTopography and the site read no other.
"""

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pgfmd.application.files import load_name
from pgfmd.application.job import NO_UNIT, Job, parse
from pgfmd.application.results import LoadResults, Results
from pgfmd.errors import InputError

LARGEST = 2**32 - 4  # bytes of a variable of a NetCDF 3 file with 64-bit offsets
ASCII = {"µ": "u", "\u03bc": "u", "Å": "A", "\u212b": "A"}  # NetCDF 3 has no other letters


def export(results: Results, folder: str | os.PathLike, form: str = "nc") -> list[Path]:
    """Write results into a folder, which is made if need be; the files.

    form: "nc", a file for each load, or one of heights where no load was completed; "x3p", one of heights.  Raises
    InputError if the fields that are needed were not written, or are too large for the format.
    """
    needed = {"nc": ("pressure", "gap"), "x3p": ()}[form] if len(results) else ()
    missing = [] if "height" in results.fields() else ["height"]
    missing += [name for name in needed if name not in results.fields(0)]
    if missing:
        raise InputError(f"{results.directory}: has no field {', '.join(missing)}: write it (fields under [output])")
    if form == "nc" and 8 * math.prod(results.shape) > LARGEST:
        raise InputError(f"{results.directory}: fields of {results.shape} points are too large for NetCDF 3")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    if form == "x3p":
        _write_x3p(results, folder / "heights.x3p")
        return [folder / "heights.x3p"]
    if not len(results):
        _write(folder / "heights.nc", results, {}, {})
        return [folder / "heights.nc"]
    job = parse(results.provenance["effective_toml"], str(results.directory))
    written = []
    for load in results:
        if math.isfinite(load.numbers["mean_pressure"]):  # else that load could not be solved
            path = folder / f"{load_name(load.index)}.nc"
            _write(path, results, *_contents(load, job))
            written.append(path)
    return written


def _contents(load: LoadResults, job: Job) -> tuple[dict[str, tuple[np.ndarray, str, str]], dict[str, Any]]:
    """Variables but the heights, name → (values, unit, meaning), and numbers, named as contact.engineering does."""
    heights, pressure, gap = (load.field(name).astype(np.float64) for name in ("height", "pressure", "gap"))
    displacement: np.ndarray = gap + heights
    if "plastic_depth" in load.results.fields(load.index):
        displacement -= load.field("plastic_depth")
    if job.grid.domain.wraps:
        shift = -displacement.mean()  # the mean displacement of the surface is 0, whatever the solid
    else:
        shift = load.numbers["displacement"] - heights.max()  # absolute: distant points are at rest
    displacement += shift
    contact = pressure > job.wall.contact_above(float(pressure.mean()), float(np.mean(pressure**2)))
    numbers, modulus, length = load.numbers, job.solid.contact_modulus, job.output.length_unit
    fields = {
        "pressure": (pressure / modulus, "E*", "contact pressure over the contact modulus"),
        "gap": (gap, length, "gap between solid and surface"),
        "displacement": (displacement, length, "displacement of the solid's surface"),
        "contacting_points": (contact.astype(np.int8), "1", "1 in contact, as the contact law defines it"),
    }
    attributes = {
        "mean_pressure": numbers["mean_pressure"] / modulus,
        "total_contact_area": numbers["contact_area"],
        "mean_displacement": heights.mean() + shift,
        "mean_gap": numbers["mean_gap"],
        "type": "periodic" if job.grid.domain.wraps else "nonperiodic",
        "length_unit": length,
        "contact_modulus": modulus,
        "pressure_unit": job.output.pressure_unit,
        "certified_error": numbers["certified_error"],
        "contact_area_corrected": numbers["contact_area_corrected"],
    }
    hardness = getattr(job.wall, "hardness", None)
    return fields, attributes if hardness is None else attributes | {"hardness": hardness / modulus}


def _write(path: Path, results: Results, fields: Mapping[str, tuple], attributes: Mapping[str, Any]) -> None:
    """Write one NetCDF file beside its place, and rename it."""
    from scipy.io import netcdf_file

    unit, boundary = results.job["output"]["length_unit"], results.job["grid"].get("boundary", "periodic")
    beside = path.with_name(f".{path.name}.new")
    with netcdf_file(beside, "w", mmap=False, version=2) as file:
        for name, value in {"software": "pgfmd", **attributes}.items():
            setattr(file, name, _attribute(value))
        for axis, count, length in zip("xy", results.shape, results.lengths, strict=True):
            file.createDimension(axis, count)
            points = file.createVariable(axis, "f8", (axis,))
            points[:] = np.arange(count) * (length / count)
            points.length, points.periodic = np.float64(length), int(boundary == "periodic")
            if unit != NO_UNIT:
                points.unit = _attribute(unit)
        held = {"heights": (results.field("height").astype(np.float64), unit, "heights of the surface"), **fields}
        for name, (values, of, meaning) in held.items():
            variable = file.createVariable(name, values.dtype.str[1:], ("x", "y"))
            variable[:] = values
            variable.long_name = meaning
            if of != NO_UNIT:
                variable.unit = _attribute(of)
    os.replace(beside, path)


def _write_x3p(results: Results, path: Path) -> None:
    """Heights as ISO 25178-72, which is in metres, by SurfaceTopography."""
    try:
        import SurfaceTopography
    except ImportError:
        raise InputError(".x3p is written by SurfaceTopography; install it: pip install 'pgfmd[surfaces]'") from None
    unit = results.job["output"]["length_unit"]
    if unit == NO_UNIT:
        raise InputError(f"{results.directory}: .x3p is in metres, but the job has no length_unit under [output]")
    surface = SurfaceTopography.Topography(results.field("height"), results.lengths, unit=unit, periodic=True)
    surface.to_x3p(path)


def _attribute(value: Any) -> Any:
    """An attribute as NetCDF 3 holds it: ASCII, or a number in double precision."""
    if not isinstance(value, str):
        return np.float64(value)  # Python's float would be written in single precision
    return "".join(ASCII.get(letter, letter) for letter in value).encode("ascii", "replace")
