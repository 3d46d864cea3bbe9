"""The command line: exit codes, one line on wrong input, from one rank, on one and on two ranks.

The run itself is replaced by a stand-in that writes known fields: what is tested is how a run is started and ended.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pgfmd import cli
from pgfmd.io.results import Results
from pgfmd.job import job as config

JOB = '[grid]\nn = [8, 6]\n[surface]\nkind = "sinusoid"\namplitude = 1.0\n[load]\npressure = [0.1, 0.2]\n'

STAND_IN = """
import sys, types
import numpy as np
from pgfmd.errors import InputError, SolverError
from pgfmd.io.provenance import Origin
from pgfmd.io.writer import Form, ResultWriter
from pgfmd.job.job import as_toml
from pgfmd.parallel.collectives import raise_together, slab

def simulate(job, comm, folder, overwrite=False, restart=False):
    rows = slab(job.grid.n[0], comm.size, comm.rank)
    mode = "overwrite" if overwrite else "restart" if restart else "new"
    layout = Form(job.grid.shape, job.grid.lengths, rows)
    with ResultWriter(comm, folder, Origin(job.text, as_toml(job), 2), layout, mode) as writer:
        FAULT
        for index, pressure in enumerate(job.load.targets):
            local = np.full((rows.stop - rows.start, job.grid.n[1]), pressure)
            writer.write_load(index, {"mean_pressure": pressure}, None, {"pressure": local})
        writer.finish()

module = types.ModuleType("pgfmd.simulate")
module.simulate = simulate
sys.modules["pgfmd.simulate"] = module
from pgfmd import cli
cli.PATIENCE = 1.0
sys.exit(cli.main())
"""

FAULTS = {
    # what goes wrong inside a run → exit code, words on stderr
    "raise InputError('NaN in the heights\\nfile')": (2, "pgfmd: error: NaN in the heights file\n"),
    "with raise_together(comm):\n            if comm.rank == comm.size - 1: raise InputError('bad rows')": (
        2,
        "pgfmd: error: bad rows\n",
    ),
    "raise SolverError('no descent')": (3, "pgfmd: error: no descent\n"),
    "raise OSError(28, 'No space left on device')": (1, "No space left on device\n"),
    "if comm.rank == comm.size - 1: raise ValueError('alone')\n        comm.Barrier()": (1, "pgfmd: error: alone\n"),
}


@pytest.fixture
def job(tmp_path) -> Path:
    """A valid job file."""
    path = tmp_path / "a job.toml"
    path.write_text(JOB)
    return path


def stand_in(tmp_path: Path, fault: str = "pass") -> Path:
    """A script that is `python -m pgfmd` with the run replaced."""
    path = tmp_path / "stand_in.py"
    path.write_text(STAND_IN.replace("FAULT", fault))
    return path


def complaints(stderr: str) -> list[str]:
    """The lines of pgfmd itself, without what mpirun adds."""
    return [line for line in stderr.splitlines() if line.startswith("pgfmd: error:")]


@pytest.mark.parametrize("ranks", [1, 2])
def test_run_writes_its_folder(mpirun, tmp_path, job, ranks):
    """A run on one and two ranks ends with 0 and a complete folder, also into a path with spaces and accents."""
    folder = tmp_path / "résultats du jour"
    script = stand_in(tmp_path)
    done = mpirun(ranks, script, "run", job, "--output", folder, "--set", "load.pressure=[0.5, 0.25]")
    assert done.returncode == 0, done.stderr
    read = Results(folder)
    assert read.status == "complete" and read.provenance["ranks"] == ranks and read.provenance["job_toml"] == JOB
    np.testing.assert_array_equal(read.field("pressure", 1), np.full((8, 6), 0.25))


def test_run_without_mpirun(tmp_path, job):
    """Without a launcher it is one rank."""
    command = [sys.executable, stand_in(tmp_path), "run", job, "--output", tmp_path / "out"]
    assert subprocess.run(command, check=False, capture_output=True).returncode == 0
    assert len(Results(tmp_path / "out")) == 2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "none.toml", "--output", "OUT"], "none.toml: cannot be read"),
        (["run", "JOB", "--output", "OUT", "--set", "grid.m=3"], "--set: grid.m is not known"),
        (["run", "JOB", "--output", "OUT", "--set", "load.pressure=-1"], "load.pressure = -1: must be"),
        (["run", "JOB", "--output", "JOB/out"], "cannot be written as an output folder"),
        (["run", "JOB", "--output", "FULL"], "holds results already"),
        (["run", "JOB"], "--output"),
        (["run", "JOB", "--output", "OUT", "--overwrite", "--restart"], "not allowed with"),
    ],
    ids=range(7),
)
def test_wrong_input_on_two_ranks(mpirun, tmp_path, job, arguments, words):
    """Wrong input: exit code 2, one line from one rank, nothing written, no hang."""
    full = tmp_path / "full"
    full.mkdir()
    (full / "observables.h5").write_text("old")
    places = {"JOB": str(job), "OUT": str(tmp_path / "out"), "FULL": str(full), "JOB/out": str(job / "out")}
    script = stand_in(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    done = mpirun(2, script, *(places.get(word, word) for word in arguments), timeout=60)
    assert done.returncode == 2
    assert len(complaints(done.stderr)) == 1
    assert words in complaints(done.stderr)[0] and "Traceback" not in done.stderr
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("fault", FAULTS, ids=range(len(FAULTS)))
def test_faults_inside_a_run_end_all_ranks(mpirun, tmp_path, job, fault):
    """Whatever fails, on all ranks or on one while the others wait, all end soon, with the reason and its code."""
    code, words = FAULTS[fault]
    done = mpirun(2, stand_in(tmp_path, fault), "run", job, "--output", tmp_path / "out", timeout=60)
    assert done.returncode == code
    assert words in done.stderr
    assert len(complaints(done.stderr)) == 1


def test_check_and_info_need_no_mpi(tmp_path, job):
    """`check` and `info` do not import mpi4py, and tell what matters."""
    subprocess.run([sys.executable, stand_in(tmp_path), "run", job, "--output", tmp_path / "out"], check=True)
    code = "import sys; sys.modules['mpi4py'] = None; from pgfmd.cli import main; sys.exit(main())"
    for arguments, words in (
        (["check", job, "--ranks", "4"], ["valid", "8 × 6", "per rank on 4 ranks"]),
        (["info", tmp_path / "out"], ["complete", "2 of 2 completed", "mean_pressure", "1 ranks"]),
    ):
        done = subprocess.run([sys.executable, "-c", code, *arguments], check=False, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert all(word in done.stdout for word in words)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["check", "JOB", "--set", "grid.n=0"], "grid.n = 0: must be a whole number"),
        (["check", "JOB", "--ranks", "9"], "more ranks than the 8 rows"),
        (["check", "JOB", "--ranks", "x"], "must be a whole number ≥ 1"),
        (["info", "nowhere"], "nowhere: not a result folder: no such folder"),
        (["jump"], "invalid choice"),
        ([], "required"),
    ],
    ids=range(6),
)
def test_wrong_input_of_check_and_info(capsys, job, arguments, words):
    """The same one line and exit code 2 without MPI."""
    assert cli.main([str(job) if word == "JOB" else word for word in arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    assert captured.err.startswith("pgfmd: error: ") and words in captured.err


def test_estimate_scales():
    """Memory is split over the ranks, files are counted byte for byte: fields × points × width × loads."""
    from pgfmd.run.estimate import PER_RANK, estimate

    job = config.parse(JOB, overrides=['output.fields=["height", "pressure"]', "output.precision=float32"])
    assert estimate(job, 2).memory - PER_RANK == pytest.approx((estimate(job, 1).memory - PER_RANK) / 2, rel=1e-9)
    assert estimate(job, 1).files == (1 + 2) * 48 * 4
