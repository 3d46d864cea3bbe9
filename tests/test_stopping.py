"""Runs that are asked to stop: by a signal, a file, a clock.  They end at once, with 75, and go on with --restart."""

from __future__ import annotations

import os
import signal
import time

import launching
import pytest
from conftest import SIZE, WORLD

from pgfmd.errors import Stopped
from pgfmd.io.results import Results
from pgfmd.run.stop import Watch

MANY = [1e-3 + 1e-6 * number for number in range(2000)]  # loads: more than can be solved while the test looks on


class Clock:
    """A clock that is set by hand, in place of the real one."""

    def __init__(self):
        self.time = 1000.0

    def __call__(self) -> float:
        return self.time


def watch_at(comm, folder, interval=1e9, time_limit=1e9) -> tuple[Watch, Clock]:
    """A watch with a clock of its own."""
    clock = Clock()
    return Watch(comm, folder, interval, time_limit, clock), clock


def completed(folder) -> int:
    """Loads in a folder, which may not be there yet."""
    return len(Results(folder)) if (folder / "observables.h5").exists() else 0


@pytest.mark.mpi
def test_checkpoints_on_the_clock(comm, shared_tmp_path):
    """One checkpoint per interval, counted from the last one or from a completed load; interval 0: at each look."""
    for interval, expected in ((10.0, [False, True, False, True, False]), (0.0, 5 * [True])):
        watch, clock = watch_at(comm, shared_tmp_path, interval)
        found = []
        for seconds in (9.0, 2.0, 9.0, 2.0, 9.0):
            clock.time += seconds if comm.rank == 0 else 0  # the clocks of the others do not count
            saved = []
            watch.look(lambda saved=saved: saved.append(True))
            found.append(bool(saved))
        assert found == expected
        clock.time += 5
        watch.load_done()
        clock.time += 9
        if interval:
            watch.look(pytest.fail)


@pytest.mark.mpi
def test_time_limit_leaves_time_to_save(comm, shared_tmp_path):
    """With steps of 3 s and a limit of 60 s a run stops in time for two more steps, and no earlier."""
    watch, clock = watch_at(comm, shared_tmp_path, time_limit=60.0)
    began = clock.time
    with pytest.raises(Stopped, match="time limit of the job"):
        while True:
            clock.time += 3
            watch.look()
    assert 45 < clock.time - began <= 54


@pytest.mark.mpi
def test_limit_of_the_batch_job(comm, shared_tmp_path, monkeypatch):
    """SLURM's end of the job counts, in seconds since 1970."""
    monkeypatch.setenv("SLURM_JOB_END_TIME", str(int(time.time()) + 1))
    watch, _ = watch_at(comm, shared_tmp_path)
    with pytest.raises(Stopped, match="batch job"):
        watch.look()


@pytest.mark.mpi
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGUSR1])
def test_signal_to_any_rank_stops_all(comm, shared_tmp_path, number):
    """A signal that reaches the last rank only stops all ranks, after a checkpoint; the old handler comes back."""
    before = signal.getsignal(number)
    saved = []
    watch, _ = watch_at(comm, shared_tmp_path)
    with watch:
        if comm.rank == comm.size - 1:
            os.kill(os.getpid(), number)
        with pytest.raises(Stopped, match=number.name):
            watch.look(lambda: saved.append(True))
    assert saved and signal.getsignal(number) is before


@pytest.mark.mpi
def test_full_disk(comm, shared_tmp_path):
    """A checkpoint on the clock that cannot be written is a warning; one at the end is an error."""

    def full():
        raise OSError(28, "No space left on device")

    watch, _ = watch_at(comm, shared_tmp_path, interval=0.0)
    watch.look(full)
    with watch:
        comm.Barrier()
        if comm.rank == 0:
            watch.stop_file.touch()
        with pytest.raises(OSError, match="No space"):
            watch.look(full)


@pytest.mark.skipif(SIZE > 1 or WORLD is None, reason="starts mpirun itself")
@pytest.mark.parametrize("how", ["SIGUSR1", "SIGTERM", "STOP", "time limit"])
def test_stop_and_go_on(tmp_path, how):
    """A run that is asked to stop ends within seconds, with 75 and one line, and goes on where it was."""
    folder = tmp_path / "out"
    job = launching.write_job(tmp_path / "job.toml", 64, lambda_s=8, pressures=MANY)
    environment = {"SLURM_JOB_END_TIME": str(int(time.time()) + 45)} if how == "time limit" else {}
    run = launching.start(2, "run", job, "--output", folder, environment=environment)
    end = time.monotonic() + 240
    while completed(folder) < 1:
        assert time.monotonic() < end and run.poll() is None
        time.sleep(0.2)
    asked = time.monotonic()
    if how == "STOP":
        (folder / "STOP").touch()
    elif how == "SIGUSR1":
        run.send_signal(signal.SIGUSR1)  # mpirun hands it on
    elif how == "SIGTERM":  # to a rank: mpirun itself would follow it by SIGKILL
        os.kill(launching.ranks_of(run)[0], signal.SIGTERM)
    code, stderr = launching.wait(run, 120)
    assert time.monotonic() - asked < 60
    said = [line for line in stderr.splitlines() if line.startswith("pgfmd:")]
    assert code == 75 and len(said) == 1 and how in said[0] and "Traceback" not in stderr
    read = Results(folder)
    assert read.status == "stopped" and 1 <= len(read) < len(MANY)
    (folder / "STOP").touch()  # one from before does not stop the run that is to go on
    again = launching.start(1, "run", job, "--output", folder, "--restart")
    done, end = len(read), time.monotonic() + 240
    while completed(folder) <= done:
        assert time.monotonic() < end and again.poll() is None
        time.sleep(0.2)
    launching.kill(again)
    launching.wait(again)
