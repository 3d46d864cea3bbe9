"""Results that a folder holds already: which of them a run continues, replaces, or must leave alone."""

import dataclasses
import json
import logging
import os
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import h5py

from pgfmd import __version__
from pgfmd.application import files, tables
from pgfmd.application.job import Job, differences, parse
from pgfmd.application.machine import Origin
from pgfmd.errors import InputError
from pgfmd.observables.observable_kinds import OBSERVABLES, layout_of
from pgfmd.options.text import printable

log = logging.getLogger("pgfmd")

FIELDS_FOLDERS = (files.FIELDS_FOLDER, f"{files.FIELDS_FOLDER}-2")  # of results, and of those that replace them
THIS_VERSION = f"{__version__}, format {files.FORMAT_VERSION}"
_FIELD_FILE = re.compile(r"(?:height|load_\d{4,}(?:_(\w+))?|checkpoint)\.h5")


@dataclass
class EarlierResults:
    """Results that are to be continued, if there are any.

    completed: number of loads up to the last one that is written; job: the effective job (None: there is nothing to
    continue); inputs: path → digest of each file that the job names; version: of the program and of the file format;
    fields: load → names of its fields; table_files: load → paths of its groups that have a file; folder: of all these
    files, and of those that this run writes; damaged: names of loads with a missing or damaged file (`load_0002`), and
    `height`.
    """

    completed: int = 0
    job: str | None = None
    inputs: dict[str, str] = field(default_factory=dict)
    version: str = ""
    fields: dict[str, list[str]] = field(default_factory=dict)
    table_files: dict[str, list[str]] = field(default_factory=dict)
    folder: str = files.FIELDS_FOLDER
    damaged: set[str] = field(default_factory=set)

    @property
    def has_height(self) -> bool:
        """Whether the heights are there."""
        return self.job is not None and "height" not in self.damaged

    def links(self) -> dict[str, tuple[str, str]]:
        """The undamaged fields, which fields.h5 is to show: name → (file, dataset)."""
        shown = {"height": ("height.h5", "height")} if self.has_height else {}
        for name, keys in self.fields.items():
            if name not in self.damaged:
                shown |= {f"{name}/{key}": (f"{name}.h5", key) for key in keys}
        return shown

    def find_damage(self, directory: Path) -> None:
        """Find files of fields and groups that are missing, truncated, or have damaged metadata; reads no numbers."""
        fields = [(name, directory / self.folder / f"{name}.h5", keys) for name, keys in self.fields.items() if keys]
        groups: list[tuple[str, Path, list[str]]] = [
            (name, directory / path, []) for name, paths in self.table_files.items() for path in paths
        ]
        for name, path, keys in (("height", directory / self.folder / "height.h5", ["height"]), *fields, *groups):
            there = path.exists()
            fault = _fault(path, keys) if there else "it is missing"
            if fault is not None:
                self.damaged.add(name)
                if there or name != "height":
                    log.warning("%s: %s; it will be made again", path, fault)


def _fault(path: Path, keys: list[str]) -> str | None:
    """The fault of a file with those fields, or of all its datasets, as HDF5 reports it; None if it has none."""
    try:
        with h5py.File(path, "r", locking=False) as file:
            for dataset in (file[key] for key in keys or file):
                dataset[: 0 if dataset.shape else None]
    except Exception as error:  # whatever HDF5 makes of a damaged file
        return f"it is damaged ({error})"
    return None


def read(directory: Path) -> EarlierResults:
    """The results in a folder.  Raises InputError if observables.h5 is damaged, or of another program or version."""
    path = directory / files.OBSERVABLES_FILE
    try:
        if files.read_sums(directory).get(files.OBSERVABLES_FILE, digest := files.sha256(path)) != digest:
            raise OSError("its bytes are not those that were written")
        with h5py.File(path, "r", locking=False) as file:
            names = [files.load_name(index) for index in range(len(file["loads/mean_pressure"]))]
            earlier = EarlierResults(
                completed=len(names),
                job=str(file.attrs["effective_toml"]),
                inputs=json.loads(file.attrs.get("inputs", "{}")),
                version=f"{file.attrs['softwareVersion']}, format {file.attrs['format_version']}",
                fields={name: list(file[name].attrs["fields"]) for name in names if name in file},
                table_files={name: list(tables.linked(file[name]).values()) for name in names if name in file},
                folder=str(file.attrs.get("fields_folder", files.FIELDS_FOLDER)),
            )
    except (OSError, KeyError, RuntimeError, ValueError) as error:
        raise InputError(f"{path}: cannot be continued: {error}; move it away, or choose another folder") from None
    if earlier.version != THIS_VERSION:
        written = f"it was written by pgfmd {earlier.version}; this is {THIS_VERSION}"
        raise InputError(f"{directory}: cannot be continued: {written}")
    earlier.find_damage(directory)
    return earlier


def other_folder(directory: Path) -> str:
    """The one of FIELDS_FOLDERS that the results in observables.h5 do not use; the second if that cannot be read."""
    path, used = directory / files.OBSERVABLES_FILE, files.FIELDS_FOLDER
    with suppress(OSError, KeyError, RuntimeError), h5py.File(path, "r", locking=False) as file:
        used = str(file.attrs.get("fields_folder", used))
    return next(folder for folder in FIELDS_FOLDERS if folder != used)


def is_own(path: Path) -> bool:
    """Whether this program wrote a file: its attributes name the program or, if it is truncated, its beginning does."""
    with suppress(Exception), h5py.File(path, "r", locking=False) as file:  # whatever HDF5 makes of a damaged file
        return str(file.attrs.get("software")) == "pgfmd"
    with suppress(OSError), open(path, "rb") as cut:
        start = cut.read(2**16)
        return start.startswith(b"\x89HDF") and b"software" in start and b"pgfmd" in start
    return False


def _field_files(folder: Path) -> Iterator[Path]:
    """Files in the folder of fields with names that runs give."""
    titles = layout_of(OBSERVABLES.values())
    for path in folder.glob("*.h5"):
        if (found := _FIELD_FILE.fullmatch(path.name)) and (found[1] is None or found[1] in titles):
            yield path


def own_field_files(folder: Path) -> Iterator[Path]:
    """Files of fields, large groups and checkpoints, finished or not, that this program wrote into a folder."""
    yield from folder.glob(".*.h5.tmp")
    yield from filter(is_own, _field_files(folder))


def refuse_foreign(directory: Path, folder: str) -> None:
    """Raise InputError if a file that the run would write (fields in `folder`) exists and is not this program's."""
    small = (directory / name for name in files.SMALL)
    for path in (*small, *_field_files(directory / folder)):
        if os.path.lexists(path) and not is_own(path):
            raise InputError(f"{path}: was not written by pgfmd, which would replace it; move it away, or choose "
                             "another folder")  # fmt: skip


def refuse_changes(job: Job, origin: Origin, earlier: EarlierResults, directory: Path) -> None:
    """Raise InputError unless earlier results are of the same job and inputs; new loads may follow the old ones."""
    if earlier.job is None:
        return
    cannot = f"{directory}: cannot be continued"
    before = parse(earlier.job, "results")
    if before.load.control == job.load.control and before.load.targets == job.load.targets[: len(before.load.targets)]:
        before = dataclasses.replace(before, load=before.load.imposing(job.load.targets))
    changed = differences(before, job)
    if changed:
        raise InputError(f"{cannot}, the job differs: {'; '.join(changed)}")
    other = [path for path, digest in origin.inputs.items() if earlier.inputs.get(path, digest) != digest]
    if other:
        names = ", ".join(printable(path, 400) for path in other)
        raise InputError(f"{cannot}: the content of {names} has changed since")
