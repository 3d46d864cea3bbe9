"""What is kept for later runs lies where nobody else can put anything; and a run does not need such a place."""

import errno
import os
import pickle
import shutil
import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT, python

from pgfmd.parallel import compiled
from pgfmd.parallel.compiled import is_private, private_folder

SOLVE = """
import numpy as np, pgfmd
from pgfmd.parallel.compiled import private_folder
x = np.cos(2 * np.pi * np.arange(16) / 16)
print(pgfmd.solve(x[:, None] + x, 0.1).certified_error < 1e-6, private_folder())
"""


@pytest.fixture
def found(tmp_path, monkeypatch):
    """found(**environment): the private folder with that environment instead of the user's."""

    def found(**environment):
        for name in ("PGFMD_CACHE", "XDG_CACHE_HOME", "HOME"):
            monkeypatch.delenv(name, raising=False)
        for name, value in ({"HOME": str(tmp_path / "home")} | environment).items():
            monkeypatch.setenv(name, str(value))
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
        private_folder.cache_clear()
        return private_folder()

    (tmp_path / "tmp").mkdir()
    (tmp_path / "tmp").chmod(0o1777)
    yield found
    private_folder.cache_clear()


def test_the_first_folder_that_is_private(found, tmp_path):
    """That of the variables, then the home; made with mode 0700."""
    for name, folder in (("PGFMD_CACHE", tmp_path / "a"), ("XDG_CACHE_HOME", tmp_path / "b")):
        assert found(**{name: folder}) == folder / "pgfmd"
        assert (folder / "pgfmd").stat().st_mode & 0o777 == 0o700
    assert found() == tmp_path / "home" / ".cache" / "pgfmd"


@pytest.mark.parametrize("how", ["writable", "parent writable", "link", "foreign", "a file", "no home"])
def test_other_folders_are_left_alone(found, tmp_path, how):
    """One that others can write, or exchange, that is a link, or another user's: the temporary one is taken."""
    folder = tmp_path / "shared" / "pgfmd"
    folder.mkdir(parents=True)
    home = tmp_path / "home"
    home.mkdir()
    home.chmod(0o777)
    if how == "writable":
        folder.chmod(0o777)
    if how == "parent writable":
        folder.parent.chmod(0o777)
    if how == "link":
        folder.rmdir()
        (tmp_path / "elsewhere").mkdir()
        folder.symlink_to(tmp_path / "elsewhere")
    if how == "foreign":
        if os.geteuid() != 0:
            pytest.skip("only root can give a folder away")
        os.chown(folder, 12345, 12345)
    if how == "a file":
        folder.rmdir()
        folder.write_text("")
    if how == "no home":
        folder.parent.chmod(0o777)
        home.rmdir()
        home.write_text("")
    taken = found(PGFMD_CACHE=folder.parent)
    assert taken == tmp_path / "tmp" / f"pgfmd-{os.geteuid()}"
    assert taken.stat().st_mode & 0o777 == 0o700
    if how == "link":
        return
    taken.rmdir()
    taken.symlink_to(tmp_path)  # what others may have put there
    assert found(PGFMD_CACHE=folder.parent) != taken


def test_own_group_may_write(tmp_path):
    """A folder made with umask 002 is private where the group is the user's own, as Debian and Fedora set it up."""
    tmp_path.chmod(0o775)
    assert is_private(tmp_path) == (tmp_path.stat().st_gid == os.geteuid())


@pytest.mark.breadth
def test_a_user_without_home_can_solve(tmp_path):
    """A container's user: no home, a checkout of root's; numba said "no locator available"."""
    if os.geteuid() != 0 or shutil.which("setpriv") is None:
        pytest.skip("needs root and setpriv, to become another user")
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), "TMPDIR": "/tmp", "HOME": "/"}
    # Reading is allowed everywhere, as this Python and the checkout may be root's alone.
    rights = "--inh-caps +dac_read_search --ambient-caps +dac_read_search"
    become = f"setpriv --reuid 54321 --regid 54321 --clear-groups {rights}"
    command = [*become.split(), sys.executable, "-c", SOLVE]
    done = subprocess.run(command, env=environment, cwd="/", capture_output=True, text=True, check=False)
    assert done.returncode == 0 and done.stdout.startswith("True"), done.stderr
    assert done.stdout.split()[1] == "/tmp/pgfmd-54321"


@pytest.mark.breadth
def test_nowhere_to_keep_anything():
    """Where no folder can be had nothing is kept, and the answer is the same."""
    code = "import pgfmd.parallel.compiled as cache\ncache.is_private = lambda _: False\n" + SOLVE
    done = python(code)
    assert done.returncode == 0 and done.stdout == "True None\n", done.stderr


KEEP = """
import numpy as np
from pgfmd.grid import transforms
from pgfmd.observables.run_length import PeriodicSets
sets, a = PeriodicSets(2), np.empty((4, 96), complex)
sets.unite(np.array([0]), np.array([1]), np.ones((1, 2), np.int32))
transform = transforms.plan(a, a, True)
a[...] = 1
transform()
print(*sets.parent, a[0, 0].real)
"""


@pytest.mark.breadth
@pytest.mark.parametrize("how", ["full", "read-only"])
def test_a_cache_that_cannot_be_written_is_named(tmp_path, how):
    """Its disk has no space, or may not be written: the log names the folder, once, and the answer is the same."""
    if subprocess.run(["unshare", "-m", "true"], capture_output=True).returncode != 0:
        pytest.skip("may not mount a small disk")
    mount = f"mount -t tmpfs -o size=8k,mode=700 small {tmp_path} && mkdir -m 700 {tmp_path}/pgfmd"
    then = f"cp /dev/zero {tmp_path}/fill 2>/dev/null" if how == "full" else f"mount -o remount,ro {tmp_path}"
    command = ["unshare", "-m", "sh", "-c", f'{mount}; {then}; exec "$@"', "-", sys.executable, "-c", KEEP]
    environment = os.environ | {"PGFMD_CACHE": str(tmp_path), "HOME": str(tmp_path), "XDG_CACHE_HOME": ""}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "0 0 96.0\n"), done.stderr
    lines = [line for line in done.stderr.splitlines() if str(tmp_path) in line]
    reason = "No space left on device" if how == "full" else "may not be written"
    assert lines and all(reason in line for line in lines) and len(lines) == len(set(lines)), done.stderr


def test_no_space_for_temporary_files(found, tmp_path, monkeypatch):
    """Python raises an error where no folder of temporary files has space; then the memory's folder is taken."""

    def full():
        raise FileNotFoundError(errno.ENOENT, "No usable temporary directory found")

    monkeypatch.setattr("tempfile.gettempdir", full)
    (tmp_path / "home").write_text("")
    assert found() in (None, compiled.Path(f"/dev/shm/pgfmd-{os.geteuid()}"))


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES])
def test_what_cannot_be_kept_leaves_nothing_and_is_named(tmp_path, monkeypatch, caplog, code):
    """No part of a file that cannot take its place stays; the log names the folder and the reason, once."""

    def fail(*_):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(compiled.os, "replace", fail)
    for _ in range(2):
        compiled.keep(tmp_path / "file", b"content")
    assert list(tmp_path.iterdir()) == [] and compiled.kept(tmp_path / "file") is None
    (message,) = caplog.messages
    assert str(tmp_path) in message and os.strerror(code) in message


def test_a_damaged_file_counts_as_missing(tmp_path):
    """A byte that has changed, or an end that was not written, is noticed before the content is used."""
    path = tmp_path / "file"
    compiled.keep(path, b"content")
    whole = path.read_bytes()
    assert compiled.kept(path) == b"content"
    for damaged in (whole[:-1], whole[:10], b"", whole[:-1] + b"T", b"X" + whole[1:]):
        path.write_bytes(damaged)
        assert compiled.kept(path) is None


def test_wisdom_is_no_pickle(tmp_path, monkeypatch):
    """A pickle in the place of the wisdom is not executed, and what was learnt comes back as it was."""
    from pgfmd.grid import transforms

    monkeypatch.setattr(transforms, "private_folder", lambda: tmp_path)
    mark = tmp_path / "executed"

    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(mark),)

    transforms.wisdom_file().write_bytes(pickle.dumps(Evil()))
    transforms.pyfftw.forget_wisdom()
    a = np.empty((4, 96), complex)
    transforms.plan(a, a, True)
    assert not mark.exists()
    before = transforms.pyfftw.export_wisdom()
    assert len(before[0]) > 60
    transforms.pyfftw.forget_wisdom()
    monkeypatch.setattr(transforms, "_loaded", None)
    transforms._load_wisdom(transforms.wisdom_file())
    assert set(before[0].split()) == set(transforms.pyfftw.export_wisdom()[0].split())


def starter(cache, code):
    """start(*arguments): a process of that code, which keeps there what is for later runs, and waits for a line."""
    environment = os.environ | {"PGFMD_CACHE": str(cache)}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    return lambda *more: subprocess.Popen([sys.executable, "-c", code, *more], env=environment, **pipes)


def said(run):
    """What a process prints once it may go on."""
    text = run.communicate("go\n", timeout=120)[0]
    assert run.returncode == 0
    return text


PLAN = """
import sys
import numpy as np
from pgfmd.grid import transforms

def made(*arguments, **options):
    found = make(*arguments, **options)
    if "FFTW_WISDOM_ONLY" not in options["flags"]:
        print("plan of", len(arguments[0][0]), options["direction"])
    return found

make, transforms.pyfftw.FFTW = transforms.pyfftw.FFTW, made
print("ready", flush=True)
sys.stdin.readline()
for n in map(int, sys.argv[1:]):
    a = np.empty((4, n), complex)
    for forward in (True, False):
        transforms.plan(a, a, forward)
"""


def test_a_transform_is_planned_by_one_process(tmp_path):
    """Processes that begin together with an empty cache, and each need transforms of their own and common ones: each is
    planned by one of them, and nothing that another has learnt is lost.  A process after them plans nothing."""
    start, common = starter(tmp_path, PLAN), ("96", "120", "75")
    runs = [start(*common, "80"), start("77", *common), start("66", *common)]
    assert [run.stdout.readline() for run in runs] == ["ready\n"] * 3
    found = [line for run in runs for line in said(run).splitlines()]
    assert len(found) == len(set(found)) == 2 * 6
    assert said(start(*common, "80", "77", "66")) == "ready\n"


RESPOND = """
import numpy as np
from pgfmd.physics.laws.exponential_law import ExponentialWall

target = np.random.default_rng(0).normal(size=(64, 64)) * 3
pressure = np.empty_like(target)
sums = ExponentialWall(zeta=0.05).respond(target, pressure, 1.0, 0.3)
print(*(float(each).hex() for each in sums), pressure.tobytes().hex())
"""


def test_loops_that_were_compiled_and_loaded_add_up_alike(tmp_path):
    """An exponential wall's answer has the same bits in the process that compiles its loops and in one that loads."""
    environment = os.environ | {"PGFMD_CACHE": str(tmp_path)}
    command = [sys.executable, "-c", RESPOND]
    first, second = (subprocess.check_output(command, env=environment, text=True, timeout=120) for _ in range(2))
    assert first == second


COMPILE = """
import sys
from numba.core import event
import numpy as np
import pgfmd
from pgfmd.grid import kernels
from pgfmd.observables.run_length import _unite

class Count(event.Listener):
    names = []
    def on_start(self, found):
        self.names.append(found.data["dispatcher"].__name__)
    def on_end(self, found):
        pass

event.register("numba:compile", Count())
print("ready", flush=True)
sys.stdin.readline()
half, tiles, block = np.arange(32.0).reshape(4, 8), np.zeros((2, 5, 4)), np.zeros((4, 4))
table = np.array([[0, 8, 0, 4]])
kernels.rows_and_tiles(half, 0, tiles.reshape(-1), table, 5, False)
for back in (False, True):
    kernels.tiles_and_columns(tiles, 4, 0, 4, block, back)
kernels.rows_and_tiles(half, 0, tiles.reshape(-1), table, 5, True)
assert (half == np.arange(32.0).reshape(4, 8)).all()
pairs = np.zeros((2, 2), np.int32)
_unite(np.arange(2), pairs, np.zeros((2, 2), bool), np.array([0]), np.array([1]), pairs)
print(*Count.names)
"""


LOOPS = ("rows_and_tiles", "tiles_and_columns", "_unite", "_place")


@pytest.mark.breadth
def test_a_loop_is_compiled_by_one_process(tmp_path):
    """Of processes that begin together one compiles each loop, the others load it; one after them compiles nothing."""
    start = starter(tmp_path, COMPILE)
    together = [start() for _ in range(3)]
    assert all(run.stdout.readline() == "ready\n" for run in together)
    for run in together:
        run.stdin.write("go\n")
        run.stdin.flush()
    compiled = [name for run in together for name in said(run).split()]
    assert sorted(name for name in compiled if name in LOOPS) == sorted(LOOPS)
    assert said(start()).split() == ["ready"]


def test_nobody_waits_for_ever(tmp_path, monkeypatch):
    """A process that holds a lock may have been stopped: after LONGEST the others go on without it."""
    path = tmp_path / "file"
    with compiled.locked(path) as held:
        monkeypatch.setattr(compiled, "LONGEST", 0.05)
        assert held is not None and compiled.locked(path) is None
    with compiled.locked(path) as free:
        assert free is not None


FAIL = """
import fcntl, os
from pathlib import Path
import numba, pgfmd
from pgfmd.parallel.compiled import compiled

@compiled()
def wrong(x):
    return x.nothing

try:
    wrong(1.0)
except numba.TypingError:
    (lock,) = Path(os.environ["PGFMD_CACHE"]).rglob("*wrong*.lock")
    fcntl.flock(open(lock, "w"), fcntl.LOCK_EX | fcntl.LOCK_NB)
    print("free")
"""


def test_a_failed_compilation_holds_up_nobody(tmp_path):
    """Where compiling fails or is interrupted, the lock is given back though the process lives on."""
    (tmp_path / "fail.py").write_text(FAIL)
    code = "import sys; sys.path.insert(0, sys.argv[1]); import fail"
    run = python(code, tmp_path, PGFMD_CACHE=str(tmp_path / "cache"))
    assert run.stdout == "free\n", run.stderr


EDITED = """
import sys
sys.path.insert(0, sys.argv[1])
import loop
print(loop.total(1.0))
"""


@pytest.mark.breadth
@pytest.mark.parametrize("edited", ["loop", "helper", "constant"])
def test_code_of_an_older_source_is_not_run(tmp_path, edited):
    """Whether a loop has changed, or in another file a loop that it calls or a constant that it uses."""
    texts = {
        "loop": "from compiled import compiled\nfrom constant import C\nfrom helper import half\n"
        "@compiled()\ndef total(x):\n    return C * half(x) + 0\n",
        "helper": "from compiled import compiled\n@compiled(inline='always')\ndef half(x):\n    return x + 0\n",
        "constant": "C = 10\n",
        "compiled": "from pgfmd.parallel.compiled import compiled\n",
    }
    for name, text in texts.items():
        (tmp_path / f"{name}.py").write_text(text)

    def result() -> float:
        return float(python(EDITED, tmp_path, PGFMD_CACHE=str(tmp_path), PYTHONDONTWRITEBYTECODE="1").stdout)

    assert result() == 10
    (tmp_path / f"{edited}.py").write_text(texts[edited].replace("0\n", "5\n"))
    assert result() == {"loop": 15, "helper": 60, "constant": 15}[edited]
