"""Reading result folders: NumPy and serial h5py only, no MPI; pandas and xarray for the methods named after them."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from pgfmd.application.files import ENSEMBLE_FILE, FIELDS_FOLDER, FORMAT_VERSION, OBSERVABLES_FILE, holder, load_name
from pgfmd.application.tables import linked, read_columns
from pgfmd.errors import InputError
from pgfmd.observables.schema import FIELDS, TABLE, Dataset, is_error
from pgfmd.options.text import aligned

if TYPE_CHECKING:
    import pandas
    import xarray

SUMS_IN_1 = ("stress_spectrum", "contact_spectrum", "bearing_spectrum")
OF_GAPS = {"gap_histogram": "density", "gap_spectrum": "value"}
BARS = "discretisation"  # the group that holds errors of columns of the table of loads


class Results:
    """A result folder: its completed loads, also while the run continues or after it was interrupted.

    Reads the table of loads at once, everything else on access, and converts earlier formats to the present one.
    Iterating gives the loads.  Raises InputError if the folder is missing, holds no results, or has a newer format.

    >>> import pgfmd
    >>> wave = {"kind": "sinusoid", "amplitude": 1.0}
    >>> solid, load = {"contact_modulus": 1.0}, {"pressure": [0.01, 0.02]}
    >>> results = pgfmd.run({"grid": {"n": 32}, "surface": wave, "solid": solid, "load": load})
    >>> [round(load.numbers["contact_area"], 3) for load in results]
    [0.219, 0.281]
    >>> results.to_dataframe()[["mean_pressure", "contact_area"]].shape
    (2, 2)
    """

    def __init__(self, directory: str | os.PathLike):
        self.directory = Path(directory)
        path = self.directory / OBSERVABLES_FILE
        if (self.directory / ENSEMBLE_FILE).is_file():
            raise InputError(f"{self.directory}: an ensemble; pgfmd.Ensemble reads it, or give one of its folders")
        if not path.is_file():
            missing = "no such folder" if not self.directory.is_dir() else f"holds no {OBSERVABLES_FILE}"
            raise InputError(f"{self.directory}: not a result folder: {missing}")
        with self._open(OBSERVABLES_FILE) as file:
            version = file.attrs.get("format_version")
            if file.attrs.get("software") != "pgfmd" or version is None:
                raise InputError(f"{path}: not written by pgfmd")
            if version > FORMAT_VERSION:
                raise InputError(
                    f"{path}: format {version} is newer than {FORMAT_VERSION}, the newest known here; "
                    f"it was written by pgfmd {file.attrs.get('softwareVersion')}"
                )
            self.provenance = {
                name: value.tolist() if isinstance(value, (np.generic, np.ndarray)) else value
                for name, value in file.attrs.items()
            }
            phases = file["phases"].attrs if "phases" in file else {}
            self.phases = {name: float(value) for name, value in phases.items()}
            self.loads = read_columns(file[TABLE])
        if self._overlaps:
            self.loads["mean_gap"] = np.full_like(self.loads["mean_gap"], np.nan)

    def __len__(self) -> int:
        """Number of completed loads."""
        return len(self.loads["mean_pressure"])

    def __iter__(self) -> Iterator[LoadResults]:
        return (self.load(index) for index in range(len(self)))

    def __getitem__(self, index: int) -> LoadResults:
        return self.load(index)

    def __add__(self, other: Results | Runs) -> Runs:
        """The loads of both."""
        return Runs([self]) + other

    def __repr__(self) -> str:
        return f"{self.directory}: {self.status}\n{table(self)}"

    def to_dataframe(self) -> pandas.DataFrame:
        """The table of loads for pandas, with the error bars of the grid where they were measured (NaN: not)."""
        import pandas

        return pandas.DataFrame([load.numbers for load in self]).rename_axis("load")

    @cached_property
    def columns(self) -> dict[str, Dataset]:
        """Unit and description of each column of `loads`."""
        with self._open(OBSERVABLES_FILE) as file:
            columns = {name: file[TABLE][name].attrs for name in self.loads}
            return {name: Dataset(about["units"], about["description"]) for name, about in columns.items()}

    @property
    def units(self) -> dict[str, str]:
        """Unit of each column of `loads`."""
        return {name: about.unit for name, about in self.columns.items()}

    @property
    def status(self) -> str:
        """ "complete", "running", "stopped" (asked to), "failed", or "interrupted" (no process holds the folder)."""
        status = self.provenance.get("status", "interrupted")
        return "interrupted" if status == "running" and holder(self.directory) is None else status

    @property
    def job(self) -> dict[str, dict]:
        """The job as nested tables, defaults included: job["surface"]["hurst"]."""
        return tomllib.loads(self.provenance["effective_toml"])

    @cached_property
    def _overlaps(self) -> bool:
        """Whether gaps in the files are negative where the wall yields: see `_modern`."""
        return self.provenance["format_version"] < 3 and self.job.get("wall", {}).get("kind") == "hardness"

    @property
    def shape(self) -> tuple[int, int]:
        """Grid points (nx, ny)."""
        nx, ny = self.provenance["shape"]
        return int(nx), int(ny)

    @property
    def lengths(self) -> tuple[float, float]:
        """Cell (lx, ly)."""
        lx, ly = self.provenance["lengths"]
        return float(lx), float(ly)

    def load(self, index: int) -> LoadResults:
        """Curves and tables of one load, read when accessed: load(0)["stress_spectrum"]["q"]; -1 is the last load."""
        return LoadResults(self, self._index(index))

    def fields(self, load: int | None = None) -> list[str]:
        """Names of the fields that were written, for a load or (None) for the whole run."""
        if load is None:
            return ["height"] if self.field_file("height").exists() else []
        with self._open(OBSERVABLES_FILE) as file:
            group = file.get(load_name(self._index(load)))  # None if a run skipped the load and was interrupted
            names = [] if group is None else [str(name) for name in group.attrs["fields"]]
        return [*names, "plastic_depth"] if self._overlaps and "gap" in names else names

    def field(self, name: str, load: int | None = None, rows: slice = slice(None)) -> np.ndarray:
        """Rows of a field, shape (rows, ny): "height" without a load, the others with one."""
        if name not in self.fields(load):
            which = "the run" if load is None else f"load {load}"
            hint = " (give a load, if it belongs to one)" if load is None and name in FIELDS else ""
            raise InputError(f"{self.directory}: no field {name} of {which}{hint}")
        path = self.field_file(name if load is None else load_name(self._index(load)))
        if not path.exists():
            raise InputError(f"{path}: is missing")
        with self._open(path.relative_to(self.directory)) as file:
            if self._overlaps and name in ("gap", "plastic_depth"):
                return np.maximum(file["gap"][rows] if name == "gap" else -file["gap"][rows], 0)
            return file[name][rows]

    def field_file(self, name: str) -> Path:
        """The path of the file of "height" or of the fields of a load ("load_0000"); it may not exist."""
        return self.directory / self.provenance.get("fields_folder", FIELDS_FOLDER) / f"{name}.h5"

    def table_files(self) -> list[Path]:
        """The files of groups that have one, of all loads."""
        with self._open(OBSERVABLES_FILE) as file:
            loads = [file[load_name(index)] for index in range(len(self)) if load_name(index) in file]
            return [self.directory / path for load in loads for path in linked(load).values()]

    def blocks(self, name: str, load: int | None = None, size: int = 2**26) -> Iterator[tuple[slice, np.ndarray]]:
        """A field in blocks of rows of about `size` bytes: (rows, values), so that it may be larger than memory."""
        count = max(1, size // (8 * self.shape[1]))
        for start in range(0, self.shape[0], count):
            rows = slice(start, min(start + count, self.shape[0]))
            yield rows, self.field(name, load, rows)

    @contextmanager
    def group(self, load: h5py.Group, title: str) -> Iterator[h5py.Group]:
        """A group of an open load; a file of its own is opened without locks, which a link would take."""
        link = load.get(title, getlink=True)
        if isinstance(link, h5py.ExternalLink):
            with self._open(link.filename) as file:
                yield file
        else:
            yield load[title]

    def _modern(self, title: str, table: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        """A group of one load in the present format; itself if it needs no change.

        1: spectra of stress, contact and bearing area were those of sums over points, N² larger than those of Fourier
           coefficients (N points); the area of low-passed surfaces was the corrected one.
        2: every spectrum is that of Fourier coefficients; low-passed surfaces have both areas.  Where a wall of limited
           hardness yields, the gap was negative: minus the plastic depth.  Its field is converted; the mean gap and the
           gap's histogram and spectrum are not known (NaN).
        3: the gap is 0 where the wall yields; the plastic depth is a field and a column of its own.
        4: checksums are in SHA256SUMS, no longer at the end of each file.
        """
        if self._overlaps and title in OF_GAPS:
            return {**table, OF_GAPS[title]: np.full_like(table[OF_GAPS[title]], np.nan)}
        if self.provenance["format_version"] >= 2:
            return table
        if title in SUMS_IN_1:
            return {**table, "value": table["value"] / float(self.shape[0] * self.shape[1]) ** 2}
        if title == "lowpass_area":
            return {"q": table["q"], "area_corrected": table["area"]}
        return table

    def _index(self, index: int) -> int:
        if not -len(self) <= index < len(self):
            raise InputError(f"{self.directory}: no load {index}: {len(self)} were completed, counted from 0")
        return index % len(self)

    def _open(self, name: str | Path) -> h5py.File:
        # Files are replaced as a whole and never changed in place: no locks, so that read-only folders work.
        # If this process has the file open with locks, as by xarray, HDF5 wants them here, too.
        for locking in (False, None):
            try:
                return h5py.File(self.directory / name, "r", locking=locking)
            except OSError as error:
                reason = error
        raise InputError(f"{self.directory / name}: cannot be read: {reason}")


class LoadResults(Mapping[str, Mapping[str, np.ndarray]]):
    """One load of a run: a mapping of its groups of curves and tables, name → {dataset: array}; numbers; fields."""

    def __init__(self, results: Results, index: int):
        self.results, self.index, self._name = results, index, load_name(index)

    def __getitem__(self, title: str) -> Mapping[str, np.ndarray]:
        if title not in self:
            hint = f"; the field is field({title!r})" if title in FIELDS else ""
            raise KeyError(f"load {self.index} has no {title}, but {', '.join(self) or 'no groups'}{hint}")
        with self.results._open(OBSERVABLES_FILE) as file:
            with self.results.group(file[self._name], title) as group:
                return self.results._modern(title, {key: dataset[()] for key, dataset in group.items()})

    def __iter__(self) -> Iterator[str]:
        with self.results._open(OBSERVABLES_FILE) as file:
            return iter(list(file[self._name]) if self._name in file else [])

    def __contains__(self, title: object) -> bool:
        return any(title == each for each in self)

    def __len__(self) -> int:
        return len(list(iter(self)))

    def __repr__(self) -> str:
        known = self.numbers
        return f"load {self.index} of {self.results.directory}: " + ", ".join(
            f"{name} {known[name]:.4g}" for name in ("mean_pressure", "contact_area", "mean_gap")
        )

    @property
    def numbers(self) -> dict[str, float]:
        """The row of the table of loads, with the errors NAME_error of its numbers that were estimated."""
        row = {name: column[self.index].item() for name, column in self.results.loads.items()}
        return row | {name: float(value) for name, value in (self[BARS] if BARS in self else {}).items()}

    def field(self, name: str, rows: slice = slice(None)) -> np.ndarray:
        """Rows of a field of this load, or of the heights: (rows, ny)."""
        return self.results.field(name, None if name == "height" else self.index, rows)

    def to_xarray(self) -> xarray.Dataset:
        """All fields that were written for this load, and the heights, with named axes and coordinates."""
        import xarray

        names = self.results.fields() + self.results.fields(self.index)
        axes = zip(("x", "y"), self.results.shape, self.results.lengths, strict=True)
        points = {name: np.arange(count) * (length / count) for name, count, length in axes}
        fields = {name: (("x", "y"), self.field(name), {"description": FIELDS[name].description}) for name in names}
        return xarray.Dataset(fields, points, self.numbers)


class Runs:
    """Several runs as one: their loads in turn.

    >>> import pgfmd
    >>> job = {"grid": {"n": 32}, "surface": {"kind": "paraboloid", "radius": 60.0}, "load": {"pressure": [0.001]}}
    >>> job |= {"solid": {"contact_modulus": 1.0}}
    >>> runs = pgfmd.run(job) + pgfmd.run(job | {"load": {"pressure": [0.002]}})
    >>> len(runs), [load.numbers["mean_pressure"] for load in runs]
    (2, [0.001, 0.002])
    """

    def __init__(self, runs: Iterable[Results]):
        self.runs = list(runs)

    def __len__(self) -> int:
        """Number of completed loads of all runs."""
        return sum(map(len, self.runs))

    def __iter__(self) -> Iterator[LoadResults]:
        return (load for run in self.runs for load in run)

    def __add__(self, other: Results | Runs) -> Runs:
        return Runs(self.runs + (other.runs if isinstance(other, Runs) else [other]))

    def __repr__(self) -> str:
        return "\n\n".join(map(repr, self.runs))

    def to_dataframe(self) -> pandas.DataFrame:
        """The tables of loads one below the other, indexed by the name of the folder and the number of the load."""
        import pandas

        if not self.runs:
            return pandas.DataFrame()
        names = [run.directory.name for run in self.runs]
        return pandas.concat([run.to_dataframe() for run in self.runs], keys=names, names=["run"])


def table(results: Results) -> str:
    """The table of loads as aligned text, one row per load; with error bars, where they are known."""
    numbers = [load.numbers for load in results]
    columns = {}
    for name, values in results.loads.items():
        if not is_error(name, results.loads):
            errors = [row.get(f"{name}_error", np.nan) for row in numbers]
            columns[name] = list(map(with_bar, values, errors))
    return text_table(columns, results.units)


def size_in_words(shape: tuple[int, int], lengths: tuple[float, float], unit: str, grid: Mapping[str, Any]) -> str:
    """Points and size of the cell, or of a patch, with the unit if the job has one; grid: the keys of [grid]."""
    place = "patch" if grid.get("boundary") == "open" else "cell"
    size = f"{shape[0]} × {shape[1]} points, {place} {lengths[0]:g} × {lengths[1]:g}"
    return size if unit == "length" else f"{size} {unit}"


def with_bar(value: float | np.number, error: float) -> str:
    """ "value ± error"; "value" where the error is 0 or not finite."""
    text = f"{value:d}" if isinstance(value, np.integer) else f"{value:.5g}"
    return f"{text} ± {error:.1g}" if np.isfinite(error) and error > 0 else text


def text_table(columns: Mapping[str, Sequence[str]], units: Mapping[str, str]) -> str:
    """Columns of texts, an entry per load, as aligned text: their names, their units, and the numbered rows."""
    loads = range(len(next(iter(columns.values()))))
    named = [[name, units[name], *cells] for name, cells in columns.items()]
    return "\n".join(aligned(list(zip(["load", "", *map(str, loads)], *named, strict=True))))
