"""Ensembles: a folder of runs that differ by the seed of their surface alone, and means over them.  No MPI here.

    seed_0001/, seed_0002/, …   a result folder for each seed
    ensemble.h5                 provenance, the seeds, and for each load mean and standard error over the seeds
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

from pgfmd.application.files import ENSEMBLE_FILE, OBSERVABLES_FILE, create, holder, load_name, member_name, revise
from pgfmd.application.results import Results, Runs, text_table, with_bar
from pgfmd.application.tables import name_axes
from pgfmd.errors import InputError
from pgfmd.observables.schema import TABLE, is_error

if TYPE_CHECKING:
    import pandas

COUNT = "number of seeds whose load was solved"


class Ensemble(Runs):
    """The folder of an ensemble, complete or not.

    seeds: as the job lists them; runs: of the seeds that have begun; failed: seed → error message; provenance: of the
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
        self.directory, path = Path(directory), Path(directory) / ENSEMBLE_FILE
        try:
            with h5py.File(path, "r", locking=False) as file:
                self.provenance: dict[str, Any] = dict(file.attrs)
        except OSError as error:
            reason = error if path.exists() else f"there is no {path}"
            raise InputError(f"{self.directory}: not the folder of an ensemble: {reason}") from None
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
        """A row for each load.  seeds: how many solved it; NAME, NAME_error: mean and standard error of a number;
        NAME_seeds: how many gave a finite one, if fewer.
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
        return {
            title: {name: values for key, column in group.items() for name, values in column.named(key, group)}
            for title, group in mean_groups(self.runs, index).items()
        }


@dataclass
class Column:
    """One dataset of several runs: mean and standard error, entry by entry, over the runs in which it is finite.

    about: description and units; axes: names of the datasets that hold its coordinates; is_axis: it holds coordinates,
    which are the same in all runs; values: one array of equal shape per run.
    """

    about: dict[str, str] = field(default_factory=dict)
    axes: tuple[str, ...] = ()
    is_axis: bool = False
    values: list[np.ndarray] = field(default_factory=list)

    def add(self, values: np.ndarray) -> None:
        """Add the values of one more run."""
        self.values.append(np.asarray(values, np.float64))

    def fits(self, values: np.ndarray) -> bool:
        """Whether the values of one more run have the shape of the others; for an axis, whether they are equal."""
        first = self.values[0] if self.values else values
        return np.array_equal(first, values) if self.is_axis else first.shape == values.shape

    @property
    def count(self) -> np.ndarray:
        """Number of runs with a finite value."""
        return np.isfinite(self.values).sum(axis=0)

    @property
    def mean(self) -> np.ndarray:
        """The mean; NaN where no run has a finite value."""
        return self.values[0] if self.is_axis else np.ma.filled(np.ma.masked_invalid(self.values).mean(axis=0), np.nan)

    @property
    def error(self) -> np.ndarray:
        """Standard error of the mean, √(Σ(x − x̄)²/(n(n − 1))); NaN for fewer than two runs."""
        known = np.ma.masked_invalid(self.values)
        return np.ma.filled(known.std(axis=0, ddof=1) / np.sqrt(known.count(axis=0)), np.nan)

    def named(self, name: str, group: Mapping[str, Column]) -> Iterable[tuple[str, np.ndarray]]:
        """The mean as NAME; unless an axis, the error as NAME_error (NAME_seed_error if the group has a NAME_error)."""
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
    """Whether a folder has results of that job, or unreadable ones: `Results` then raises the error."""
    path = folder / OBSERVABLES_FILE
    with suppress(OSError, KeyError, ValueError), h5py.File(path, "r", locking=False) as file:
        return _without_seed_and_run(str(file.attrs["effective_toml"])) == job
    return path.is_file()


def _without_seed_and_run(text: str) -> dict:
    """An effective job without what may differ between the seeds of an ensemble: `surface.seed` and [run]."""
    job = tomllib.loads(text)
    job["surface"].pop("seed", None)
    job.pop("run", None)
    return job


def solved_runs(runs: Iterable[Results]) -> np.ndarray:
    """How many of the runs have solved each load."""
    columns = mean_loads(runs)
    return columns["mean_pressure"].count if columns else np.zeros(0, int)


def mean_loads(runs: Iterable[Results]) -> dict[str, Column]:
    """The columns of the tables of loads of all runs; NaN for loads that a run has not completed."""
    runs = list(runs)
    longest = max(map(len, runs), default=0)
    columns: dict[str, Column] = {}
    for run in runs:
        for name, values in run.loads.items():
            if name not in columns:
                columns[name] = Column({"units": run.columns[name].unit, "description": run.columns[name].description})
            columns[name].add(np.pad(np.asarray(values, float), (0, longest - len(values)), constant_values=np.nan))
    return columns


def mean_groups(runs: Iterable[Results], index: int) -> dict[str, dict[str, Column]]:
    """The groups of curves of one load that all runs which solved it have, with equal axes."""
    groups: dict[str, dict[str, Column]] | None = None
    for run in runs:
        if index >= len(run) or not np.isfinite(run.loads["mean_pressure"][index]):
            continue
        with h5py.File(run.directory / OBSERVABLES_FILE, "r", locking=False) as file:
            here: Mapping = file.get(load_name(index), {})
            if groups is None:
                groups = {}
                for title in here:
                    with run.group(here, title) as group:
                        groups[title] = {key: _column(group[key]) for key in group}
            for title, columns in list(groups.items()):
                values = {}
                if title in here:
                    with run.group(here, title) as group:
                        values = {key: dataset[()] for key, dataset in group.items()}
                if columns.keys() == values.keys() and all(columns[key].fits(values[key]) for key in columns):
                    for key, column in columns.items():
                        column.add(values[key])
                else:
                    del groups[title]
        if not groups:
            break  # with many small runs, opening their files takes most of the time
    return groups or {}


def _column(dataset: h5py.Dataset) -> Column:
    """A column for a dataset of several runs, without values."""
    axes = tuple(next(iter(axis.keys())) for axis in dataset.dims if len(axis))
    about = {name: str(dataset.attrs[name]) for name in ("description", "units")}
    return Column(about, axes, dataset.is_scale)


def write(directory: Path, provenance: Mapping[str, Any], failed: Mapping[int, str], status: str) -> None:
    """Replace ensemble.h5: provenance, seeds and, unless the status is "running", the means.  Raises OSError."""
    path = directory / ENSEMBLE_FILE

    def begin(file: h5py.File) -> None:
        file.attrs.update(provenance)
        file.attrs.update(status=status, failed=json.dumps(failed))

    def add_means(file: h5py.File) -> None:
        runs = [Results(folder) for folder in folders(directory)]
        _put(file.create_group(TABLE), mean_loads(runs))
        count = file[TABLE].create_dataset("seeds", data=solved_runs(runs))
        count.attrs.update(description=COUNT, units="1")
        for index in range(max(map(len, runs), default=0)):
            for title, group in mean_groups(runs, index).items():
                _put(file.create_group(f"{load_name(index)}/{title}"), group)

    create(path, begin)  # first: `folders` reads the seeds from this file
    if status != "running":
        revise(path, add_means)


def _put(group: h5py.Group, columns: Mapping[str, Column]) -> None:
    """Write columns with their errors into a group."""
    written = [(key, name, values) for key, column in columns.items() for name, values in column.named(key, columns)]
    for key, name, values in written:
        about = columns[key].about
        what = "" if name == key else "standard error over the seeds: "
        group.create_dataset(name, data=values).attrs.update(about | {"description": what + about["description"]})
    for key, name, _ in written:  # the datasets of all axes are there now
        name_axes(group, name, columns[key].axes)


def table(ensemble: Ensemble) -> str:
    """Means with errors and number of seeds as text, one row per load; "(n)" follows a mean over n, fewer seeds."""
    means, seeds = mean_loads(ensemble.runs), solved_runs(ensemble.runs)
    means = {name: column for name, column in means.items() if not is_error(name, means)}
    if not means:
        return "no load was completed"
    units = {"seeds": ""} | {name: column.about["units"] for name, column in means.items()}
    columns = {"seeds": [str(count) for count in seeds]}
    for name, column in means.items():
        cells, counts = map(with_bar, column.mean, column.error), fewer(column, seeds)
        columns[name] = [cell + f" ({count})" * bool(count) for cell, count in zip(cells, counts, strict=True)]
    return text_table(columns, units)


def fewer(column: Column, seeds: np.ndarray) -> np.ndarray:
    """The number of seeds with a finite number where it is less than that of seeds which solved the load; else 0."""
    return np.where(column.count < seeds, column.count, 0)
