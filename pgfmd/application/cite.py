"""`pgfmd cite`: what to cite for a run, as BibTeX.  No MPI here."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pgfmd import __version__
from pgfmd.application.results import Results


def cited(job: Mapping[str, Any]) -> list[str]:
    """Keys of the entries for the methods and observables of a job, given as nested tables."""
    observables = job["output"].get("observables", [])
    method, wall = job["solver"].get("method", "auto"), job.get("wall", {}).get("kind", "hard")
    used = {
        "pgfmd": True,
        "Campana2008": job["surface"]["kind"] == "self-affine",
        "Campana2006": method == "gfmd",
        "Polonsky1999": method in ("auto", "active-set") and wall in ("hard", "hardness"),
        "Persson2001": "histogram" in observables,
        "Barber2003": "stiffness" in observables,
        "Patir1978": "leakage" in observables,
        "Ciavarella1998": "partial_slip" in observables,
    }
    return [key for key, needed in used.items() if needed]


def bibtex(results: Results) -> str:
    """BibTeX of the version that ran, and of the sources of what its job used."""
    about, entries = results.provenance, _entries()
    version = f"  version = {{{about.get('softwareVersion', __version__)}, commit {about.get('commit', 'unknown')}}},"
    entries["pgfmd"] = entries["pgfmd"].removesuffix("}") + version + "\n}"
    return "\n\n".join(entries[key] for key in cited(results.job))


def _entries() -> dict[str, str]:
    """The entries of references.bib by their keys."""
    text = Path(__file__).with_name("references.bib").read_text(encoding="utf-8")
    return {entry[1]: entry[0] for entry in re.finditer(r"^@\w+\{(\w+),.*?^\}", text, re.MULTILINE | re.DOTALL)}
