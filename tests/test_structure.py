"""What a reader may rely on in every file: few parameters, nothing written twice, imports that form no circle."""

import ast
import io
import keyword
import tokenize
from collections import defaultdict
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from conftest import python

PACKAGE = Path(__file__).resolve().parent.parent / "pgfmd"
FILES = sorted(PACKAGE.rglob("*.py"))
MOST_PARAMETERS = 6
LINES = 8  # a run of so many lines of one shape is written once


def parameters(function: ast.FunctionDef) -> list[str]:
    """Names of the parameters, without self."""
    arguments = function.args
    names = [argument.arg for argument in arguments.posonlyargs + arguments.args + arguments.kwonlyargs]
    return [name for name in names if name not in ("self", "cls")]


def test_few_parameters():
    """No function takes more than six parameters, but `api.solve`, the front door for scripts."""
    long = [
        f"{path.relative_to(PACKAGE)}:{node.lineno} {node.name}({', '.join(parameters(node))})"
        for path in FILES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef) and len(parameters(node)) > MOST_PARAMETERS
    ]
    assert [entry for entry in long if not entry.startswith("api.py")] == []


def shapes(path: Path) -> list[tuple[int, str]]:
    """(line number, shape) of each line of code, names, numbers and texts made alike; no docstrings, no imports."""
    text = path.read_text()
    skipped = set()
    for node in ast.walk(ast.parse(text)):
        is_text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if is_text or isinstance(node, (ast.Import, ast.ImportFrom)):
            skipped.update(range(node.lineno, node.end_lineno + 1))
    lines = defaultdict(list)
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.NAME and not keyword.iskeyword(token.string):
            lines[token.start[0]].append("name")
        elif token.type in (tokenize.NUMBER, tokenize.STRING):
            lines[token.start[0]].append("value")
        elif token.type in (tokenize.NAME, tokenize.OP):
            lines[token.start[0]].append(token.string)
    kept = sorted(number for number in lines if number not in skipped and set(lines[number]) & {"name", "value"})
    return [(number, " ".join(lines[number])) for number in kept]


def test_nothing_is_written_twice():
    """No two places share eight lines of code, other names and numbers allowed."""
    places = defaultdict(list)
    for path in FILES:
        found = shapes(path)
        for first in range(len(found) - LINES + 1):
            window = found[first : first + LINES]
            if len({shape for _, shape in window}) > LINES // 2:  # a table of like entries is not a copy
                places[tuple(shape for _, shape in window)].append((path, window[0][0], window[-1][0]))
    copies = []
    for found in places.values():
        original, start, stop = found[0]
        for path, first, last in found[1:]:
            if path != original or first > stop:
                copies.append(f"{path.relative_to(PACKAGE)}:{first}-{last} ~ {original.relative_to(PACKAGE)}:{start}")
    assert copies == []


def test_no_two_files_of_the_package_have_one_name():
    """A file is found by its name alone."""
    names = [path.name for path in FILES if path.name != "__init__.py"]
    assert sorted(names) == sorted(set(names))


MODULES = {".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts): path for path in FILES}
MODULES = {name.removesuffix(".__init__"): path for name, path in MODULES.items()}


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


@pytest.mark.parametrize("name", ["pgfmd", "pgfmd.theory", "pgfmd.application.results", "pgfmd.observables.binning"])
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
