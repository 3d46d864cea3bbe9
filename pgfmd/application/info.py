"""What `pgfmd info` prints about result folders and ensembles: summaries, CSV, JSON, damage; and `pgfmd cite`."""

import csv
import io
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pgfmd import __version__
from pgfmd.application import ensemble, files
from pgfmd.application.ensemble import Ensemble
from pgfmd.application.results import Results, Runs, size_in_words, table
from pgfmd.observables.schema import LOADS
from pgfmd.options.text import assignments, counted, listed


def damage(results: Results) -> dict[Path, str]:
    """Each damaged file of the results, with its fault in words.  Reads all files.

    The heights, which are written before the first load, may be missing if no load was completed.
    """
    small = (results.directory / name for name in files.SMALL)
    needed = [results.field_file(files.load_name(index)) for index in range(len(results)) if results.fields(index)]
    if "height" in results.job["output"]["fields"] and len(results):
        needed.append(results.field_file("height"))
    needed += results.table_files()
    sums = files.read_sums(results.directory)
    if not sums:
        return {results.directory / files.SUMS_FILE: "it is missing, so that no file can be checked"}
    faults = {path: _fault(path, sums.get(str(path.relative_to(results.directory)))) for path in (*small, *needed)}
    if not results.fields() and not needed:
        faults = {path: fault for path, fault in faults.items() if path.exists()}  # a run without fields shows none
    return {path: fault for path, fault in faults.items() if fault is not None}


def _fault(path: Path, expected: str | None) -> str | None:
    """The fault of a file, None if it has none.  expected: its checksum; None: it holds those of its rows."""
    if not path.exists():
        return "it is missing"
    right = files.rows_are_right(path) if expected is None else files.sha256(path) == expected
    if right is None:
        return f"{files.SUMS_FILE} has no line for it: the run was killed while it wrote"
    return None if right else "its bytes are not those that were written"


def as_csv(results: Results | Runs) -> str:
    """The table of loads as CSV in full precision, with measured errors: a line of names, then one for each load.
    Tables of several runs are joined; their first column is the folder's name.
    """
    rows: list[dict[str, float | str]] = [{"load": load.index, **load.numbers} for load in results]
    if isinstance(results, Runs):
        rows = [{"run": load.results.directory.name, **row} for load, row in zip(results, rows, strict=True)]
    return comma_separated(list(dict.fromkeys(name for row in rows for name in row)) or ["load", *LOADS], rows)


def comma_separated(names: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """CSV text of these columns, nan where a row lacks one."""
    lines = io.StringIO()
    writer = csv.DictWriter(lines, names, restval="nan", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return lines.getvalue().rstrip("\n")


def known(value: Any) -> Any:
    """A value as JSON takes it: None for a number that is not finite, also inside tables and lists."""
    if isinstance(value, dict):
        return {name: known(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [known(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def as_json(results: Results) -> str:
    """Status, provenance, job and the rows of the table of loads; null for what was not measured or is not finite."""
    about = {
        "folder": str(results.directory),
        "status": results.status,
        "provenance": results.provenance,
        "job": results.job,
        "seconds": results.phases,
        "units": results.units,
        "loads": [load.numbers for load in results],
    }
    return json.dumps(known(about), ensure_ascii=False, indent=2)


def summary(results: Results) -> str:
    """Status, job, provenance and the table of loads as text."""
    about, asked, job = results.provenance, results.provenance.get("loads_requested", 0), results.job
    lines = {
        "folder": str(results.directory),
        "status": results.status + (f": {about['error']}" if results.status == "failed" else ""),
        "loads": f"{len(results)} of {asked} completed" if asked else f"{len(results)} completed",
        "grid": size_in_words(results.shape, results.lengths, job["output"]["length_unit"], job["grid"]),
        "solid": assignments(job["solid"]),
        "fields": ", ".join(results.fields() + (results.fields(-1) if len(results) else [])) or "none",
        **_origin(about),
        "finished": about.get("finished", "—"),
        "libraries": ", ".join(about["libraries"].split("\n")),
    }
    lines |= {f"{name} / s": f"{seconds:.3f}" for name, seconds in results.phases.items()}
    if len(results) and "stickiness" in results[0].numbers:
        lines["stickiness"] = f"{results[0].numbers['stickiness']:.3g} (Pastewka and Robbins: below 1 surfaces stick)"
    return "\n".join([listed(lines), "", table(results)])


def summary_of_ensemble(several: Ensemble) -> str:
    """Status, provenance and the means over the seeds as text."""
    complete = sum(run.status == "complete" for run in several.runs)
    lines = {
        "folder": str(several.directory),
        "status": several.status,
        "seeds": f"{complete} of {len(several.seeds)} complete; each has a result folder {files.member_name(1)}, …",
        **_origin(several.provenance),
    }
    lines |= {f"seed {seed}": f"failed: {message}" for seed, message in several.failed.items()}
    title = "mean over the seeds that solved the load ± standard error:"
    return "\n".join([listed(lines), "", title, ensemble.table(several)])


def _origin(about: Mapping[str, Any]) -> dict[str, str]:
    return {
        "version": f"pgfmd {about['softwareVersion']}, commit {about['commit']}",
        "command": about["command"],
        "started": f"{about['date']} on {about['host']}, {counted(about['ranks'], 'rank')} × "
        f"{counted(about['threads'], 'thread')}",
    }


def cited(job: Mapping[str, Any]) -> list[str]:
    """Keys of the BibTeX entries for the methods and observables of a job, given as nested tables."""
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
    """BibTeX entries: the version that ran, and the sources of the methods of its job."""
    about, entries = results.provenance, _entries()
    version = f"  version = {{{about.get('softwareVersion', __version__)}, commit {about.get('commit', 'unknown')}}},"
    entries["pgfmd"] = entries["pgfmd"].removesuffix("}") + version + "\n}"
    return "\n\n".join(entries[key] for key in cited(results.job))


def _entries() -> dict[str, str]:
    """The entries of references.bib by their keys."""
    text = Path(__file__).with_name("references.bib").read_text(encoding="utf-8")
    return {entry[1]: entry[0] for entry in re.finditer(r"^@\w+\{(\w+),.*?^\}", text, re.MULTILINE | re.DOTALL)}
