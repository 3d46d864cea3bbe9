"""The package as pip installs it: what a wheel holds, and a fresh environment without root, compiler or system MPI."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import ROOT, SIZE
from job_texts import rough_job

from pgfmd.application.results import Results

pytestmark = pytest.mark.skipif(SIZE > 1, reason="one process is what matters")

NO_NETWORK = ("No matching distribution", "Temporary failure in name resolution", "connection", "Connection")
JOB = rough_job([48, 50], load={"pressure": [0.02]}, output={"fields": ["height", "pressure", "gap"]})
SOLVE = """
import sys
import numpy as np, pgfmd
assert pgfmd.__file__.startswith(sys.prefix), pgfmd.__file__
x = 2 * np.pi / 32 * np.arange(32)
contact = pgfmd.solve(np.cos(x[:, None]) * np.cos(x), 0.1)
assert contact.certified_error < 1e-8 and "mpi4py.MPI" not in sys.modules
"""


def call(*command: object, folder: Path, **environment: str) -> subprocess.CompletedProcess:
    """A command in that folder, without PYTHONPATH, which would show it this checkout."""
    shown = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | environment
    words = [str(word) for word in command]
    return subprocess.run(words, cwd=folder, env=shown, capture_output=True, text=True, timeout=900, check=False)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel that pip makes of a copy of this checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    unwanted = shutil.ignore_patterns(".*", "*.egg-info", "build", "__pycache__", "results", "figures")
    shutil.copytree(ROOT, folder / "source", ignore=unwanted)
    left = folder / "source" / "build" / "lib" / "pgfmd"  # by a pip of before
    left.mkdir(parents=True)
    (left / "removed.py").touch()
    pip = (sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--wheel-dir", folder)
    done = call(*pip, folder / "source", folder=folder)
    if any(sign in done.stderr for sign in NO_NETWORK):
        pytest.skip("pip does not reach setuptools")
    assert done.returncode == 0, done.stderr
    (found,) = folder.glob("pgfmd-*.whl")
    return found


def test_what_the_wheel_holds(wheel):
    """Every module of the package and no other, the mark that it is typed, and in its metadata the extras, the licence,
    the command and the README."""
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        (info,) = {name.split("/")[0] for name in names if ".dist-info/" in name}
        metadata = archive.read(f"{info}/METADATA").decode()
        entry_points = archive.read(f"{info}/entry_points.txt").decode()
    modules = {str(path.relative_to(ROOT)) for path in (ROOT / "pgfmd").rglob("*.py")}
    assert modules | {"pgfmd/py.typed"} <= names
    assert {name for name in names if name.startswith("pgfmd/") and name.endswith(".py")} == modules
    assert "pgfmd = pgfmd.application.cli:main" in entry_points
    for line in ("Provides-Extra: mpi", "Provides-Extra: fft", "Provides-Extra: plot", "License-Expression: MIT"):
        assert line in metadata
    assert "# pgfmd" in metadata and "Requires-Dist: mpi4py>=4; extra" in metadata


def test_pip_is_enough(wheel, tmp_path, comm):
    """In an empty environment, from an empty folder: one process solves a contact; with the extra `mpi` the mpirun that
    pip brought runs two ranks, which write the numbers that this installation writes."""
    environment, empty = tmp_path / "environment", tmp_path / "empty folder"
    empty.mkdir()
    assert call(sys.executable, "-m", "venv", environment, folder=empty).returncode == 0
    python, programs = environment / "bin" / "python", environment / "bin"
    options = ("-q", "--disable-pip-version-check", "--no-compile", "--only-binary", ":all:")
    install = (python, "-m", "pip", "install", *options)
    done = call(*install, f"pgfmd[mpi] @ {wheel.as_uri()}", folder=empty)
    if any(sign in done.stderr for sign in NO_NETWORK):
        pytest.skip("pip does not reach a package index")
    assert done.returncode == 0, done.stderr

    private = {"PGFMD_CACHE": str(tmp_path / "cache")}
    done = call(python, "-c", SOLVE, folder=empty, **private)
    assert done.returncode == 0, done.stderr
    (empty / "job.toml").write_text(JOB)
    run = ("-m", "mpi4py", "-m", "pgfmd", "run", "job.toml", "--output")
    path = {"PATH": f"{programs}{os.pathsep}/usr/bin{os.pathsep}/bin"}
    script = f'. "{ROOT}/tools/env.sh"; exec "{programs}/mpirun" -n 2 "{python}" {" ".join(run)} two'
    done = call("bash", "-c", script, folder=empty, **private, **path)
    assert done.returncode == 0 and "UCX" not in done.stderr, done.stderr
    assert call(sys.executable, *run, "here", folder=empty, PYTHONPATH=str(ROOT)).returncode == 0
    two, here = Results(empty / "two"), Results(empty / "here")
    assert two.provenance["ranks"] == 2 and "without MPI" in two.provenance["libraries"]
    for name in ("pressure", "gap"):
        expected = here.field(name, 0)
        np.testing.assert_allclose(two.field(name, 0), expected, atol=1e-4 * np.abs(expected).max())
    with h5py.File(empty / "two" / "fields.h5") as file:
        np.testing.assert_array_equal(file["height"], two.field("height"))
    done = call(programs / "pgfmd", "info", "two", folder=empty, **path)
    assert done.returncode == 0 and "Open MPI" in done.stdout
