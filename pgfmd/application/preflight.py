"""Compares a job with the earlier results that it would continue, before anything is computed or touched."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from pgfmd.application.job import Job, differences, parse
from pgfmd.application.provenance import Origin
from pgfmd.application.restart import THIS_VERSION, EarlierResults
from pgfmd.errors import InputError
from pgfmd.options.text import printable


def refuse_changes(job: Job, origin: Origin, earlier: EarlierResults, directory: Path) -> None:
    """Raise InputError unless earlier results are of the same job, the same inputs and the same version; loads may have
    been added to the end of the list.
    """
    if earlier.job is None:
        return
    cannot = f"{directory}: cannot be continued"
    if earlier.version != THIS_VERSION:
        raise InputError(f"{cannot}: it was written by pgfmd {earlier.version}; this is {THIS_VERSION}")
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
