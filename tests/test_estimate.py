"""What `check` predicts, against what a run takes."""

from __future__ import annotations

import subprocess
import sys

import pytest

from pgfmd.job import job
from pgfmd.run import estimate
from pgfmd.run.estimate import PER_RANK, bytes_per_point
from pgfmd.solvers.active_set import nested_iteration

SMALL, N = 384, 2048  # both large enough for every part of the solver, so that the first compiles what there is

JOB = """
[grid]
n = {n}
[surface]
kind = "self-affine"
hurst = 0.8
lambda_s = 16.0
rms_slope = 0.031
[wall]
{wall}
[load]
pressure = [{pressure}]
[solver]
tolerance = 1e-3
[output]
fields = ["pressure"]
"""

# The peak of the resident memory counts from after a small run, so that the interpreter and its libraries do not.
MEASURE = """
import ctypes, gc, sys, tempfile
from mpi4py import MPI
from pgfmd.job.job import parse
from pgfmd.simulate import simulate

def peak():
    lines = open("/proc/self/status").read().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))

small, large = sys.stdin.read().split("====")
with tempfile.TemporaryDirectory() as folder:
    simulate(parse(small), MPI.COMM_WORLD, folder + "/small")
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    open("/proc/self/clear_refs", "w").write("5")
    before = peak()
    simulate(parse(large), MPI.COMM_WORLD, folder + "/large")
    print(peak() - before)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads the peak of the memory from /proc")
@pytest.mark.parametrize(
    ("wall", "pressure"),
    [
        ('kind = "hard"', 0.0032),
        ('kind = "hard"', 0.012),
        ('kind = "hard"', 0.024),
        ('kind = "hard"', 0.04),
        ('kind = "exponential"\nzeta = 0.25', 0.0032),
    ],
)
def test_memory_is_predicted(wall, pressure, monkeypatch):
    """The peak of a whole run (surface, solve, write) is within 10 % of what `check` says, at any contact area."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    jobs = [JOB.format(n=n, wall=wall, pressure=pressure) for n in (SMALL, N)]
    expected = bytes_per_point(job.parse(jobs[1])) * N**2 + PER_RANK
    for _ in range(3):  # the first may compile, whose memory counts until it is cached
        out = subprocess.run(
            [sys.executable, "-c", MEASURE], input="====".join(jobs), capture_output=True, text=True, check=True
        ).stdout
        if (measured := float(out.split()[-1])) < 1.1 * expected:
            break
    assert measured == pytest.approx(expected, rel=0.1)


def test_gaps_are_the_unknowns_from_the_same_area():
    """What `check` takes for the share of contact above which gaps are the unknowns is what the solver takes."""
    assert estimate.MOSTLY == nested_iteration.MOSTLY
