"""The documentation: what it tells a new user to do works as it stands, and the site is built without a warning."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT

import pgfmd
from pgfmd.io.results import Results

PAGES = ROOT / "tools" / "docs" / "pages"
TASKS = re.split(r"^## ", (PAGES / "tasks.md").read_text(), flags=re.MULTILINE)[1:]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
LINES = 10


def equipped(folder):
    """The folder with the commands `pgfmd` and `python` of this installation; `sbatch` runs a script at once, on two
    ranks.
    """
    slurm = f'PYTHON="{sys.executable}" PGFMD_ROOT="{ROOT}" LAUNCH="mpirun -n 2"'
    for name, text in (
        ("pgfmd", f'exec "{sys.executable}" -m pgfmd "$@"'), ("python", f'exec "{sys.executable}" "$@"'),
        ("sbatch", f'{slurm} exec bash "$@"'),
    ):  # fmt: skip
        (folder / name).write_text(f"#!/bin/sh\n{text}\n")
        (folder / name).chmod(0o755)
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where the tasks are done, one after another."""
    return equipped(tmp_path_factory.mktemp("tasks"))


def do(language: str, text: str, folder) -> None:
    """Do what a block says."""
    if language == "toml":
        (folder / text.split()[1]).write_text(text)
        return
    path = f"{folder}:{os.environ['PATH']}"
    environment = dict(os.environ, PATH=path, MPLBACKEND="Agg", PYTHONPATH=str(ROOT), OMP_NUM_THREADS="1")
    shell = ["bash", "-euc", f". {ROOT}/tools/env.sh\n{text}"]
    start = [sys.executable, "-c", text] if language == "python" else shell
    done = subprocess.run(start, cwd=folder, env=environment, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    assert done.returncode == 0, done.stderr[-3000:]


@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.split("\n")[0])
def test_a_task_works_in_ten_lines(task, folder):
    """Its blocks have at most ten lines together, and do what they say, after the tasks before it."""
    blocks = BLOCK.findall(task)
    lines = [line for _, text in blocks for line in text.splitlines() if line.strip() and not line.startswith("# ")]
    assert blocks and len(lines) <= LINES
    for language, text in blocks:
        do(language, text, folder)


def test_the_tutorial_is_typed_as_it_stands(tmp_path):
    """Every command works, in its order; every file that is shown is there, and none is copied into the page."""
    folder = equipped(tmp_path)
    (folder / "jobs").symlink_to(ROOT / "jobs")
    blocks = BLOCK.findall((PAGES / "tutorial.md").read_text())
    shown = [found[1] for _, text in blocks if (found := re.fullmatch(r'--8<-- "(.+)"\n', text))]
    assert len(shown) >= 5 and all((ROOT / name).is_file() for name in shown)
    commands = [text for language, text in blocks if language == "sh"]
    assert len(shown) + len(commands) == len(blocks)
    for text in commands:
        do("sh", text, folder)
    assert Results(folder / "results" / "cluster").status == "complete"
    assert len(Results(folder / "results" / "loads")) == 7


def test_there_are_fifteen():
    """No task is lost."""
    assert len(TASKS) == 15


def test_the_same_problem_in_three_programs():
    """Where the other programs are installed, what the page on coming from them shows runs as it stands, and their
    pressures are ours to 1e-3 of their norm, what the page says, and what our default tolerance leaves (`solve`).
    """
    text = (PAGES / "coming.md").read_text()
    rough = {"kind": "self-affine", "hurst": 0.8, "lambda_s": 16.0, "rms_slope": 0.1}
    heights = pgfmd.surface({"grid": {"n": 256}, "surface": rough})
    answers = {"pgfmd": "contact.pressure", "tamaas": "model.traction", "ContactMechanics": "system.force"}
    found = {}
    for _, code in BLOCK.findall(text):
        program = re.search(r"^(?:from|import) (\w+)", code, re.MULTILINE)[1]
        pytest.importorskip(program)
        names = {"heights": heights.copy()}
        exec(code, names)
        found[program] = np.array(eval(answers[program], names))
    assert found.keys() == answers.keys()
    ours = found.pop("pgfmd")
    for program, pressure in found.items():
        assert np.linalg.norm(pressure - ours) < 1e-3 * np.linalg.norm(ours), program


def test_the_site_is_built_without_a_warning(tmp_path):
    """`mkdocs build --strict`: every page, link and docstring is found; no page asks for anything from elsewhere."""
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocstrings")
    pytest.importorskip("latex2mathml")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", str(ROOT / "tools/docs/mkdocs.yml")]
    environment = dict(os.environ, PYTHONPATH=str(ROOT))
    done = subprocess.run([*command, "-d", str(tmp_path)], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr[-3000:]
    for page in tmp_path.rglob("*.html"):
        assert not re.findall(r'<(?:script|link|img)[^>]+(?:src|href)="https?://', page.read_text()), page
