"""The documentation: what it tells a new user to do works as it stands, and the site is built without a warning."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest
from conftest import ROOT

PAGES = ROOT / "tools" / "docs" / "pages"
TASKS = re.split(r"^## ", (PAGES / "tasks.md").read_text(), flags=re.MULTILINE)[1:]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
LINES = 10


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where the tasks are done, one after another, with the commands `pgfmd` and `python` of this installation."""
    folder = tmp_path_factory.mktemp("tasks")
    for name, options in (("pgfmd", "-m pgfmd"), ("python", "")):
        (folder / name).write_text(f'#!/bin/sh\nexec "{sys.executable}" {options} "$@"\n')
        (folder / name).chmod(0o755)
    return folder


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


def test_there_are_fifteen():
    """No task is lost."""
    assert len(TASKS) == 15


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
