"""A folder of instruments' files: each becomes a job of path, modulus and load, a solution, and an export.

    python tools/bench/instrument_files.py FOLDER [--boundary open] [--pictures]     # a table, one line per file

A file counts if SurfaceTopography reads a two-dimensional topography from it (packed ones: after unpacking).  Heights
of the run are compared with those of SurfaceTopography at the points that were measured, and so are size and unit; the
export is read by SurfaceTopography again.  What a job must say in addition, after a refusal that names it, stands in
the table.  1 as exit code if a file that counts is not solved, or anything differs.
"""

import argparse
import gzip
import logging
import shutil
import sys
import tempfile
import warnings
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

import pgfmd
from pgfmd.application.export import export

CLOSE = 1e-9  # of heights, over their range, and of sides
REMEDIES = {"too many to fill them unasked": {"missing": "interpolate"}}  # words of a refusal → keys of [surface]


@dataclass
class Row:
    """What became of a file."""

    name: str
    points: str = ""
    size: str = ""
    added: str = ""  # keys beside path, modulus and load
    heights: float = np.nan  # largest difference over the range of the heights
    back: float = np.nan  # the same after the export
    area: float = np.nan
    faults: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        found = "; ".join(self.faults) or "solved"
        numbers = f"{self.heights:.0e} | {self.back:.0e} | {self.area:.4f}"
        return f"| {self.name} | {self.points} | {self.size} | {self.added} | {numbers} | {found} |"


def topography(path: Path, folder: Path) -> Any:
    """What SurfaceTopography reads from a file; None if that is nothing, or a line scan."""
    import SurfaceTopography

    if path.suffix == ".gz":
        unpacked = folder / path.stem
        with gzip.open(path) as source, open(unpacked, "wb") as target:
            shutil.copyfileobj(source, target)
        path = unpacked
    with suppress(Exception), SurfaceTopography.open_topography(str(path)) as reader:
        channel = reader.default_channel
        if channel.dim == 2:
            return reader.topography(**({} if channel.physical_sizes else {"physical_sizes": (1.0, 1.0)}))
    return None


def examine(path: Path, boundary: str, pictures: bool) -> Row | None:
    """One file; None if it does not count."""
    import SurfaceTopography

    with tempfile.TemporaryDirectory(prefix="pgfmd-") as scratch:
        folder, row = Path(scratch), Row(path.name)
        expected = topography(path, folder)
        if expected is None:
            return None
        values = np.ma.filled(np.ma.asarray(expected.heights(), dtype=float), np.nan)
        sized = path.suffix not in (".npy", ".h5") and expected.physical_sizes != (1.0, 1.0) or expected.unit
        slope = float(np.sqrt(sum(np.nanmean(np.diff(values, axis=axis) ** 2) for axis in (0, 1))))
        step = expected.physical_sizes[0] / values.shape[0] if sized else 1.0
        surface: dict[str, Any] = {"kind": "file", "path": str(path.resolve())}
        if path.suffix in (".h5", ".hdf5") and (name := _first_dataset(path)):
            surface["path"] += f":{name}"
        job = {"surface": surface, "solid": {"contact_modulus": 1.0}, "load": {"pressure": 0.05 * slope / step or 1.0}}
        job |= {"output": {"fields": ["height", "pressure", "gap"], "observables": ["histogram"]}}
        job |= {"grid": {"boundary": boundary}} if boundary != "periodic" else {}
        try:
            results = _run(job, folder / "out", row)
        except (pgfmd.InputError, pgfmd.SolverError) as error:
            row.faults.append(str(error)[:200])
            return row
        heights, unit = results.field("height"), results.job["output"]["length_unit"]
        if not sized and heights.shape == values.T.shape and path.suffix == ".txt":
            values = values.T  # lines of a bare matrix are x here, as in .npy
        row.points = " x ".join(map(str, results.shape))
        row.size = " x ".join(f"{side:.6g}" for side in results.lengths) + ("" if unit == "length" else f" {unit}")
        row.area = results[0].numbers["contact_area"]
        if not results[0].numbers["certified_error"] <= 1e-8:
            row.faults.append("not certified")
        row.heights = _apart(heights, values)
        if sized and not np.allclose(results.lengths, expected.physical_sizes, rtol=CLOSE, atol=0):
            row.faults.append(f"size {results.lengths}, not {expected.physical_sizes}")
        if expected.unit and unit != expected.unit:
            row.faults.append(f"unit {unit}, not {expected.unit}")
        row.faults += _without_unit(results, unit)
        again = SurfaceTopography.read_topography(str(export(results, folder / "export")[0]))
        row.back = _apart(again.heights(), heights)
        if not np.allclose(again.physical_sizes, results.lengths, rtol=CLOSE, atol=0):
            row.faults.append("the size is lost in the export")
        if (again.unit or "length") != unit:
            row.faults.append(f"the unit is {again.unit} in the export")
        if pictures:
            row.faults += _pictures(folder / "out", unit)
        row.faults += [f"heights differ by {x:.0e}" for x in (row.heights, row.back) if not x <= CLOSE]
        return row


def _run(job: dict[str, Any], folder: Path, row: Row) -> pgfmd.Results:
    """Run the job, with the keys that a refusal names."""
    try:
        return pgfmd.run(job, folder)
    except pgfmd.InputError as error:
        keys = next((keys for words, keys in REMEDIES.items() if words in str(error)), None)
        if keys is None:
            raise
    row.added = ", ".join(f"{name} = {value}" for name, value in keys.items())
    return pgfmd.run(job | {"surface": job["surface"] | keys}, folder)


def _apart(found: np.ndarray, expected: np.ndarray) -> float:
    """The largest difference at points that were measured, over the range of their heights."""
    if found.shape != expected.shape:
        return np.inf
    span = np.nanmax(expected) - np.nanmin(expected)
    return float(np.nanmax(np.abs(found - expected)) / max(span, sys.float_info.min))


def _first_dataset(path: Path) -> str | None:
    """The default channel of SurfaceTopography, if there are several."""
    names: list[str] = []
    with h5py.File(path) as file:
        file.visititems(lambda key, item: names.append(key) if getattr(item, "ndim", 0) == 2 else None)
    return names[0] if len(names) > 1 else None


def _without_unit(results: pgfmd.Results, unit: str) -> list[str]:
    """The datasets of the run's files that are lengths, but do not say so."""
    faults = []
    for name in ("height", "load_0000"):
        with h5py.File(results.field_file(name)) as file:
            for dataset in (each for each in ("height", "gap") if each in file):
                if file[dataset].attrs.get("units") != unit:
                    faults.append(f"{dataset} has no unit")
    return faults + ["the mean gap has no unit"] * (results.units["mean_gap"] != unit)


def _pictures(folder: Path, unit: str) -> list[str]:
    """The overview page must name the unit."""
    from pgfmd.application.cli import main

    code = main(["plot", "overview", str(folder), "--output", str(folder / "plots")])
    pages = list((folder / "plots").rglob("*.html"))
    named = any(unit in page.read_text(encoding="utf-8") for page in pages)
    return [] if code == 0 and named else ["no unit in the overview page"]


def main(arguments: list[str] | None = None) -> int:
    """The command line; 1 if anything went wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--boundary", default="periodic", help="periodic or open")
    parser.add_argument("--pictures", action="store_true", help="draw the overview of each run, and look for the unit")
    options = parser.parse_args(arguments)
    print("| file | points | size | beside path, modulus, load | heights | export | contact area | |")
    print("|---|---|---|---|---|---|---|---|")
    rows = []
    for path in sorted(options.folder.iterdir()):
        row = examine(path, options.boundary, options.pictures) if path.is_file() else None
        if row is not None:
            rows.append(row)
            print(row, flush=True)
    bad = [row for row in rows if row.faults]
    asked = [row for row in rows if row.added]
    print(f"\n{len(rows)} two-dimensional files, {len(rows) - len(bad)} solved, {len(asked)} after a remedy")
    return int(bool(bad))


if __name__ == "__main__":
    logging.getLogger("pgfmd").setLevel(logging.ERROR)
    warnings.simplefilter("ignore")
    raise SystemExit(main())
