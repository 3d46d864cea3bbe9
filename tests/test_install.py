"""The package as pip installs it: what a wheel holds, and a fresh environment without root, compiler or system MPI."""

import csv
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import ROOT
from job_texts import rough_job

import pgfmd
from pgfmd.application.results import Results
from pgfmd.errors import InputError
from pgfmd.theory.reference_set import _table

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
    """Every module and no other, the mark that it is typed, extras, licence, the command and the README."""
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


@pytest.mark.breadth  # it installs a whole environment: 42 s of a processor
def test_pip_is_enough(wheel, tmp_path, comm):
    """In an empty environment one process solves; with extra `mpi`, pip's mpirun runs two ranks: the same numbers."""
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


BASIC = "as bash cat cc cut dirname env flock grep head id ld mkdir mktemp mv rm sed sha256sum sort tail touch tr"


def _setup(root, *words, **environment):
    return subprocess.run(["bash", str(root / "tools" / "setup.sh"), *words], cwd="/", env=os.environ | environment,
                          stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60, check=False)


def _copy(folder):
    """A checkout, as far as the set-up is concerned, in a folder whose name has a space."""
    root = folder / "a checkout"
    shutil.copytree(ROOT / "tools", root / "tools")
    shutil.copy(ROOT / "pyproject.toml", root)
    return root


def test_nothing_to_do_is_silent(tmp_path):
    """Where nothing changed, the set-up says nothing and touches nothing."""
    root = _copy(tmp_path)
    functions = (root / "tools" / "setup.sh").read_text().partition("# ---- the order of things")[0]
    functions = functions.replace("${BASH_SOURCE[0]}", f"{root}/tools/setup.sh")
    command = ["bash", "-c", functions + "\npython=$(find_python); fingerprint"]
    told = subprocess.run(command, capture_output=True, text=True)
    (root / ".venv" / ".ready").mkdir(parents=True)
    (root / ".venv" / ".ready" / "wheels").write_text(told.stdout)
    (root / ".venv" / "bin").mkdir()
    (root / ".venv" / "bin" / "python").symlink_to(sys.executable)
    before = {path: path.lstat().st_mtime_ns for path in root.rglob("*")}
    done = _setup(root)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert {path: path.lstat().st_mtime_ns for path in root.rglob("*")} == before


def test_the_environment_of_another_checkout_is_left_alone(tmp_path):
    """A .venv that is a link belongs to another checkout: refused, and nothing there is removed."""
    root, other = _copy(tmp_path), tmp_path / "other"
    other.mkdir()
    (other / "file").touch()
    (root / ".venv").symlink_to(other)
    done = _setup(root)
    assert done.returncode == 1 and "is a link" in done.stderr
    assert [path.name for path in other.iterdir()] == ["file"]


def test_missing_packages_are_named(tmp_path):
    """Without MPI, and without apt-get to bring it, one message names the Debian packages; exit 1, nothing made."""
    tools = tmp_path / "bin"
    tools.mkdir()
    for name in BASIC.split():
        if found := shutil.which(name):
            (tools / name).symlink_to(found)
    root = _copy(tmp_path)
    done = _setup(root, "--parallel-hdf5", PATH=str(tools), PGFMD_PYTHON=sys.executable)
    assert done.returncode == 1
    assert "openmpi-bin libopenmpi-dev" in done.stderr
    assert "apt-get install" in done.stderr
    assert not (root / ".venv" / "bin").exists()


def test_old_python_is_named(tmp_path):
    """A Python before 3.11 is refused with its version, exit code 1."""
    old = tmp_path / "old python"
    old.write_text('#!/bin/sh\n[ "$1" = --version ] && echo "Python 3.9.2" && exit 0\nexit 1\n')
    old.chmod(0o755)
    done = _setup(_copy(tmp_path), PGFMD_PYTHON=str(old))
    assert done.returncode == 1
    assert "Python 3.9.2" in done.stderr and "3.11 or newer" in done.stderr


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_version_is_the_same_everywhere():
    """pyproject.toml, the package, and the metadata of archives and recipes."""
    version = PROJECT["version"]
    assert pgfmd.__version__ == version
    for name in ("tools/release/codemeta.json", ".zenodo.json"):
        assert json.loads((ROOT / name).read_text())["version"] == version
    for name, pattern in (
        ("CITATION.cff", rf"^version: {version}$"),
        ("tools/release/conda/recipe.yaml", rf'version: "{version}"'),
        ("tools/release/spack/package.py", rf'version\("{version}"\)'),
    ):
        assert re.search(pattern, (ROOT / name).read_text(), re.MULTILINE), name


def test_recipes_require_what_the_package_requires():
    """Each dependency stands in the conda and the Spack recipe and in codemeta."""
    folder = ROOT / "tools/release"
    texts = [(folder / name).read_text() for name in ("conda/recipe.yaml", "spack/package.py", "codemeta.json")]
    for requirement in PROJECT["dependencies"]:
        name = re.match(r"[\w-]+", requirement).group()
        assert all(name in text for text in texts), name


def test_the_paper_cites_what_its_bibliography_has():
    """Each @key of paper.md is an entry of paper.bib, and the other way round."""
    folder = ROOT / "tools/release"
    cited = set(re.findall(r"@([A-Z][a-zA-Z]+\d{4})", (folder / "paper.md").read_text()))
    assert cited == set(re.findall(r"^@article\{(\w+),", (folder / "paper.bib").read_text(), re.MULTILINE))


def test_the_package_page_has_nothing_relative():
    """No picture and no link that the package page could not follow."""
    text = (ROOT / "tools/release/package.md").read_text()
    assert not re.search(r"\]\((?!https://)", text)


def test_the_reference_returns_its_own_entries():
    """At an entry of the set: its value, its error and its scatter."""
    row = next(row for row in _table() if row["rolloff"] == 4 and row["hurst"] == 0.8)
    found = pgfmd.reference(hurst=0.8, scales=row["scales"], pressure=row["pressure"])["gap"]
    assert found.value == pytest.approx(row["gap"], rel=1e-12)
    assert (found.error, found.scatter) == pytest.approx((row["gap_error"], row["gap_scatter"]), rel=1e-6)


def test_a_fresh_surface_agrees_with_the_reference():
    """A surface whose seed is not in the set, between two pressures: area within four times the scatter of one."""
    rough = {"kind": "self-affine", "hurst": 0.8, "lambda_s": 8.0, "lambda_r": 128.0, "rms_slope": 0.1, "seed": 99}
    heights = pgfmd.surface({"grid": {"n": 512}, "surface": rough})
    area = pgfmd.solve(heights, 0.005, contact_modulus=1.0, tolerance=1e-6).contact_area_corrected
    expected = pgfmd.reference(hurst=0.8, scales=16, pressure=0.05, rolloff=4)["area"]
    assert abs(area - expected.value) < 4 * (8**0.5 * expected.scatter + expected.error)


@pytest.mark.parametrize("asked", [{"hurst": 0.1}, {"scales": 1000}, {"pressure": 3}, {"rolloff": 2}])
def test_outside_of_the_set_is_refused(asked):
    """One line that names what is allowed."""
    with pytest.raises(InputError, match=f"{next(iter(asked))} = .*: must"):
        pgfmd.reference(**{"hurst": 0.8, "scales": 16, "pressure": 0.02, "rolloff": 4} | asked)


def test_the_table_is_the_one_that_its_description_names():
    """The checksum in jobs/reference/reference.json is that of the table in the package."""
    about = json.loads((ROOT / "jobs/reference/reference.json").read_text())
    assert hashlib.sha256((ROOT / "pgfmd/theory/reference.csv").read_bytes()).hexdigest() == about["sha256"]


def test_the_table_is_made_from_the_runs(tmp_path, capsys):
    """Means over the surfaces in units of slope and cell; the finer grid beside; no runs are refused."""
    import reference_table

    rough = {"kind": "self-affine", "hurst": 0.8, "lambda_s": 8.0, "lambda_r": 64.0, "rms_slope": 0.1}
    job = {"solid": {"contact_modulus": 1.0}, "load": {"pressure": [0.004]}}
    job |= {"output": {"observables": ["discretisation"]}}
    for name, seed, grid in (("s1", 1, {}), ("s2", 2, {}), ("s1-fine", 1, {"refine": 2})):
        surface = {"surface": rough | {"seed": seed}, "grid": {"n": 64} | grid}
        pgfmd.run(job | surface, tmp_path / f"h0.8-l1-r8-{name}")
    assert reference_table.main([str(tmp_path), "--output", str(tmp_path / "table")]) == 0
    (row,) = csv.DictReader((tmp_path / "table/reference.csv").open())
    gaps = [pgfmd.Results(tmp_path / f"h0.8-l1-r8-s{seed}")[0].numbers["mean_gap"] for seed in (1, 2)]
    assert float(row["gap"]) == pytest.approx(sum(gaps) / 2 / (0.1 * 64), rel=1e-5)
    assert float(row["gap_scatter"]) == pytest.approx(abs(gaps[0] - gaps[1]) / 2 / (0.1 * 64), rel=1e-5)
    assert (row["seeds"], float(row["pressure"])) == ("2", pytest.approx(0.04))
    assert len(list(csv.DictReader((tmp_path / "table/fine.csv").open()))) == len(reference_table.NUMBERS)
    assert '"nayak": ' in (tmp_path / "table/reference.html").read_text()
    assert reference_table.main([str(tmp_path / "none"), "--output", str(tmp_path / "table")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_the_reference_set_as_netcdf(tmp_path):
    """Every number of the table, exactly, with a unit and a meaning; xarray and netCDF4 read it."""
    xarray, netcdf4 = pytest.importorskip("xarray"), pytest.importorskip("netCDF4")
    subprocess.run([sys.executable, ROOT / "tools/release/netcdf.py", tmp_path], check=True, stdout=subprocess.DEVNULL)
    with open(ROOT / "pgfmd/theory/reference.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    with xarray.open_dataset(tmp_path / "reference.nc", engine="h5netcdf") as found:
        assert list(found.data_vars) == list(rows[0])
        for name, column in found.data_vars.items():
            assert column.values.tolist() == [float(row[name]) for row in rows]
            assert column.attrs["units"] == "1" and len(column.attrs["long_name"]) > 5
    with netcdf4.Dataset(tmp_path / "reference.nc") as other:
        assert other["kappa_error"].long_name.startswith("area/pressure: error by grid and solver")
