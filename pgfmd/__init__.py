"""Elastic contact of randomly rough surfaces, solved in parallel.

`solve` (arrays in, contact out), `surface` (the heights of a job) and `Results` (the reader of result folders) are
imported when first used, so that `import pgfmd` needs no MPI.  A whole job: `from pgfmd.simulate import simulate`.
"""

from __future__ import annotations

import importlib
from typing import Any

from pgfmd.errors import InputError, SolverError
from pgfmd.parallel.private_cache import keep_compiled_code

__version__ = "0.1.0"
__all__ = ["InputError", "Results", "SolverError", "solve", "surface"]

_HOMES = {"solve": "pgfmd.api", "surface": "pgfmd.api", "Results": "pgfmd.io.results"}

keep_compiled_code()


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
