"""What is checked before a run touches anything: a wrong job is refused in one line, and nothing has changed."""

from __future__ import annotations

import numpy as np
import pytest

from pgfmd.application.job import parse
from pgfmd.application.results import Results
from pgfmd.application.simulate import simulate
from pgfmd.errors import InputError

pytestmark = pytest.mark.mpi

JOB = """
[grid]
n = 16
[surface]
kind = "file"
path = "{path}"
[solid]
contact_modulus = 1
[load]
pressure = [0.01, 0.02, 0.03]
[output]
fields = ["height", "pressure"]
"""


def contents(folder) -> dict:
    """Every file below a folder, by its path."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("what", ["inputs", "job", "version"])
def test_only_the_same_run_is_continued(comm, shared_tmp_path, monkeypatch, what):
    """Other content in a file that the job names, another load, another version of the program: each is refused by
    --restart with what differs, on all ranks; the results stay byte for byte.
    """
    heights, folder = shared_tmp_path / "heights.npy", shared_tmp_path / "out"
    surface = np.cos(2 * np.pi * np.arange(16) / 16)[:, None] * np.ones(16)
    if comm.rank == 0:
        np.save(heights, surface)
    comm.Barrier()
    job = parse(JOB.format(path=heights))
    simulate(job, comm, folder)
    comm.Barrier()
    before = contents(folder)
    comm.Barrier()
    simulate(job, comm, folder, restart=True)  # the same: nothing to do
    comm.Barrier()
    assert {path.name for path in contents(folder)} == {path.name for path in before}
    before = contents(folder)
    comm.Barrier()
    words = {"inputs": f"content of {heights} has changed", "job": "load.pressure", "version": "by pgfmd 0"}[what]
    if what == "inputs" and comm.rank == 0:
        np.save(heights, 2 * surface)
    if what == "job":
        job = parse(JOB.format(path=heights).replace("0.03", "0.04"))
    if what == "version":
        monkeypatch.setattr("pgfmd.application.restart.THIS_VERSION", "9.9")
    comm.Barrier()
    with pytest.raises(InputError, match=words):
        simulate(job, comm, folder, restart=True)
    comm.Barrier()
    assert contents(folder) == before
    comm.Barrier()
    simulate(job, comm, folder, overwrite=True)
    comm.Barrier()
    assert np.ptp(Results(folder).field("height")) == pytest.approx(4 if what == "inputs" else 2)
