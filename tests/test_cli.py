"""The command line: exit codes, one line on wrong input, from one rank, on one and on two ranks.

The run itself is replaced by a stand-in that writes known fields: what is tested is how a run is started and ended.
"""

import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from conftest import broad, python
from job_texts import SOLID

from pgfmd.application import cli
from pgfmd.application import job as config
from pgfmd.application.results import Results
from pgfmd.errors import InputError

JOB = SOLID + '[grid]\nn = [8, 6]\n[surface]\nkind = "sinusoid"\namplitude = 1.0\n[load]\npressure = [0.1, 0.2]\n'

STAND_IN = """
import sys, types
import numpy as np
from pgfmd.errors import InputError, SolverError
from pgfmd.application.machine import Origin
from pgfmd.application.files import Form
from pgfmd.application.writer import ResultWriter
from pgfmd.application.job import as_toml
from pgfmd.parallel.collectives import raise_together, slab

def simulate(job, comm, folder, overwrite=False, restart=False):
    rows = slab(job.grid.n[0], comm.size, comm.rank)
    mode = "overwrite" if overwrite else "restart" if restart else "new"
    layout = Form(job.grid.shape, job.grid.lengths, rows)
    with ResultWriter(comm, folder, Origin(job.text, as_toml(job), 2), layout, mode) as writer:
        FAULT
        if "height" in job.output.fields:
            writer.write_heights(np.zeros((rows.stop - rows.start, job.grid.n[1])))
        for index, pressure in enumerate(job.load.targets):
            local = np.full((rows.stop - rows.start, job.grid.n[1]), pressure)
            writer.write_load(index, {"mean_pressure": pressure}, None, {"pressure": local})
        writer.finish()

module = types.ModuleType("pgfmd.application.simulate")
module.run_job = simulate
sys.modules["pgfmd.application.simulate"] = module
from pgfmd.application import cli
from pgfmd.parallel import mpi
mpi.PATIENCE = 1.0
sys.exit(cli.main())
"""

FAULTS = {
    # what goes wrong inside a run → exit code, words on stderr
    "if comm.rank == comm.size - 1: raise ValueError('alone')\n        comm.Barrier()": (1, "pgfmd: error: alone\n"),
    "raise InputError('NaN in the heights\\nfile')": (2, "pgfmd: error: NaN in the heights file\n"),
    "with raise_together(comm):\n            if comm.rank == comm.size - 1: raise InputError('bad rows')": (
        2,
        "pgfmd: error: bad rows\n",
    ),
    "raise SolverError('no descent')": (3, "pgfmd: error: no descent\n"),
    "raise OSError(28, 'No space left on device')": (1, "No space left on device\n"),
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


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """The results of a run without a launcher, with heights and pressures; made once."""
    folder = tmp_path_factory.mktemp("finished")
    (folder / "job.toml").write_text(JOB)
    run = [sys.executable, stand_in(folder), "run", folder / "job.toml", "--output", folder / "out"]
    subprocess.run([*run, "--set", 'output.fields=["height", "pressure"]'], check=True, capture_output=True)
    return folder / "out"


@pytest.fixture
def results(finished, tmp_path) -> Path:
    """A copy of these results."""
    return Path(shutil.copytree(finished, tmp_path / "out"))


def alone(*arguments, code="sys.exit(main())", **environment) -> subprocess.CompletedProcess:
    """The command line in a process without MPI; or what `code` makes of its main()."""
    code = "import sys; sys.modules['mpi4py'] = None; from pgfmd.application.cli import main; " + code
    return python(code, *arguments, **environment)


def complaints(stderr: str) -> list[str]:
    """The lines of pgfmd itself, without what mpirun adds."""
    return [line for line in stderr.splitlines() if line.startswith("pgfmd: error:")]


def test_run_writes_its_folder(mpirun, tmp_path, job):
    """A run on two ranks ends with 0 and a complete folder, also into a path with spaces and accents."""
    folder = tmp_path / "résultats du jour"
    script = stand_in(tmp_path)
    done = mpirun(2, script, "run", job, "--output", folder, "--set", "load.pressure=[0.5, 0.25]")
    assert done.returncode == 0, done.stderr
    read = Results(folder)
    assert read.status == "complete" and read.provenance["ranks"] == 2 and read.provenance["job_toml"] == JOB
    np.testing.assert_array_equal(read.field("pressure", 1), np.full((8, 6), 0.25))


@pytest.mark.parametrize(
    ("arguments", "words"),
    broad([
        (["run", "none.toml", "--output", "OUT"], "none.toml: cannot be read"),
        (["run", "JOB", "--output", "OUT", "--set", "grid.m=3"], "--set: grid.m is not known"),
        (["run", "JOB", "--output", "OUT", "--set", "load.pressure=-1"], "load.pressure = "),
        (["run", "JOB", "--output", "JOB/out"], "cannot be written as an output folder"),
        (["run", "JOB", "--output", "FULL"], "holds results already"),
        (["run", "JOB"], "--output"),
        (["run", "JOB", "--output", ""], "--output: must name a folder"),
        (["run", "JOB", "--output", "OUT", "--overwrite", "--restart"], "not allowed with"),
    ]),
    ids=range(8),
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


@pytest.mark.parametrize("fault", broad(FAULTS), ids=range(len(FAULTS)))
def test_faults_inside_a_run_end_all_ranks(mpirun, tmp_path, job, fault):
    """Whatever fails, on all ranks or on one while the others wait, all end soon, with the reason and its code."""
    code, words = FAULTS[fault]
    done = mpirun(2, stand_in(tmp_path, fault), "run", job, "--output", tmp_path / "out", timeout=60)
    assert done.returncode == code
    assert words in done.stderr
    assert len(complaints(done.stderr)) == 1


def test_an_error_is_written_at_once(monkeypatch):
    """The line of an error is one write: of two, mpirun may put words of its own between them."""
    writes: list[str] = []
    monkeypatch.setattr(sys, "stderr", SimpleNamespace(write=writes.append, flush=lambda: None))
    assert cli._complain(InputError("bad\nrows")) == 2
    assert writes == ["pgfmd: error: bad rows\n"]


def test_check_and_info_need_no_mpi(finished, job):
    """`check` and `info` do not import mpi4py, and tell what matters."""
    for arguments, words in (
        (["check", job, "--ranks", "4"], ["valid", "8 × 6", "on a node of 4 ranks", "up to"]),
        (["info", finished], ["complete", "2 of 2 completed", "mean_pressure", "1 rank × "]),
    ):
        done = alone(*arguments)
        assert done.returncode == 0, done.stderr
        assert all(word in done.stdout for word in words)


@pytest.mark.parametrize(("arguments", "words"), [
    (["check", "JOB", "--set", "grid.n=0"], "grid.n = 0: must be a whole number"),
    (["check", "JOB", "--ranks", "9"], "more ranks than the 8 rows"),
    (["check", "JOB", "--ranks", "x"], "must be a whole number ≥ 1"),
    (["info", "nowhere"], "nowhere: not a result folder: no such folder"),
    (["jump"], "invalid choice"),
    ([], "required"),
], ids=range(6))  # fmt: skip
def test_wrong_input_of_check_and_info(capsys, job, arguments, words):
    """The same one line and exit code 2 without MPI."""
    assert cli.main([str(job) if word == "JOB" else word for word in arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    assert captured.err.startswith("pgfmd: error: ") and words in captured.err


@pytest.mark.parametrize("when", ["importing", "running"])
def test_interrupted_at_once(tmp_path, job, when):
    """Ctrl-C where nothing can be saved: one line, and 130."""
    fault = "pass"
    if when == "running":
        fault = "import os, signal; os.kill(os.getpid(), signal.SIGINT)"
    script = stand_in(tmp_path, fault)
    if when == "importing":
        script.write_text(script.read_text().replace(
            "sys.exit(cli.main())",
            "import builtins, os, signal\noriginal = builtins.__import__\n"
            "def interrupted(name, *rest):\n"
            "    if name == 'pgfmd.application.simulate': os.kill(os.getpid(), signal.SIGINT)\n"
            "    return original(name, *rest)\n"
            "builtins.__import__ = interrupted\nsys.exit(cli.main())",
        ))  # fmt: skip
    command = [sys.executable, script, "run", job, "--output", tmp_path / "out"]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == 130, done.stderr
    assert [line for line in done.stderr.splitlines() if not line[:2].isdigit()] == ["pgfmd: interrupted"]


def test_out_of_memory_is_one_line(tmp_path, job):
    """Not a traceback, and what to do."""
    script = stand_in(tmp_path, "raise MemoryError('Unable to allocate 26.8 GiB')")
    command = [sys.executable, script, "run", job, "--output", tmp_path / "out"]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert complaints(done.stderr)[0].startswith("pgfmd: error: the memory does not suffice; take more nodes")


def test_warnings_of_libraries_are_lines_of_the_log(mpirun, tmp_path, job):
    """Of rank 0 only, without lines of source."""
    script = stand_in(tmp_path, "import warnings; warnings.warn('look out', RuntimeWarning)")
    done = mpirun(2, script, "run", job, "--output", tmp_path / "out", timeout=120)
    assert done.returncode == 0, done.stderr
    assert [line[10:] for line in done.stderr.splitlines() if "look" in line] == ["RuntimeWarning: look out"]


def test_terminals_that_know_ascii_only(finished, job):
    """What they cannot show is shown as ?."""
    each = "print(main(['check', sys.argv[1]]), main(['info', sys.argv[2]]), main(['check', 'ä.toml']))"
    done = alone(job, finished, code=each, PYTHONIOENCODING="ascii")
    assert done.stdout.endswith("\n0 0 2\n") and done.stdout.count("8 ? 6") == 4  # twice each
    assert "Traceback" not in done.stderr and "?.toml: cannot be read" in done.stderr


def test_texts_from_files_do_not_reach_the_terminal_raw(results, capsys):
    """Escape sequences in a result file, as they may come from anybody, are shown as ?."""
    with h5py.File(results / "observables.h5", "r+") as file:
        file.attrs["command"] = "\x1b]0;owned\x07\x1b[2J\u202e\x9b31m"
    assert cli.main(["info", str(results)]) == 0
    assert "?]0;owned??[2J??31m" in capsys.readouterr().out


def test_verify(results, capsys):
    """`info --verify` reads every byte; a damaged file is named, with 2, and how to make it again."""
    arguments = ["info", "--verify", str(results)]
    assert cli.main(arguments) == 0 and "every byte" in capsys.readouterr().out
    path = results / "fields" / "load_0001.h5"
    data = bytearray(path.read_bytes())
    (at,) = [data.index(np.full(48, 0.2).tobytes())]
    data[at + 100] ^= 4
    path.write_bytes(data)
    assert cli.main(arguments) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "--restart" in said
    assert f"{path}: its bytes are not those" in said
    height = path.with_name("height.h5")
    for gone in (path, height):
        gone.unlink()
    assert cli.main(arguments) == 2
    said = capsys.readouterr().err
    assert f"{path}: it is missing" in said and f"{height}: it is missing" in said


def test_a_job_that_no_node_can_hold(tmp_path, capsys):
    """Refused in one line before anything is allocated; `check` says so, too."""
    path = tmp_path / "huge.toml"
    path.write_text(JOB.replace("[8, 6]", "[600000, 600000]"))
    done = subprocess.run(
        [sys.executable, "-m", "pgfmd", "run", path, "--output", tmp_path / "out"],
        check=False, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 2 and len(complaints(done.stderr)) == 1 and "TB of memory on" in done.stderr
    assert not (tmp_path / "out").exists()
    assert cli.main(["check", str(path)]) == 0
    said = capsys.readouterr().out
    assert "too large for this machine" in said and "valid\n" not in said


REACHED = [  # under [load]; exit code of check and of the run; what both say
    ("contact_area = [0.3]", 0, 0, ""),
    ("contact_area = [0.1, 0.3]", 0, 3, "contact_area = 0.1: not reachable, 0.25 touches first (shares of the cell)"),
    ("mean_gap = [0.1, -1.0]", 2, 2, "load.mean_gap = -1: must be above 0"),
    ("mean_gap = [5.0]", 0, 0, ""),
    ("displacement = [0.1, 100.0]", 2, 2, "load.displacement = 100: must be below 0.75"),
    ("displacement = [-1.0]", 0, 0, ""),
]


@pytest.mark.parametrize(("load", "checked", "run", "words"), REACHED, ids=range(len(REACHED)))
def test_check_tests_the_loads_as_a_run_does(tmp_path, capsys, load, checked, run, words):
    """On a plateau of a quarter of the cell `check` says of unreachable targets what the run will say, in its words."""
    np.save(tmp_path / "plateau.npy", np.kron([[1.0, 0.0], [0.0, 0.0]], np.ones((4, 4))))
    path = tmp_path / "job.toml"
    surface = '[surface]\nkind = "file"\npath = "plateau.npy"\n'
    path.write_text(f"[grid]\nn = 8\n{surface}[solid]\ncontact_modulus = 1.0\n[load]\n{load}\n")
    assert cli.main(["check", str(path)]) == checked
    assert words in "".join(capsys.readouterr())
    assert cli.main(["run", str(path), "--output", str(tmp_path / "out")]) == run
    assert words in capsys.readouterr().err


def test_check_says_what_it_does_not_test(tmp_path, capsys):
    """A surface of more points than it makes in a moment: that the targets are not tested is said."""
    path = tmp_path / "large.toml"
    path.write_text(JOB.replace("[8, 6]", "[4096, 2048]").replace("pressure =", "contact_area ="))
    assert cli.main(["check", str(path)]) == 0
    assert "can be reached is tested up to" in capsys.readouterr().out


def test_estimate_scales():
    """Ranks of one node share what one rank needs beside empty ranks, whose libraries count once.  A rank has its part
    and sees, of the strips (8 bytes per point), its rows of those of the other.  Files are counted byte for byte:
    fields × points × width × loads."""
    from pgfmd.application.estimate import BASE_BYTES, LIBRARY_BYTES, Plan

    job = config.parse(JOB, overrides=['output.fields=["height", "pressure"]', "output.precision=float32"])
    one, two = (Plan(job).estimate(ranks) for ranks in (1, 2))
    assert one.node == pytest.approx(one.memory, rel=1e-12)
    assert two.node - one.node == pytest.approx(BASE_BYTES - LIBRARY_BYTES, rel=1e-9)
    assert two.memory - BASE_BYTES >= (one.memory - BASE_BYTES) / 2 + 8 * 48 / 4 - 1e-6
    assert Plan(job).estimate(1).files == (1 + 2) * 48 * 4
