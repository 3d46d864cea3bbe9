"""The examples in `jobs/examples/` run, as scripts and as notebooks."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest
from conftest import ROOT

EXAMPLES = sorted((ROOT / "jobs" / "examples").glob("*.py"))
ENVIRONMENT = dict(os.environ, PYTHONPATH=str(ROOT), MPLBACKEND="Agg")


def cells(path) -> list[str]:
    """The code of each cell of a script."""
    parts = re.split(r"^# %%.*$", path.read_text(), flags=re.MULTILINE)
    return [part for part in parts if any(line and not line.startswith("#") for line in part.split("\n"))]


def test_there_are_two():
    """None is lost."""
    assert len(EXAMPLES) >= 2 and all(len(cells(path)) > 3 for path in EXAMPLES)


@pytest.mark.breadth
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs_as_a_script(path, tmp_path):
    """From another folder, without a warning from this package, and it leaves no files."""
    pytest.importorskip("pandas")
    command = [sys.executable, "-W", "error::RuntimeWarning", str(path)]
    done = subprocess.run(command, cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "±" in done.stdout or "contact_area" in done.stdout
    assert not list(tmp_path.iterdir())


@pytest.mark.breadth
def test_an_example_runs_as_a_notebook(monkeypatch):
    """In a kernel every cell runs, and `solve` shows a bar of its progress unasked."""
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    for name, value in ENVIRONMENT.items():
        monkeypatch.setenv(name, value)
    path = next(path for path in EXAMPLES if path.stem == "first_contact")
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(text) for text in cells(path)])
    nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
    outputs = [output for cell in notebook.cells for output in cell.outputs]
    assert any("error" in output.text and "|" in output.text for output in outputs if output.get("name") == "stderr")
