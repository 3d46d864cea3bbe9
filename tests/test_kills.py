"""Runs that are killed at random moments, and go on."""

from __future__ import annotations

import contextlib
import random
import subprocess
import time

import launching
import pytest
from conftest import SIZE

pytestmark = pytest.mark.skipif(SIZE > 1, reason="starts mpirun itself")

SAME = 1e-10  # relative L2 of the pressure; solved to a certified energy error of 1e-12, measured 1e-12


def campaign(tmp_path, n: int, kills: int, interval: float):
    """Runs of six loads, each killed at a random moment, restarted on 1 to 3 ranks, killed again …, until it gets
    through; until there were so many kills.  Every load that a run leaves behind is compared with an undisturbed run.
    """
    chance = random.Random(time.time_ns())
    job = launching.write_job(tmp_path / "job.toml", n, lambda_s=n / 64, interval=interval)
    began = time.monotonic()
    code, stderr = launching.wait(launching.start(2, "run", job, "--output", tmp_path / "reference"), 900)
    assert code == 0, stderr
    length = time.monotonic() - began
    done = runs = 0
    while done < kills:
        folder, runs = tmp_path / f"run {runs}", runs + 1
        while True:
            ranks = chance.choice([1, 2, 2, 3])
            run = launching.start(ranks, "run", job, "--output", folder, "--restart")
            moment = chance.uniform(0.3, 0.7 * length) if done < kills else 900
            with contextlib.suppress(subprocess.TimeoutExpired):
                assert run.wait(moment) == 0, run.stderr.read()
                break
            way = chance.choice(["one", "all", "mpirun"])
            launching.kill(run, way, chance.choice)
            code, stderr = launching.wait(run)
            if code == 0:  # it was ending just then
                break
            done += 1
            there, found = launching.distance(folder, tmp_path / "reference", complete=False)
            saved = (folder / "checkpoint.h5").exists()
            print(
                f"kill {done:2}, {way:6} of {ranks} ranks, {moment:5.1f} s: {there} loads, differing by {found:.0e}"
                + " + checkpoint" * saved,
                flush=True,
            )  # fmt: skip
            assert found < SAME
        there, found = launching.distance(folder, tmp_path / "reference")
        print(f"run {runs} complete, pressures differ by {found:.1e}", flush=True)
        assert found < SAME
        assert not list(folder.glob("**/.*tmp")) and not (folder / "checkpoint.h5").exists()


def test_killed_runs_go_on(tmp_path):
    """Killed at a random moment, one rank, all, or by mpirun: restarted on any rank count, the result is that of an
    undisturbed run.
    """
    campaign(tmp_path, 128, 4, 0.1)


@pytest.mark.long
def test_thirty_kills(tmp_path):
    """The same for 30 kills of 1024² runs."""
    campaign(tmp_path, 1024, 30, 0.5)
