"""tools/setup.sh where nothing has to be installed, and where nothing can be."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

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
