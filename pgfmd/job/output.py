"""The sections [run] and [output] of a job; [output] has a table of options for each observable.  No MPI here."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import ClassVar

from pgfmd.io.schema import FIELDS
from pgfmd.observables.contact_patches import ContactPatches
from pgfmd.observables.observable import Observable
from pgfmd.observables.table import OBSERVABLES
from pgfmd.options.rules import assignment, choice, many, number, text
from pgfmd.options.section import Section, key


@dataclass(frozen=True, kw_only=True)
class Run(Section):
    """Checkpoints and time limit of a run, for machines that stop long jobs; how its files are written.  Not compared
    by --restart: it does not change results.
    """

    where = "run"
    checkpoint_interval: float = key(
        number(low=0, infinite=True),
        1800.0,
        "between checkpoints of an unfinished load; 0: each step; inf: none",
        unit="s",
    )
    time_limit: float = key(
        number(above=0, infinite=True), math.inf, "of the run; it stops in time, to be restarted", unit="s"
    )
    io_hints: tuple[str, ...] = key(
        many(assignment()),
        (),
        "for MPI-IO, which ignores unknown ones; stripes are set on the folder (lfs setstripe)",
        example=["cb_nodes=8", "romio_cb_write=enable"],
    )


@dataclass(frozen=True, kw_only=True)
class Written(Section):
    """What is written.  Only what is listed is computed; options of observables that are not listed have no effect."""

    where = "output"
    shown: ClassVar[tuple[str, ...]] = ("fields", "observables")
    fields: tuple[str, ...] = key(
        many(choice(*FIELDS), distinct=True),
        (),
        "written for each load (height: once); none if left out",
        example=("height", "pressure", "gap"),
    )
    observables: tuple[str, ...] = key(
        many(choice(*OBSERVABLES), distinct=True),
        (),
        "measured for each load; none if left out",
        example=("histogram", "spectra"),
    )
    precision: str = key(choice("float64", "float32"), "float64", "of the fields in the files")
    length_unit: str = key(text(), "length", "label; heights from a file that has a unit are converted to it")
    pressure_unit: str = key(text(), "pressure", "label")

    @property
    def asked(self) -> list[Observable]:
        """The observables that are measured, with their options."""
        return [getattr(self, name) for name in self.observables]

    @property
    def connectivity(self) -> int:
        """Connectivity of the contact patches, in their table and in the field of labels."""
        patches: ContactPatches = getattr(self, ContactPatches.name)
        return patches.connectivity


# `Output` is `Written` with one more key for each observable: the table [output.NAME].
TABLES = [(name, kind, key(kind)) for name, kind in OBSERVABLES.items()]
NAMES = {"__doc__": Written.__doc__, "__module__": __name__}  # the module, so that a job can be sent to other ranks
Output = dataclasses.make_dataclass("Output", TABLES, bases=(Written,), namespace=NAMES, frozen=True, kw_only=True)
