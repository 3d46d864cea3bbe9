"""What is kept for later runs lies where nobody else can put anything; and a run does not need such a place."""

from __future__ import annotations

import fcntl
import os
import pickle
import shutil
import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT, SIZE

from pgfmd.parallel import private_cache
from pgfmd.parallel.private_cache import is_private, private_folder

pytestmark = pytest.mark.skipif(SIZE > 1, reason="one process is what matters")

SOLVE = """
import numpy as np, pgfmd, numba, sys
x = np.cos(2 * np.pi * np.arange(16) / 16)
print(pgfmd.solve(x[:, None] + x, 0.1).certified_error < 1e-6, numba.config.CACHE_DIR)
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
    assert done.stdout.split()[1] == "/tmp/pgfmd-54321/kernels"


def test_nowhere_to_keep_anything():
    """Where no folder can be had nothing is kept, and the answer is the same."""
    code = "import os\nos.access = lambda *_: False\n" + SOLVE
    environment = dict(os.environ) | {"NUMBA_CACHE_DIR": "/proc/nowhere"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.startswith("True"), done.stderr


def test_wisdom_is_no_pickle(tmp_path, monkeypatch):
    """A pickle in the place of the wisdom is not executed, and what was learnt comes back as it was."""
    from pgfmd.grid import fftw

    monkeypatch.setattr(fftw, "private_folder", lambda: tmp_path)
    mark = tmp_path / "executed"

    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(mark),)

    fftw.wisdom_file().write_bytes(pickle.dumps(Evil()))
    fftw.pyfftw.forget_wisdom()
    a = np.empty((4, 96), complex)
    fftw.plan(a, a, True)
    assert not mark.exists()
    before = fftw.pyfftw.export_wisdom()
    assert len(before[0]) > 60
    fftw.pyfftw.forget_wisdom()
    monkeypatch.setattr(fftw, "_loaded", None)
    fftw._load_wisdom(fftw.wisdom_file())
    assert set(before[0].split()) == set(fftw.pyfftw.export_wisdom()[0].split())


def test_wisdom_that_cannot_be_kept_leaves_nothing(tmp_path, monkeypatch):
    """Where the file cannot take its place, as on a full disk, no part of it stays to fill the disk further."""
    from pgfmd.grid import fftw

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(fftw, "private_folder", lambda: tmp_path)
    monkeypatch.setattr(fftw.os, "replace", full)
    fftw._save_wisdom(fftw.wisdom_file())
    assert list(tmp_path.iterdir()) == []


PLAN = """
import sys
import numpy as np
from pgfmd.grid import fftw

def made(*arguments, **options):
    found = make(*arguments, **options)
    if "FFTW_WISDOM_ONLY" not in options["flags"]:
        print("plan of", len(arguments[0][0]), options["direction"])
    return found

make, fftw.pyfftw.FFTW = fftw.pyfftw.FFTW, made
print("ready", flush=True)
sys.stdin.readline()
for n in map(int, sys.argv[1:]):
    a = np.empty((4, n), complex)
    for forward in (True, False):
        fftw.plan(a, a, forward)
"""


def test_a_transform_is_planned_by_one_process(tmp_path):
    """Processes that begin together with an empty cache, and each need transforms of their own and common ones: each is
    planned by one of them, and nothing that another has learnt is lost.  A process after them plans nothing.
    """
    environment = os.environ | {"PGFMD_CACHE": str(tmp_path)}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}

    def start(*sizes: str) -> subprocess.Popen:
        return subprocess.Popen([sys.executable, "-c", PLAN, *sizes], env=environment, **pipes)

    def plans(run: subprocess.Popen) -> list[str]:
        found = run.communicate("go\n", timeout=120)[0].splitlines()
        assert run.returncode == 0
        return found

    common = ("96", "120", "75")
    runs = [start(*common, "80"), start("77", *common), start("66", *common)]
    assert [run.stdout.readline() for run in runs] == ["ready\n"] * 3
    found = sum(map(plans, runs), [])
    assert len(found) == len(set(found)) == 2 * 6
    assert plans(start(*common, "80", "77", "66")) == ["ready"]


COMPILE = """
import sys
from numba.core import event
import numpy as np
import pgfmd
from pgfmd.grid import kernels
from pgfmd.observables.statistics.kernels import histogram

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
histogram(half, np.arange(3.0), 0, 4, np.zeros(2, int))
print(*Count.names)
"""


LOOPS = ("rows_and_tiles", "tiles_and_columns", "histogram", "find_bin")


@pytest.mark.parametrize("count", [1, 3])
def test_a_loop_is_compiled_by_one_process(tmp_path, count):
    """However many processes begin together with an empty cache, each loop is compiled by one of them; the others wait
    for it and load it.  A process after them compiles nothing."""
    environment = os.environ | {"PGFMD_CACHE": str(tmp_path)}

    def start() -> subprocess.Popen:
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        return subprocess.Popen([sys.executable, "-c", COMPILE], env=environment, **pipes)

    def names(run: subprocess.Popen) -> list[str]:
        found = run.communicate("go\n", timeout=120)[0].split()
        assert run.returncode == 0
        return found

    together = [start() for _ in range(count)]
    assert all(run.stdout.readline() == "ready\n" for run in together)
    for run in together:
        run.stdin.write("go\n")
        run.stdin.flush()
    compiled = [name for run in together for name in names(run)]
    assert sorted(name for name in compiled if name in LOOPS) == sorted(LOOPS)
    assert names(start()) == ["ready"]


@pytest.mark.parametrize(("taken", "held"), [(fcntl.LOCK_EX, True), (fcntl.LOCK_SH, False)])
def test_who_looks_for_a_lock_is_not_taken_for_its_holder(tmp_path, taken, held):
    """All ranks but the first of a node look, until the first has it, with a lock that others may share."""
    with open(tmp_path / "lock", "w+") as other, open(tmp_path / "lock", "w+") as mine:
        fcntl.flock(other, taken)
        assert private_cache.is_held(mine) == held
        fcntl.flock(other, fcntl.LOCK_UN)
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)  # who has looked leaves no lock


def test_other_ranks_take_a_lock_that_the_first_leaves(tmp_path, monkeypatch):
    """After its head start."""
    monkeypatch.setenv("OMPI_COMM_WORLD_LOCAL_RANK", "1")
    with private_cache.lock(tmp_path / "lock", 0.02), open(tmp_path / "lock", "w+") as other:
        assert private_cache.is_held(other)


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
    environment = os.environ | {"PGFMD_CACHE": str(tmp_path / "cache"), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, tmp_path / "fail.py"]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert run.stdout == "free\n", run.stderr


EDITED = """
import sys, time
import numpy as np
from pgfmd.parallel import private_cache
private_cache.keep_compiled_code()
from numba.core import caching
sys.path.insert(0, sys.argv[1])
import loop
save = caching.IndexDataCacheFile._save_index

def slow(self, overloads):
    save(self, overloads)
    print("saved", flush=True)
    time.sleep(2)

loop.other(1.0)  # so that the call below has nothing else to wait for
if sys.argv[2] == "slow":
    caching.IndexDataCacheFile._save_index = slow
print("ready", flush=True)
sys.stdin.readline()
print(loop.total(np.ones(3, sys.argv[3])), flush=True)
"""


def test_code_of_an_older_source_is_not_run(tmp_path):
    """While a process compiles a loop whose source has changed, and has written its index but not yet its code, another
    that needs the loop waits for the new code: it neither runs the old one nor fails for its types.
    """
    environment, source = os.environ | {"PGFMD_CACHE": str(tmp_path)}, tmp_path / "loop.py"
    text = "from pgfmd.parallel.compiled import compiled\n@compiled()\ndef other(x):\n    return x\n"
    text += "@compiled()\ndef total(a):\n    return {} * a.sum()\n"

    def start(speed: str, dtype: str) -> subprocess.Popen:
        words = [sys.executable, "-c", EDITED, str(tmp_path), speed, dtype]
        run = subprocess.Popen(words, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert run.stdout.readline() == "ready\n"
        return run

    def result(run: subprocess.Popen) -> str:
        return run.communicate("go\n", timeout=60)[0]

    source.write_text(text.format(2))
    assert result(start("fast", "float64")) == "6.0\n"
    source.write_text(text.format(10))  # of another length: files are told apart by that, too
    slow, other = start("slow", "float32"), start("fast", "float32")
    slow.stdin.write("go\n")
    slow.stdin.flush()
    assert slow.stdout.readline() == "saved\n"
    assert result(other) == "30.0\n"
    assert slow.communicate(timeout=60)[0] == "30.0\n"
