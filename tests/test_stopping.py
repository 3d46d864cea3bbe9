"""Runs that are asked to stop: by a signal, a file, a clock.  They end at once, with 75, and go on with --restart."""

import os
import signal
import time
from types import SimpleNamespace

import launching
import pytest
from conftest import broad, once, starts_mpirun

from pgfmd.application import stop
from pgfmd.application.results import Results
from pgfmd.application.stop import Interruptions
from pgfmd.errors import NoProgress, Stopped
from pgfmd.parallel.collectives import raise_together

MANY = [1e-3 + 1e-6 * number for number in range(2000)]  # loads: more than can be solved while the test looks on


class Clock:
    """A clock that is set by hand, in place of the real one."""

    def __init__(self):
        self.time = 1000.0

    def __call__(self) -> float:
        return self.time


def interruptions_at(comm, folder, interval=1e9, time_limit=1e9) -> tuple[Interruptions, Clock]:
    """One with a clock of its own."""
    clock = Clock()
    return Interruptions(comm, folder, interval, time_limit, clock), clock


@pytest.mark.mpi
def test_checkpoints_on_the_clock(comm, shared_tmp_path):
    """One checkpoint per interval, counted from the last one or from a completed load; interval 0: at each look."""
    for interval, expected in ((10.0, [False, True, False, True, False]), (0.0, 5 * [True])):
        run, clock = interruptions_at(comm, shared_tmp_path, interval)
        found = []
        for seconds in (9.0, 2.0, 9.0, 2.0, 9.0):
            clock.time += seconds if comm.rank == 0 else 0  # the clocks of the others do not count
            saved = []
            run.between_steps(lambda saved=saved: saved.append(True))
            found.append(bool(saved))
        assert found == expected
        clock.time += 5
        run.load_done()
        clock.time += 9
        if interval:
            run.between_steps(pytest.fail)


@pytest.mark.mpi
def test_time_limit_leaves_time_to_save(comm, shared_tmp_path):
    """With steps of 3 s and a limit of 60 s a run stops in time for two more steps, and no earlier."""
    run, clock = interruptions_at(comm, shared_tmp_path, time_limit=60.0)
    began = clock.time
    with pytest.raises(Stopped, match="time limit of the job"):
        while True:
            clock.time += 3
            run.between_steps(lambda: None)
    assert 45 < clock.time - began <= 54


@pytest.mark.mpi
@pytest.mark.parametrize("resumed", [False, True])
@pytest.mark.parametrize("how", ["time limit", "STOP"])
def test_no_progress(comm, shared_tmp_path, resumed, how):
    """A time limit that ends a run before it could save more than it began with is no reason to go on: the same would
    happen each time.  Whoever asks by a file gets the usual answer.  The first step from a checkpoint is not new."""
    run, clock = interruptions_at(comm, shared_tmp_path, time_limit=60.0)
    run.load_begins(resumed)
    comm.Barrier()
    if how == "STOP" and comm.rank == 0:
        run.stop_file.touch()
    clock.time += 59
    with pytest.raises(NoProgress if how == "time limit" else Stopped, match=how):
        run.between_steps()  # on a coarse grid, of which no checkpoint can be made
    with pytest.raises(NoProgress if resumed and how == "time limit" else Stopped):
        run.between_steps(lambda: None)
    with pytest.raises(Stopped):
        run.between_steps(lambda: None)


@pytest.mark.mpi
def test_stop_files(comm, shared_tmp_path):
    """An old STOP file counts only when it is touched again, and stays; a batch script's is removed before the run."""
    stop, batch = shared_tmp_path / "STOP", shared_tmp_path / ".pgfmd.stop"
    if comm.rank == 0:
        stop.write_text("not yours")
        os.utime(stop, (1, 1))
        batch.touch()
    comm.Barrier()
    run, _ = interruptions_at(comm, shared_tmp_path)
    with run:
        run.between_steps()
        assert not batch.exists()
        comm.Barrier()
        for path in (stop, batch):
            if comm.rank == 0:
                path.touch()
            with pytest.raises(Stopped, match=path.name):
                run.between_steps()
            once(comm, os.utime, stop, (1, 1))
    assert stop.read_text() == "not yours"


@pytest.mark.mpi
def test_limit_of_the_batch_job(comm, shared_tmp_path, monkeypatch):
    """SLURM's end of the job counts, in seconds since 1970."""
    monkeypatch.setattr(stop, "time", SimpleNamespace(time=lambda: 1e9, monotonic=time.monotonic))
    monkeypatch.setenv("SLURM_JOB_END_TIME", "1000000001")
    run, _ = interruptions_at(comm, shared_tmp_path)
    with pytest.raises(Stopped, match="batch job"):
        run.between_steps(lambda: None)


@pytest.mark.mpi
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGUSR1, signal.SIGINT, signal.SIGHUP])
def test_signal_to_any_rank_stops_all(comm, shared_tmp_path, number):
    """A signal that reaches the last rank only stops all ranks, after a checkpoint; the old handler comes back."""
    before = signal.getsignal(number)
    saved = []
    run, _ = interruptions_at(comm, shared_tmp_path)
    with run:
        if comm.rank == comm.size - 1:
            os.kill(os.getpid(), number)
        with pytest.raises(Stopped, match=number.name):
            run.between_steps(lambda: saved.append(True))
    assert saved and signal.getsignal(number) is before


@pytest.mark.mpi
def test_ignored_signals_stay_ignored(comm, shared_tmp_path):
    """Under nohup, or in the background of a script, nothing changes that."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        run, _ = interruptions_at(comm, shared_tmp_path)
        with run:
            os.kill(os.getpid(), signal.SIGHUP)
            run.between_steps(pytest.fail)
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.mpi
def test_full_disk(comm, shared_tmp_path):
    """A checkpoint on the clock that all ranks or one cannot write is a warning on all; one at the end is an error."""

    def full(failing=range(comm.size)):
        with raise_together(comm):
            if comm.rank in failing:
                raise OSError(28, "No space left on device")

    run, _ = interruptions_at(comm, shared_tmp_path, interval=0.0)
    run.between_steps(full)
    run.between_steps(lambda: full([comm.size - 1]))
    with run:
        comm.Barrier()
        if comm.rank == 0:
            run.stop_file.touch()
        with pytest.raises(OSError, match="No space"):
            run.between_steps(lambda: full([comm.size - 1]))


@starts_mpirun
@pytest.mark.parametrize("how", broad(["SIGUSR1", "SIGTERM", "STOP"]))
def test_stop_and_go_on(tmp_path, how):
    """A run that is asked to stop ends with 75 and one line, and goes on where it was."""
    folder = tmp_path / "out"
    job = launching.write_job(tmp_path / "job.toml", 64, lambda_s=8, pressures=MANY)
    run = launching.start(2, "run", job, "--output", folder)
    launching.until_loads(run, folder)
    if how == "STOP":
        (folder / "STOP").touch()
    elif how == "SIGUSR1":
        run.send_signal(signal.SIGUSR1)  # mpirun hands it on
    elif how == "SIGTERM":  # to a rank: mpirun itself would follow it by SIGKILL
        os.kill(launching.ranks_of(run)[0], signal.SIGTERM)
    code, stderr = launching.wait(run, 120)
    said = [line for line in stderr.splitlines() if line.startswith("pgfmd:")]
    assert code == 75 and len(said) == 1 and how in said[0] and "Traceback" not in stderr
    read = Results(folder)
    assert read.status == "stopped" and 1 <= len(read) < len(MANY)
    (folder / "STOP").touch()  # one from before does not stop the run that is to go on
    again = launching.start(1, "run", job, "--output", folder, "--restart")
    launching.until_loads(again, folder, len(read) + 1)
    launching.kill(again)
    launching.wait(again)
