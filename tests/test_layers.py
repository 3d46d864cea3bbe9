"""Imports point down: the layers of the package, read off the source."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "pgfmd"
LAYERS = (
    # 0: no grid, no physics; what tools use on a laptop is here too
    "errors team threads parallel plans kernels set_kernels validate sections config files schema runs seal spectra "
    "theory results estimate instrument",
    "strips transforms grid",
    "hierarchy window elasticity topography heightfile labelling",
    "solvers patches observables loads",
    "slabfile former provenance output checkpoint watch topology progress",
    "simulate contact",
    "__main__ __init__",
)
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names.split()}
FILES = sorted(PACKAGE.rglob("*.py"))


def module(path: Path) -> str:
    """Name of the module or subpackage directly below the package."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported(path: Path):
    """(module below the package, outside package) of every import statement of a file, also inside functions."""
    depth = len(path.relative_to(PACKAGE).parts)
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from ((None, alias.name.split(".")[0]) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield None, node.module.split(".")[0]
        elif isinstance(node, ast.ImportFrom) and node.level == depth:
            names = [node.module.split(".")[0]] if node.module else [alias.name for alias in node.names]
            yield from ((name, None) for name in names if name in LEVEL)


def test_every_module_has_its_layer():
    """A new module is put into a layer."""
    assert {module(path) for path in FILES} == set(LEVEL)


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_down(path):
    """No module imports from a layer above its own; `__init__` may name anything, lazily."""
    own = module(path)
    above = [name for name, _ in imported(path) if name and LEVEL[name] > LEVEL[own]]
    assert not above, f"{own} (layer {LEVEL[own]}) imports {above}"


@pytest.mark.parametrize(
    ("outside", "allowed"),
    [
        ("mpi4py_fft", {"plans"}),
        ("h5py", {"output", "slabfile", "checkpoint", "former", "heightfile", "results", "topology", "seal"}),
        ("pyfftw", {"plans", "topology", "provenance"}),
        ("SurfaceTopography", {"instrument"}),
    ],
)
def test_libraries_stay_where_they_belong(outside, allowed):
    """Transforms are planned in one place, files are opened in few."""
    users = {module(path) for path in FILES for _, name in imported(path) if name == outside}
    assert users <= allowed


def test_serial_parts_need_no_mpi():
    """`import pgfmd`, the readers, the theory and `check` work where mpi4py is not installed."""
    code = (
        "import sys; sys.modules['mpi4py'] = None\n"
        "import pgfmd, pgfmd.results, pgfmd.spectra, pgfmd.config, pgfmd.estimate\n"
        "from pgfmd.theory import persson, asperity, exact, hertz\n"
        "pgfmd.Results, pgfmd.__main__ if hasattr(pgfmd, '__main__') else None"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
