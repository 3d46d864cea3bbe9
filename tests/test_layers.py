"""Imports point down, between the folders of the package and between the files of a folder: they form no circle."""

from __future__ import annotations

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from conftest import python

PACKAGE = Path(__file__).resolve().parent.parent / "pgfmd"
FILES = sorted(PACKAGE.rglob("*.py"))
MODULES = {".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts): path for path in FILES}
MODULES = {name.removesuffix(".__init__"): path for name, path in MODULES.items()}
# For tools on a laptop.
SERIAL = ("pgfmd", "pgfmd.theory", "pgfmd.application.results", "pgfmd.observables.binning")


def imported(path: Path):
    """Every module that a file imports, also inside functions: the package's by full name, others by their first."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if name in MODULES else node.module for name in names]
        else:
            continue
        yield from (name if name in MODULES else name.split(".")[0] for name in names)


IMPORTS = {name: set(imported(path)) for name, path in MODULES.items()}


def room(module: str) -> str:
    """The folder directly below the package, or the file there."""
    return ".".join(module.split(".")[:2])


def without_circle(graph: dict[str, set[str]]) -> None:
    """Fail with the circle, if there is one."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"a circle of imports: {' → '.join(error.args[1])}")


def test_no_circle_between_files():
    """Files can be put in an order in which each imports from earlier ones only; `pgfmd` itself holds names alone."""
    without_circle({name: (found & MODULES.keys()) - {"pgfmd", name} for name, found in IMPORTS.items()})


def test_no_circle_between_folders():
    """So can the folders below the package, and the folders in each of them."""
    graph: dict[str, set[str]] = {}
    for name, found in IMPORTS.items():
        below = {room(other) for other in found & MODULES.keys() if other != "pgfmd"}
        graph.setdefault(room(name), set()).update(below - {room(name)})
    without_circle(graph)
    for folder in {name.rpartition(".")[0] for name in MODULES if name.count(".") > 2}:
        parent, graph = folder.rpartition(".")[0], {}
        for name, found in IMPORTS.items():
            if name.startswith(parent + "."):
                depth = parent.count(".") + 2
                place = ".".join(name.split(".")[:depth])
                below = {".".join(other.split(".")[:depth]) for other in found if other.startswith(parent + ".")}
                graph.setdefault(place, set()).update(below - {place})
        without_circle(graph)


def test_root_is_small():
    """At most eight files and eleven folders lie directly in the package."""
    entries = [path for path in PACKAGE.iterdir() if path.name != "__pycache__"]
    assert sum(path.is_file() for path in entries) <= 8
    assert sum(path.is_dir() for path in entries) <= 11


@pytest.mark.parametrize(("outside", "allowed"), [
    ("mpi4py", {"parallel"}), ("mpi4py_fft", {"grid"}), ("pyfftw", {"grid", "application"}),
    ("h5py", {"application", "surfaces"}), ("tomllib", {"application"}), ("signal", {"application"}),
    ("tqdm", {"application"}), ("SurfaceTopography", {"application", "surfaces"}),
])  # fmt: skip
def test_libraries_stay_where_they_belong(outside, allowed):
    """Transforms are planned in one folder, files are opened in few."""
    users = {name.split(".")[1] for name, found in IMPORTS.items() if outside in found}
    assert users <= allowed


@pytest.mark.parametrize("name", SERIAL)
def test_serial_parts_need_no_mpi(name):
    """`import pgfmd`, the readers and the theory work without mpi4py, numba and FFT libraries."""
    code = f"import sys; sys.modules.update(mpi4py=None, numba=None, pyfftw=None, mpi4py_fft=None); import {name}"
    done = python(code)
    assert done.returncode == 0, done.stderr


def test_library_needs_no_hdf5():
    """A contact is solved, measured and certified where h5py is not installed; only files of HDF5 need it."""
    code = """import sys
sys.modules.update(h5py=None, tomllib=None)
import numpy as np
import pgfmd
import pgfmd.surfaces.surface_kinds, pgfmd.observables.observable_kinds
from pgfmd.surfaces.file import read_heights
wave = np.cos(2 * np.pi * np.arange(32) / 32)
contact = pgfmd.solve(wave[:, None] * wave, 0.01)
assert contact.certified_error < 1e-8
assert pgfmd.certify(wave[:, None] * wave, contact.pressure).certified_error < 1e-7
"""
    done = python(code)
    assert done.returncode == 0, done.stderr
