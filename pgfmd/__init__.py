"""Elastic contact of randomly rough surfaces, solved in parallel.

`solve` (arrays in, contact out), `simulate` (a whole job) and `Results` (the reader of result folders) are imported when
first used, so that `import pgfmd` needs no MPI.
"""

from __future__ import annotations

import importlib

from .errors import InputError, SolverError

__version__ = "0.1.0"
__all__ = ["InputError", "Results", "SolverError", "simulate", "solve"]

_HOMES = {"solve": "simulate", "simulate": "simulate", "Results": "results", "open": "results"}


def __getattr__(name: str):
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(f".{_HOMES[name]}", __name__)
    value = getattr(module, "Results" if name == "open" else name)
    globals()[name] = value  # `simulate` the function in place of the submodule that the import has just bound
    return value
