"""The batch scripts, with stand-ins for the batch system: stopped in time, queued again, finished."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time

import launching
import pytest
from conftest import ROOT, broad, starts_mpirun

from pgfmd.application.results import Results

pytestmark = starts_mpirun

LOADS = [1e-3 + 1e-6 * number for number in range(2000)]


def batch(tmp_path, script: str, *arguments, **variables) -> subprocess.Popen:
    """A batch script, its batch system replaced by stand-ins that note what they were asked."""
    bin = tmp_path / "bin"
    bin.mkdir(exist_ok=True)
    for name in ("scontrol", "qsub"):
        (bin / name).write_text(f'#!/bin/sh\necho {name} "$@" >>"{tmp_path}/asked"\n')
        (bin / name).chmod(0o755)
    environment = dict(os.environ) | {
        "PATH": f"{bin}:{os.environ['PATH']}", "PYTHON": sys.executable, "PGFMD_ROOT": str(ROOT),
        "LAUNCH": "mpirun -n 2", "SLURM_CPUS_PER_TASK": "1", "SLURM_JOB_ID": "77", "PBS_O_WORKDIR": str(ROOT),
    } | variables  # fmt: skip
    command = ["bash", str(ROOT / "jobs" / script), *map(str, arguments)]
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True)


def completed(folder) -> int:
    """Loads in a folder, which may not be there yet."""
    return len(Results(folder)) if (folder / "observables.h5").exists() else 0


@pytest.mark.breadth
def test_slurm_job_is_requeued(tmp_path):
    """SIGUSR1 to the script, as SLURM sends it: the run of an array's task ends with 75 and is queued again."""
    job = launching.write_job(tmp_path / "a job.toml", 64, lambda_s=8, pressures=LOADS)
    script = batch(tmp_path, "slurm.sh", job, tmp_path / "out", SLURM_ARRAY_TASK_ID="5")
    folder, end = tmp_path / "out" / "seed-5", time.monotonic() + 300
    while not completed(folder):
        assert script.poll() is None and time.monotonic() < end
        time.sleep(0.2)
    script.send_signal(signal.SIGUSR1)
    code, stderr = launching.wait(script, 300)
    assert code == 75, stderr
    assert (tmp_path / "asked").read_text() == "scontrol requeue 77\n"
    assert Results(folder).status == "stopped" and Results(folder).job["surface"]["seed"] == 5


def ends_with(tmp_path, code: int) -> dict[str, str]:
    """Variables that replace the run by a program that notes its arguments and ends with that code."""
    program = tmp_path / "python"
    program.write_text(f'#!/bin/sh\necho "$@" >"{tmp_path}/called"\nexit {code}\n')
    program.chmod(0o755)
    return {"PYTHON": str(program), "LAUNCH": "env"}


def test_pbs_job_is_submitted_again(tmp_path):
    """A run that ends with 75 at its time limit is submitted again with the same job, folder, limit and seed."""
    variables = {"JOB": "job.toml", "DIR": f"{tmp_path}/out", "PBS_ARRAY_INDEX": "3", "LIMIT": "60"}
    code, stderr = launching.wait(batch(tmp_path, "pbs.sh", **variables, **ends_with(tmp_path, 75)), 60)
    assert code == 75, stderr
    called = f"run job.toml --output {tmp_path}/out/seed-3 --restart --set run.time_limit=60 --set surface.seed=3\n"
    assert (tmp_path / "called").read_text() == "-m mpi4py -m pgfmd " + called
    asked = f"qsub -v JOB=job.toml,DIR={tmp_path}/out,LIMIT=60,SEED=3 {ROOT}/jobs/pbs.sh\n"
    assert (tmp_path / "asked").read_text() == asked


@pytest.mark.parametrize("name", broad(["slurm.sh", "pbs.sh"], 0))
def test_a_stop_file_ends_it(tmp_path, name):
    """STOP is the user's word: the run ends with 75, is not queued again, and the file stays."""
    job = launching.write_job(tmp_path / "job.toml", 64, lambda_s=8, pressures=LOADS)
    folder, end = tmp_path / "out", time.monotonic() + 240
    words = (job, folder) if name == "slurm.sh" else ()
    script = batch(tmp_path, name, *words, JOB=str(job), DIR=str(folder))
    while not completed(folder):
        assert script.poll() is None and time.monotonic() < end
        time.sleep(0.2)
    (folder / "STOP").touch()
    code, stderr = launching.wait(script, 300)
    assert code == 75, stderr
    assert not (tmp_path / "asked").exists() and (folder / "STOP").exists()


@pytest.mark.parametrize("name", ["slurm.sh", "pbs.sh"])
def test_no_progress_no_queue(tmp_path, name):
    """A run that ends with 1, as one whose time limit allows no progress does, does not go round for ever."""
    script = batch(tmp_path, name, "job.toml", tmp_path / "out", JOB="job.toml", DIR="out", **ends_with(tmp_path, 1))
    assert launching.wait(script, 60)[0] == 1
    assert not (tmp_path / "asked").exists()


@pytest.mark.skipif(shutil.which("shellcheck") is None, reason="needs shellcheck")
def test_scripts_are_clean():
    """shellcheck finds nothing in the batch scripts."""
    scripts = [ROOT / "jobs" / name for name in ("slurm.sh", "pbs.sh", "scaling.sh", "acceptance.sh")]
    done = subprocess.run(["shellcheck", "-x", *map(str, scripts)], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
