"""The options of the solvers: the table [solver] of a job.  No MPI here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from pgfmd.errors import InputError
from pgfmd.grid.cell import TRANSFORMS
from pgfmd.options.rules import choice, integer, number
from pgfmd.options.section import Section, key, wrong
from pgfmd.options.text import show
from pgfmd.physics.laws.law import ContactLaw
from pgfmd.physics.laws.table import LAWS

METHODS = tuple(dict.fromkeys(method for law in LAWS.choices for method in law.methods))


@dataclass(frozen=True, kw_only=True)
class Solver(Section):
    """How the contact is found, and how well.

    method "auto" takes the fastest method for the contact law, and dynamics ("gfmd") should that fail.
    """

    where: ClassVar[str] = "solver"
    method: str = key(choice("auto", *METHODS), "auto")
    tolerance: float = key(
        number(above=0, below=1), 1e-6, "certified error of the energy over 2 E_el at which it stops"
    )
    max_iterations: int | None = key(integer(1), about='time steps of "gfmd", 10000 if not given; others need no limit')
    transform: str = key(
        choice(*TRANSFORMS), "blocked", "who transforms: blocks that stay in cache, or the library mpi4py-fft"
    )

    def check(self) -> None:
        """Only dynamics count their steps."""
        if self.max_iterations is not None and self.method != "gfmd":
            raise wrong(self, "max_iterations", 'belongs to method = "gfmd" only; the others stop by themselves')

    def check_law(self, law: ContactLaw) -> None:
        """Raises InputError for a method that cannot take that law."""
        if self.method not in ("auto", *law.methods):
            allowed = ", ".join(("auto", *law.methods))
            kind = show(law.kind)
            raise InputError(f"solver.method = {show(self.method)}: must be one of {allowed} for wall.kind = {kind}")
