"""Elastic contact of randomly rough surfaces, solved in parallel.

`solve` (arrays in, contact out), `certify` (anybody's pressure), `register` (laws, solids, surfaces and observables of
your own), `run` (a job), `surface` (the heights of a job), `reference` (numbers of self-affine contacts to compare
with), and `Results` (the reader of result folders; `Runs`: of several; `Ensemble`: of a job with several seeds) are
imported when first used, so that `import pgfmd` needs no MPI.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from pgfmd.errors import InputError, SolverError

if TYPE_CHECKING:  # as editors and type checkers see them
    from pgfmd.api import certify, solve
    from pgfmd.application.ensemble import Ensemble
    from pgfmd.application.results import Results, Runs
    from pgfmd.application.simulate import run, surface
    from pgfmd.plugins import register
    from pgfmd.theory.reference_set import reference

__version__ = "0.1.0"
__all__ = ["Ensemble", "InputError", "Results", "Runs", "SolverError", "certify"]
__all__ += ["reference", "register", "run", "solve", "surface"]

_HOMES = {name: "pgfmd.api" for name in ("certify", "solve")}
_HOMES["reference"] = "pgfmd.theory.reference_set"
_HOMES["register"] = "pgfmd.plugins"
_HOMES |= {name: "pgfmd.application.simulate" for name in ("run", "surface")}
_HOMES |= {name: "pgfmd.application.results" for name in ("Results", "Runs")}
_HOMES["Ensemble"] = "pgfmd.application.ensemble"


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
