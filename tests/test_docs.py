"""The documentation: its pages, the examples in docstrings, and those in `jobs/examples/` as scripts and notebooks."""

import doctest
import importlib
import inspect
import json
import os
import re
import subprocess
import sys
from dataclasses import fields

import generated
import notebooks
import numpy as np
import pytest
from conftest import ROOT
from test_readme import sections

import pgfmd
from pgfmd.application.job import SECTIONS
from pgfmd.application.results import Results
from pgfmd.observables.observable_kinds import LAYOUT
from pgfmd.observables.schema import FIELDS, LOADS, TABLE

PAGES = ROOT / "tools" / "docs" / "pages"
TASKS = re.split(r"^## ", (PAGES / "tasks.md").read_text(), flags=re.MULTILINE)[1:]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
LINES = 10


def equipped(folder):
    """The folder with this installation's `pgfmd` and `python`; `sbatch` runs a script at once on two ranks."""
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


@pytest.mark.breadth
@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.split("\n")[0])
def test_a_task_works_in_ten_lines(task, folder):
    """Its blocks have at most ten lines together, and do what they say, after the tasks before it."""
    blocks = BLOCK.findall(task)
    lines = [line for _, text in blocks for line in text.splitlines() if line.strip() and not line.startswith("# ")]
    assert blocks and len(lines) <= LINES
    for language, text in blocks:
        if "tamaas" in text:
            pytest.importorskip("tamaas")
        do(language, text, folder)


@pytest.mark.breadth
def test_the_measured_patch_is_typed_as_it_stands(tmp_path):
    """Every command of the page works, in its order."""
    pytest.importorskip("SurfaceTopography")
    folder = equipped(tmp_path)
    (folder / "jobs").symlink_to(ROOT / "jobs")
    for language, text in BLOCK.findall((PAGES / "measured.md").read_text()):
        if language == "sh":
            do("sh", text, folder)
    assert len(list((folder / "results" / "patch" / "export").iterdir())) == 3


@pytest.mark.breadth
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


def test_there_are_twenty_tasks_and_two_examples():
    """None is lost."""
    assert len(TASKS) == 20 and len(EXAMPLES) >= 2


def test_the_same_problem_in_three_programs():
    """Where the other programs are installed, what the page on coming from them shows runs as it stands, and their
    pressures are ours to 1e-3 of their norm, what the page says, and what our default tolerance leaves (`solve`)."""
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


def test_two_programs_beside_the_reference_set(capsys):
    """⟨p²⟩ of one surface by tamaas and by ContactMechanics, as the pages show, agree to 1e-3, what their tolerances
    leave, and lie within five scatters of a single surface (√8 standard errors of the mean of eight) of the set."""
    found = {}
    task = next(task for task in TASKS if task.startswith("19. "))
    for program, text in (("tamaas", task), ("ContactMechanics", (PAGES / "reference-set.md").read_text())):
        pytest.importorskip(program)
        found[program] = names = {}
        exec(next(code for language, code in BLOCK.findall(text) if language == "python"), names)
    mine, known = [names["mine"] for names in found.values()], names["known"]
    assert mine[0] == pytest.approx(mine[1], rel=1e-3)
    assert abs(mine[1] - known.value) < known.error + 5 * 8**0.5 * known.scatter


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site, built with `mkdocs build --strict`: every page, link and docstring is there."""
    for name in ("mkdocs", "mkdocstrings", "latex2mathml"):
        pytest.importorskip(name)
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", str(ROOT / "tools/docs/mkdocs.yml")]
    environment = dict(os.environ, PYTHONPATH=str(ROOT))
    done = subprocess.run([*command, "-d", str(folder)], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


def test_the_site_is_complete_in_itself(site):
    """No page asks for anything from elsewhere; every picture is there."""
    for page in site.rglob("*.html"):
        text = page.read_text()
        assert not re.findall(r'<(?:script|link|img)[^>]+(?:src|href)="https?://', text), page
        assert all((page.parent / name).is_file() for name in re.findall(r'<img[^>]+src="([^":]+)"', text)), page


def test_formulas_are_part_of_their_sentences(site):
    """No $ is left outside code, even over a line break; no formula at the start of a line ends its paragraph."""
    for page in site.glob("*.html"):
        text = re.sub(r"<(code|script)\b.*?</\1>", "", page.read_text(), flags=re.DOTALL)
        assert "$" not in text, page
        assert not re.findall(r'</p>\s*<math[^>]*display="inline"', text), page
    theory = (site / "theory.html").read_text()
    assert theory.count('display="inline"') > 20 and theory.count('display="block"') > 5


def test_the_site_says_what_counts_and_what_is_taken(site):
    """Stiffnesses stand as formulas, soft walls say what counts as contact, and the page of Python lists each parameter
    of `solve` and each field of a contact."""
    theory = (site / "theory.html").read_text()
    assert "Exponential walls and" in theory.partition("What counts as contact</h2>")[2] and "E'_2 / E'_1" not in theory
    rows = set(re.findall(r"<tr>\s*<td[^>]*><code>(\w+)</code>", (site / "api.html").read_text()))
    assert set(inspect.signature(pgfmd.solve).parameters) | {"pressure", "gap", "certified_error"} <= rows


def test_the_reference_is_that_of_the_source():
    """`python tools/docs/generated.py` leaves the page as it is."""
    written = generated.PAGE.read_text()
    assert written == generated.page(written)


def test_search_finds_each_key_and_each_column(site):
    """Each key, column and field is a word of the reference in the search; the page stands in the navigation."""
    entries = json.loads((site / "search" / "search_index.json").read_text())["docs"]
    words = {word for entry in entries if entry["location"].startswith("reference.html")
             for word in re.findall(r"\w+", entry["text"])}  # fmt: skip
    keys = {field.name for kind in SECTIONS.values() for section in sections(kind) for field in fields(section)}
    assert len(keys) > 50 and keys | LOADS.keys() | LAYOUT[TABLE].keys() | FIELDS.keys() <= words
    assert 'href="reference.html"' in (site / "index.html").read_text()


pytest.importorskip("pandas")

MODULES = ("api", "application.simulate", "observables.contact", "application.results", "application.ensemble")


@pytest.mark.parametrize("name", [f"pgfmd.{name}" for name in MODULES])
def test_examples_give_what_they_say(name, tmp_path, monkeypatch):
    """Every example of a docstring prints what stands below it; each of these files has some."""
    monkeypatch.chdir(tmp_path)
    found = doctest.testmod(importlib.import_module(name), optionflags=doctest.ELLIPSIS)
    assert found.attempted > 1 and found.failed == 0


EXAMPLES = sorted((ROOT / "jobs" / "examples").glob("*.py"))
ENVIRONMENT = dict(os.environ, PYTHONPATH=str(ROOT), MPLBACKEND="Agg")


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
@pytest.mark.parametrize(("name", "text"), list(notebooks.notebooks()), ids=[path.stem for path in EXAMPLES])
def test_a_notebook_runs(name, text, monkeypatch, site):
    """The site offers a valid notebook; in a kernel every cell runs, one draws, `solve` shows its progress unasked."""
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    for key, value in dict(ENVIRONMENT, MPLBACKEND="module://matplotlib_inline.backend_inline").items():
        monkeypatch.setenv(key, value)
    assert (site / "notebooks" / name).read_text(encoding="utf-8") == text
    assert f"notebooks/{name}" in (site / "tutorial.html").read_text(encoding="utf-8")
    notebook = nbformat.reads(text, as_version=4)
    nbformat.validate(notebook)
    nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert len(notebook.cells) > 6 and any("image/png" in output.get("data", {}) for output in outputs)
    if "solve(" in text:
        bars = [output.text for output in outputs if output.get("name") == "stderr"]
        assert any("error" in text and "|" in text for text in bars)
