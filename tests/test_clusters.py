"""Many ranks on few cores, messages over TCP, two hosts, batch scripts with stand-ins for the batch system."""

import os
import shutil
import signal
import subprocess
import sys
from contextlib import ExitStack, contextmanager

import launching
import numpy as np
import pytest
from conftest import ROOT, broad, starts_mpirun

from pgfmd.application.results import Results

pytestmark = starts_mpirun

SAME = 1e-10  # relative L2 of pressures that are solved to a certified energy error of 1e-12
# Every message through the network layer, none through shared memory, and strips that are exchanged in messages too.
TCP = {"OMPI_MCA_btl": "tcp,self", "OMPI_MCA_pml": "ob1", "OMPI_MCA_osc": "^sm"}
EXCHANGED = """
import functools, sys
from pgfmd.application import simulate
simulate.SlabGrid = functools.partial(simulate.SlabGrid, transform="exchanged")
from pgfmd.application.cli import main
sys.exit(main())
"""


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """A job of 75 × 67 points, so that no rank count divides it, two loads; and its result on one rank."""
    folder = tmp_path_factory.mktemp("many")
    job = launching.write_job(folder / "job.toml", [75, 67], lambda_s=8, pressures=[1e-3, 1e-2], interval=1e9)
    (folder / "exchanged.py").write_text(EXCHANGED)
    launching.run_to_end(1, "run", job, "--output", folder / "one")
    return folder


@pytest.mark.parametrize("ranks", [*broad([5, 8], 0), pytest.param(16, marks=pytest.mark.long)])
def test_many_ranks(case, tmp_path, ranks):
    """On 5 and 8 (with `--all`) and 16 ranks (with `--long`) of unequal slabs the pressure is that of one rank."""
    launching.run_to_end(ranks, "run", case / "job.toml", "--output", tmp_path / "out", timeout=300)
    assert launching.distance(tmp_path / "out", case / "one")[1] < SAME


@pytest.mark.breadth
@pytest.mark.parametrize("ranks", [3, *(pytest.param(count, marks=pytest.mark.long) for count in (8, 16))])
def test_over_tcp(case, tmp_path, ranks):
    """The same with every message over TCP and strips that cross in an all-to-all."""
    how = {"script": (case / "exchanged.py",), "environment": TCP}
    launching.run_to_end(ranks, "run", case / "job.toml", "--output", tmp_path / "out", timeout=300, **how)
    assert launching.distance(tmp_path / "out", case / "one")[1] < SAME


MANY = """
import sys
import numpy as np
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.mpi import world
from pgfmd.physics.laws.hard import HardWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.physics.solids.homogeneous import Homogeneous
from pgfmd.solvers.active_set.contact_from_coarse import solve_hard_wall
from pgfmd.surfaces.self_affine import self_affine
n, path = int(sys.argv[1]), sys.argv[2]
grid = SlabGrid(world(), (n, n))
heights, solid = self_affine(grid, 0.8, 8.0, 0.031, 1), Homogeneous(contact_modulus=2.66667)
problem = ContactProblem(grid, heights, solid, HardWall(), 0.0036)
found = solve_hard_wall(problem, 1e-22)
rows = grid.comm.gather(found.pressure)
if rows is not None:
    np.savez(path, pressure=np.concatenate(rows), work=[found.iterations, found.transforms])
"""


LONG = [pytest.param(n, ranks, marks=pytest.mark.long) for n in (256, 128) for ranks in (4, 16, 64, 128)]


@pytest.mark.parametrize(("n", "ranks"), [pytest.param(128, 12, marks=pytest.mark.breadth), *LONG])
def test_thin_slabs_take_no_more_work(tmp_path, n, ranks):
    """Down to one row per rank, the pressure is that of one rank to 1e-10; iterations and transforms are within 5 %."""
    (tmp_path / "solve.py").write_text(MANY)
    for count in (1, ranks):
        launching.run_to_end(count, n, tmp_path / f"{count}.npz", script=(tmp_path / "solve.py",))
    one, many = (np.load(tmp_path / f"{count}.npz") for count in (1, ranks))
    assert np.linalg.norm(many["pressure"] - one["pressure"]) < SAME * np.linalg.norm(one["pressure"])
    assert np.allclose(many["work"], one["work"], rtol=0.05, atol=0)


def sudo(*command: str) -> bool:
    """Whether a command of the system's administrator went well."""
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


@contextmanager
def two_hosts(folder):
    """Two network namespaces joined by a cable: addresses of the two, and an agent that starts a program on one."""
    names = [f"pgfmd{os.getpid()}{side}" for side in "ab"]
    addresses = ["10.77.66.1", "10.77.66.2"]
    with ExitStack() as undo:
        for name in names:
            if os.geteuid() != 0 or not sudo("ip", "netns", "add", name):
                pytest.skip("needs the right to make network namespaces")
            undo.callback(sudo, "ip", "netns", "del", name)
        pair = ["ip", "link", "add", "pgfmd0", "netns", names[0], "type", "veth", "peer", "pgfmd0", "netns", names[1]]
        if not sudo(*pair):
            pytest.skip("needs veth devices")
        for name, address in zip(names, addresses, strict=True):
            inside = ("ip", "-n", name)
            assert sudo(*inside, "addr", "add", f"{address}/24", "dev", "pgfmd0")
            assert sudo(*inside, "link", "set", "pgfmd0", "up") and sudo(*inside, "link", "set", "lo", "up")
        # What mpirun calls in place of ssh: HOST COMMAND…; each host has a name of its own.
        agent = folder / "agent.sh"
        cases = "\n".join(f"{address}) ns={name} ;;" for name, address in zip(names, addresses, strict=True))
        agent.write_text(
            f'#!/bin/bash\nwhile [[ $1 == -* ]]; do shift; done\nhost=$1; shift\ncase $host in\n{cases}\nesac\n'
            'exec ip netns exec "$ns" unshare --uts bash -c "hostname $ns; $*"\n'
        )  # fmt: skip
        agent.chmod(0o755)
        yield names, addresses, agent


@pytest.mark.breadth
def test_two_hosts(case, tmp_path):
    """Two network namespaces stand for two hosts with two ranks each: they see two nodes, and agree with one rank."""
    with two_hosts(tmp_path) as (names, addresses, agent):
        mpirun = (
            f"source {ROOT}/tools/env.sh; hostname {names[0]}; exec mpirun --mca plm_rsh_agent {agent} "
            f"--mca btl tcp,self --mca pml ob1 --mca btl_tcp_if_include 10.77.66.0/24 "
            f"--mca oob_tcp_if_include 10.77.66.0/24 -n 4 --host {addresses[0]}:2,{addresses[1]}:2 "
            f'{sys.executable} -m mpi4py -m pgfmd run "{case}/job.toml" --output "{tmp_path}/out"'
        )
        command = ["ip", "netns", "exec", names[0], "unshare", "--uts", "bash", "-c", mpirun]
        environment = dict(os.environ)  # as it was before MPI was initialised here, which confuses another mpirun
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=300, cwd=ROOT, check=False, env=environment
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "4 ranks on 2 nodes" in done.stderr
    assert launching.distance(tmp_path / "out", case / "one")[1] < SAME


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


@pytest.mark.breadth
def test_slurm_job_is_requeued(tmp_path):
    """SIGUSR1 to the script, as SLURM sends it: the run of an array's task ends with 75 and is queued again."""
    job = launching.write_job(tmp_path / "a job.toml", 64, lambda_s=8, pressures=LOADS)
    script = batch(tmp_path, "slurm.sh", job, tmp_path / "out", SLURM_ARRAY_TASK_ID="5")
    folder = tmp_path / "out" / "seed-5"
    launching.until_loads(script, folder)
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
    folder = tmp_path / "out"
    words = (job, folder) if name == "slurm.sh" else ()
    script = batch(tmp_path, name, *words, JOB=str(job), DIR=str(folder))
    launching.until_loads(script, folder)
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
