"""Ensembles: a folder of runs that differ by the seed of their surface alone, and means over them.  No MPI here.

    seed_0001/, seed_0002/, …   a result folder for each seed
    ensemble.h5                 what was run, the seeds, and for each load mean and standard error over the seeds
"""

from __future__ import annotations

import json
import os
import tomllib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from pgfmd.application.files import ENSEMBLE_FILE, OBSERVABLES_FILE, holder, load_name, member_name, revise
from pgfmd.application.results import Results, Runs, text_table
from pgfmd.application.tables import name_axes, read_columns
from pgfmd.errors import InputError
from pgfmd.observables.schema import TABLE, is_error

if TYPE_CHECKING:
    import pandas

COUNT = "number of seeds whose load was solved"


class Ensemble(Runs):
    """The folder of an ensemble, complete or not.

    seeds: as the job lists them; runs: of the seeds that have begun; failed: error messages by seed; provenance: of the
    last command.  Raises InputError if the folder holds no ensemble.

    >>> import pgfmd
    >>> rough = {"kind": "self-affine", "hurst": 0.8, "lambda_s": 8.0, "rms_slope": 0.1, "seed": "1..3"}
    >>> solid, load = {"contact_modulus": 1.0}, {"pressure": [0.005, 0.01]}
    >>> job = {"grid": {"n": 32}, "surface": rough, "solid": solid, "load": load}
    >>> ensemble = pgfmd.run(job)
    >>> ensemble.seeds, ensemble.status, len(ensemble)
    ([1, 2, 3], 'complete', 6)
    >>> ensemble.mean()[["contact_area", "contact_area_error", "seeds"]].shape
    (2, 3)
    """

    def __init__(self, directory: str | os.PathLike):
        self.directory = Path(directory)
        try:
            with h5py.File(self.directory / ENSEMBLE_FILE, "r", locking=False) as file:
                self.provenance: dict[str, Any] = dict(file.attrs)
        except OSError as error:
            raise InputError(f"{self.directory}: not the folder of an ensemble: {error}") from None
        self.seeds = [int(seed) for seed in self.provenance["seeds"]]
        self.failed = {int(seed): message for seed, message in json.loads(self.provenance["failed"]).items()}
        super().__init__(Results(folder) for folder in folders(self.directory))

    @property
    def status(self) -> str:
        """ "complete", "running", "failed" (some seeds), "stopped", or "interrupted" (no process holds the folder)."""
        status = str(self.provenance["status"])
        return "interrupted" if status == "running" and holder(self.directory) is None else status

    def __repr__(self) -> str:
        return f"{self.directory}: {self.status}\n{table(self)}"

    def mean(self) -> pandas.DataFrame:
        """Mean over the seeds and its standard error (NAME_error) of each number, load by load, and how many
        seeds; NAME_seeds where only some of these gave a finite number.
        """
        import pandas

        columns: dict[str, np.ndarray] = {}
        means, seeds = mean_loads(self.runs), solved_runs(self.runs)
        for name, column in means.items():
            columns |= dict(column.named(name, means))
            if fewer(column, seeds).any():
                columns[f"{name}_seeds"] = column.count
        return pandas.DataFrame(columns | {"seeds": seeds}).rename_axis("load")

    def load(self, index: int) -> dict[str, dict[str, np.ndarray]]:
        """Curves of one load averaged over the seeds, each with its standard error: group → dataset, dataset_error.

        Groups whose axes differ between the seeds (patches, histograms) have no mean and are left out.
        """
        found = mean_groups(self.runs, index)
        return {title: {name: values for key, column in group.items() for name, values in column.named(key, group)}
                for title, group in found.items()}  # fmt: skip


@dataclass
class Column:
    """One dataset of several runs: mean and standard error, entry by entry, over the runs in which it is finite.

    about: description and units; axes: names of the datasets that hold its coordinates; is_axis: it holds coordinates.
    """

    about: dict[str, str] = field(default_factory=dict)
    axes: tuple[str, ...] = ()
    is_axis: bool = False
    _mean: np.ndarray = field(default_factory=lambda: np.zeros(()))
    _squares: np.ndarray = field(default_factory=lambda: np.zeros(()))
    _count: np.ndarray = field(default_factory=lambda: np.zeros(()))

    def add(self, values: np.ndarray) -> None:
        """Add the values of one more run, by Welford's recurrence (doi:10.1080/00401706.1962.10490022)."""
        values = np.asarray(values, np.float64)
        if not self._count.any():
            self._mean, self._squares, self._count = (np.zeros(values.shape) for _ in range(3))
        known = np.isfinite(values)
        self._count = self._count + known
        deviation = np.where(known, values, self._mean) - self._mean
        self._mean = self._mean + deviation / np.maximum(self._count, 1)
        self._squares = self._squares + deviation * (np.where(known, values, self._mean) - self._mean)

    @property
    def count(self) -> np.ndarray:
        """Number of runs with a finite value."""
        return self._count.astype(int)

    @property
    def error(self) -> np.ndarray:
        """Standard error of the mean, √(Σ(x − x̄)²/(n(n − 1))); NaN for fewer than two runs."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(self._count > 1, np.sqrt(self._squares / (self._count * (self._count - 1))), np.nan)

    @property
    def mean(self) -> np.ndarray:
        """The mean; NaN where no run has a finite value."""
        return np.where(self._count > 0, self._mean, np.nan)

    def named(self, name: str, group: Mapping[str, Column]) -> Iterable[tuple[str, np.ndarray]]:
        """The mean as NAME and, unless it is an axis, the error as NAME_error, or NAME_seed_error if the group has a
        NAME_error of its own.
        """
        error = f"{name}_seed_error" if f"{name}_error" in group else f"{name}_error"
        return [(name, self.mean)] if self.is_axis else [(name, self.mean), (error, self.error)]


def is_ensemble(directory: str | os.PathLike) -> bool:
    """Whether a folder holds an ensemble."""
    return (Path(directory) / ENSEMBLE_FILE).is_file()


def folders(directory: str | os.PathLike) -> list[Path]:
    """The result folders in the folder of an ensemble, in the order of its seeds; for any other folder, itself.

    Results of another job, which `--overwrite` has not replaced yet, are left out.
    """
    path = Path(directory)
    if not is_ensemble(path):
        return [path]
    with h5py.File(path / ENSEMBLE_FILE, "r", locking=False) as file:
        seeds, job = file.attrs["seeds"], _without_seed_and_run(str(file.attrs["effective_toml"]))
    return [folder for folder in (path / member_name(seed) for seed in seeds) if _holds(folder, job)]


def _holds(folder: Path, job: dict) -> bool:
    """Whether a folder has results of that job, or unreadable ones, which `Results` reports."""
    if not (folder / OBSERVABLES_FILE).is_file():
        return False
    with suppress(OSError, KeyError, ValueError), h5py.File(folder / OBSERVABLES_FILE, "r", locking=False) as file:
        return _without_seed_and_run(str(file.attrs["effective_toml"])) == job
    return True


def _without_seed_and_run(text: str) -> dict:
    """An effective job without what may differ between the seeds of an ensemble: `surface.seed` and [run]."""
    job = tomllib.loads(text)
    job["surface"].pop("seed", None)
    job.pop("run", None)
    return job


def solved_runs(runs: Iterable[Results]) -> np.ndarray:
    """How many of the runs have solved each load."""
    solved = [_solved(run) for run in runs]
    count = np.zeros(max(map(len, solved), default=0), int)
    for each in solved:
        count[: len(each)] += each
    return count


def _solved(run: Results) -> np.ndarray:
    return np.isfinite(run.loads["mean_pressure"])


def mean_loads(runs: list[Results]) -> dict[str, Column]:
    """The columns of the tables of loads."""
    longest = max(map(len, runs), default=0)
    found: dict[str, Column] = {}
    for run in runs:
        for name, values in run.loads.items():
            padded = np.full(longest, np.nan)
            padded[: len(values)] = values
            if name not in found:
                found[name] = Column({"units": run.columns[name].unit, "description": run.columns[name].description})
            found[name].add(padded)
    return found


def mean_groups(runs: Iterable[Results], index: int) -> dict[str, dict[str, Column]]:
    """The groups of curves of one load, as far as all runs that solved it have them, with equal axes."""
    found: dict[str, dict[str, Column]] = {}
    for number, run in enumerate(run for run in runs if index < len(run) and _solved(run)[index]):
        with h5py.File(run.directory / OBSERVABLES_FILE, "r", locking=False) as file:
            groups: Mapping = file.get(load_name(index), {})
            if number == 0:
                found = {title: {key: _column(group[key]) for key in group} for title, group in groups.items()}
            for title in list(found):
                values = {key: dataset[()] for key, dataset in groups[title].items()} if title in groups else {}
                if not _fits(found[title], values):
                    del found[title]
                    continue
                for key, column in found[title].items():
                    column.add(values[key])
        if not found:
            break  # of many small runs, opening their files takes longer than all else here
    return found


def _column(dataset: h5py.Dataset) -> Column:
    """An empty column for a dataset of several runs, of its shape, which `_fits` compares."""
    axes = tuple(next(iter(axis.keys())) for axis in dataset.dims if len(axis))
    about = {name: str(dataset.attrs[name]) for name in ("description", "units")}
    return Column(about, axes, dataset.is_scale, np.zeros(dataset.shape))


def _fits(group: Mapping[str, Column], values: Mapping[str, np.ndarray]) -> bool:
    """Whether the datasets of one more run have the shapes and axes of those before."""
    return group.keys() == values.keys() and all(
        values[key].shape == column._mean.shape
        and (not column.is_axis or not column._count.any() or np.array_equal(values[key], column._mean))
        for key, column in group.items()
    )


class _LoadsOnly(Results):
    """A result folder of which only the table of loads is read."""

    def __init__(self, directory: Path):
        self.directory = directory
        with h5py.File(directory / OBSERVABLES_FILE, "r", locking=False) as file:
            self.loads = read_columns(file[TABLE])


def write(directory: Path, provenance: Mapping[str, Any], failed: Mapping[int, str], status: str) -> None:
    """Write ensemble.h5 anew: provenance, seeds and, unless it is running, the means.  Raises OSError."""
    path = directory / ENSEMBLE_FILE

    def begin(file: h5py.File) -> None:
        file.attrs.update(provenance)
        file.attrs.update(status=status, failed=json.dumps(failed))

    def add_means(file: h5py.File) -> None:
        runs: list[Results] = [_LoadsOnly(folder) for folder in folders(directory)]
        _put(file.create_group(TABLE), mean_loads(runs))
        count = file[TABLE].create_dataset("seeds", data=solved_runs(runs))
        count.attrs.update(description=COUNT, units="1")
        for index in range(max(map(len, runs), default=0)):
            for title, group in mean_groups(runs, index).items():
                _put(file.create_group(f"{load_name(index)}/{title}"), group)

    revise(path, begin, anew=True)  # first, since `folders` asks this file for the seeds
    if status != "running":
        revise(path, add_means)


def _put(group: h5py.Group, found: Mapping[str, Column]) -> None:
    """Write columns with their errors into a group."""
    for key, column in found.items():
        for name, values in column.named(key, found):
            what = "" if name == key else "standard error over the seeds: "
            dataset = group.create_dataset(name, data=values)
            dataset.attrs.update(column.about | {"description": what + column.about["description"]})
    for key, column in found.items():
        for name, _ in column.named(key, found):
            name_axes(group, name, column.axes)


def table(ensemble: Ensemble) -> str:
    """The means of all numbers as aligned text, one row per load, with the number of seeds and standard errors.

    A mean over fewer seeds has their number behind it, "(n)".
    """
    means = mean_loads(ensemble.runs)
    means = {name: column for name, column in means.items() if not is_error(name, means)}
    if not means:
        return "no load was completed"
    units = {"seeds": ""} | {name: column.about["units"] for name, column in means.items()}
    values = {"seeds": solved_runs(ensemble.runs)} | {name: column.mean for name, column in means.items()}
    none = np.zeros(len(values["seeds"]), int)
    errors = {"seeds": none} | {name: column.error for name, column in means.items()}
    counts = {"seeds": none} | {name: fewer(column, values["seeds"]) for name, column in means.items()}
    return text_table(values, units, errors, counts)


def fewer(column: Column, seeds: np.ndarray) -> np.ndarray:
    """How many seeds gave a finite number, where these are fewer than have solved the load; else 0."""
    return np.where((column.count > 0) & (column.count < seeds), column.count, 0).astype(int)
