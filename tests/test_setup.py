"""tools/setup.sh where nothing has to be installed, and where nothing can be."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time

import pytest
from conftest import ROOT

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


@pytest.mark.skipif(not (ROOT / ".venv" / ".ready").exists(), reason="this checkout was not set up")
def test_nothing_to_do_is_quick_and_silent():
    """Where nothing changed, the set-up says nothing and ends within 5 s (0.3 s on an idle machine)."""
    first = _setup(ROOT)  # may have something to do, if a file was edited since
    start = time.monotonic()
    second = _setup(ROOT)
    assert (first.returncode, second.returncode, second.stdout, second.stderr) == (0, 0, "", "")
    assert time.monotonic() - start < 5


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
