"""What a result folder holds already: what a run may continue or replace, and what it must leave alone."""

from __future__ import annotations

import io
import json
import logging
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import h5py

from pgfmd import __version__
from pgfmd.application import atomic, checksum
from pgfmd.application.files import (
    CHECKPOINT_FILE,
    FIELDS_FILE,
    FIELDS_FOLDER,
    FORMAT_VERSION,
    OBSERVABLES_FILE,
    VTK_FILE,
    load_name,
)
from pgfmd.errors import InputError

log = logging.getLogger("pgfmd")

FIELDS_FOLDERS = (FIELDS_FOLDER, f"{FIELDS_FOLDER}-2")  # results that replace others use the one that those do not
THIS_VERSION = f"{__version__}, format {FORMAT_VERSION}"
_FIELD_FILE = re.compile(r"(height|load_\d{4,})\.h5")


@dataclass
class EarlierResults:
    """Results that are to be continued.

    completed: number of loads up to the last one that is written; job: the effective job (None: there is nothing to
    continue); inputs: digests of the files that the job names; version: of the program and of the file format; fields:
    names of the fields of each load that is written; folder: where the files of fields are; damaged: names
    (`load_0002`, `height`) of files that are missing or damaged; state: the file that was read, observables.h5 or the
    version before it
    """

    completed: int = 0
    job: str | None = None
    inputs: dict[str, str] = field(default_factory=dict)
    version: str = ""
    fields: dict[str, list[str]] = field(default_factory=dict)
    folder: str = FIELDS_FOLDER
    damaged: set[str] = field(default_factory=set)
    state: Path | None = None

    @property
    def has_height(self) -> bool:
        """Whether the heights are there."""
        return self.job is not None and "height" not in self.damaged

    def links(self) -> dict[str, tuple[str, str]]:
        """What fields.h5 is to show: name → (file, dataset)."""
        found = {"height": ("height.h5", "height")} if self.has_height else {}
        for name, keys in self.fields.items():
            if name not in self.damaged:
                found |= {f"{name}/{key}": (f"{name}.h5", key) for key in keys}
        return found

    def settle(self) -> None:
        """If the version before was read, put it in the place of observables.h5."""
        if self.state is not None and self.state.name != OBSERVABLES_FILE:
            os.replace(self.state, self.state.with_name(OBSERVABLES_FILE))

    def find_damage(self, directory: Path) -> None:
        """Note files of fields that are missing, or whose length or seal is wrong; their numbers are not read."""
        for name, keys in ({"height": ["height"]} | self.fields).items():
            path = directory / self.folder / f"{name}.h5"
            there = path.exists()
            fault = checksum.read_seal(path)[1] if there else "it is missing"
            if keys and fault is not None:
                self.damaged.add(name)
                if there or name != "height":
                    log.warning("%s: %s; it will be made again", path, fault)


def read(directory: Path) -> EarlierResults:
    """The results in a folder, from observables.h5 or, if that is damaged, from the version before.

    Raises InputError if neither can be used.
    """
    path, reason = directory / OBSERVABLES_FILE, ""
    for state in (path, atomic.previous(path)):
        try:
            with h5py.File(io.BytesIO(checksum.unsealed(state.read_bytes())), "r") as file:
                names = [load_name(index) for index in range(len(file["loads/mean_pressure"]))]
                found = EarlierResults(
                    completed=len(names),
                    job=str(file.attrs["effective_toml"]),
                    inputs=json.loads(file.attrs.get("inputs", "{}")),
                    version=f"{file.attrs['softwareVersion']}, format {file.attrs['format_version']}",
                    fields={name: list(file[name].attrs["fields"]) for name in names if name in file},
                    folder=str(file.attrs.get("fields_folder", FIELDS_FOLDER)),
                    state=state,
                )
        except (OSError, KeyError) as error:
            reason = reason or str(error)
            continue
        if reason:
            log.warning("%s: %s; the version before it is used", path, reason)
        found.find_damage(directory)
        return found
    raise InputError(f"{path}: cannot be continued: {reason}; move it away, or choose another folder")


def other_folder(directory: Path) -> str:
    """The one of FIELDS_FOLDERS that the results in observables.h5 do not use; the second if that cannot be read."""
    try:
        content = checksum.unsealed((directory / OBSERVABLES_FILE).read_bytes(), strict=False)
        with h5py.File(io.BytesIO(content), "r") as file:
            used = str(file.attrs.get("fields_folder", FIELDS_FOLDER))
    except OSError:
        used = FIELDS_FOLDER
    return next(folder for folder in FIELDS_FOLDERS if folder != used)


def is_own(path: Path) -> bool:
    """Whether this program wrote a file: it is sealed or, if it was cut short, its beginning names the program."""
    if checksum.is_sealed(path):
        return True
    try:
        with open(path, "rb") as file:
            start = file.read(2**16)
    except OSError:
        return False
    return start.startswith(b"\x89HDF") and b"software" in start and b"pgfmd" in start


def own_field_files(folder: Path) -> Iterator[Path]:
    """Files of fields, finished or not, that this program wrote into a folder."""
    yield from folder.glob(".*.h5.tmp")
    yield from (path for path in folder.glob("*.h5") if _FIELD_FILE.fullmatch(path.name) and is_own(path))


def refuse_foreign(directory: Path, folder: str) -> None:
    """Raise InputError if a file that the run would write (fields in `folder`) exists and is not this program's."""
    fields = (path for path in (directory / folder).glob("*.h5") if _FIELD_FILE.fullmatch(path.name))
    files = (OBSERVABLES_FILE, FIELDS_FILE, VTK_FILE, CHECKPOINT_FILE)
    for path in (*(directory / name for name in files), *fields):
        if os.path.lexists(path) and not is_own(path) and not is_own(atomic.previous(path)):
            raise InputError(f"{path}: was not written by pgfmd, which would replace it; move it away, or choose "
                             "another folder")  # fmt: skip
