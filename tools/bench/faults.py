"""Random errors on one rank, at random calls of the library and of the application.

    python tools/bench/faults.py --count 200 --seed 1

Each run must end within 30 s of the error, with one message and no traceback; every load in its folder is that of an
undisturbed run, of the earlier job or of the new one.  An error that costs only a checkpoint may leave the run
complete.
"""

import argparse
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))
import launching
from job_texts import rough_job

from pgfmd.application.results import Results
from pgfmd.errors import InputError

LIMIT = 30.0  # seconds from the error to the end of the last rank
CALLS = {  # functions, and the largest number of a call that fails
    "grid.transpose:SharedStrips.put": 60, "grid.transpose:SharedStrips.meet": 60,
    "grid.transforms:Transform.columns": 30,
    "grid.transfer:SubGrid.coarse": 4, "parallel.layout:Exchange.start": 30, "parallel.layout:Exchange.carry_out": 30,
    "parallel.collectives:Reduction.sums": 60, "physics.problem:ContactProblem.__init__": 8,
    "solvers.active_set.active_set:contact_sums": 20, "solvers.dispatch:_certified": 2,
    "solvers.solution:ContactSolution.__post_init__": 3, "surfaces.self_affine:SelfAffine.heights": 1,
    "observables.contact:Contact.measure": 2, "observables.contact:Contact.fields": 2,
    "application.hdf5_slabs:Field.block": 6, "application.files:commit": 6, "application.files:reserve": 3,
    "application.files:OutputFolder.__init__": 1, "application.writer:ResultWriter.write_load": 2,
    "application.writer:ResultWriter._replace": 4, "application.writer:ResultWriter.finish": 1,
    "application.loads:Checkpoints.save": 3, "application.loads:Loads.solve": 2,
    "application.loads:Loads.write": 2,
    "application.stop:Interruptions.between_steps": 10, "application.machine:report": 1,
    "application.ensemble:write": 2, "application.ensemble_run:_refuse_others": 1, "application.job:load": 1,
}  # fmt: skip
ERRORS = ("OSError(28, 'the last straw')", "MemoryError('the last straw')", "InputError('the last straw')",
          "KeyboardInterrupt('the last straw')")  # fmt: skip
SCRIPT = """
import importlib, sys, time, types
from pathlib import Path
from mpi4py import MPI
from pgfmd.application import cli, ensemble_run, simulate
from pgfmd.errors import InputError
from pgfmd.parallel import mpi
mpi.PATIENCE = 2.0
owner = module = importlib.import_module("pgfmd.{module}")
*path, name = "{name}".split(".")
for part in path:
    owner = getattr(owner, part)
original, calls = getattr(owner, name), []
def failing(*arguments, **options):
    calls.append(1)
    if MPI.COMM_WORLD.rank == {rank} and len(calls) == {call}:
        Path({mark!r}).write_text(str(time.time()))
        raise {error}
    return original(*arguments, **options)
setattr(owner, name, staticmethod(failing) if path and isinstance(vars(owner).get(name), classmethod) else failing)
for each in list(sys.modules.values()):
    if getattr(each, "__name__", "").startswith("pgfmd") and not path and getattr(each, name, None) is original:
        setattr(each, name, failing)
ensemble_run.Plan = lambda _: types.SimpleNamespace(rank_groups=lambda *_: {groups})
sys.exit(cli.main())
"""


def job(seeds: list[int], pressures: list[float]) -> str:
    """The TOML text of a small job, of one surface if there is one seed."""
    surface = {"lambda_s": 8.0, "rms_slope": 0.03, "seed": seeds if len(seeds) > 1 else seeds[0]}
    return rough_job(48, surface, load={"pressure": pressures}, solver={"tolerance": 1e-20},
                     output={"fields": ["pressure"]}, run={"checkpoint_interval": 0.0})  # fmt: skip


OLD, NEW = [1e-3, 3e-3], [5e-4, 2e-3]
SEEDS = [1, 2]


def run_alone(path: Path, text: str, out: Path) -> None:
    """A job on one rank, without an error."""
    path.write_text(text)
    subprocess.run([sys.executable, "-m", "pgfmd", "run", path, "--output", out], check=True, capture_output=True)


def undisturbed(folder: Path) -> dict[tuple[int, float], np.ndarray]:
    """The pressures of all jobs, by seed and load."""
    fields = {}
    for seed in SEEDS:
        path = folder / f"whole {seed}"
        run_alone(folder / "job.toml", job([seed], sorted(OLD + NEW)), path)
        results = Results(path)
        fields |= {(seed, load): results.field("pressure", load=i) for i, load in enumerate(sorted(OLD + NEW))}
    return fields


def wrong_results(folder: Path, seeds: list[int], fields: dict[tuple[int, float], np.ndarray]) -> str:
    """What is wrong with the results of a folder; empty if they are old, new, or none."""
    for seed in seeds:
        member = folder if len(seeds) == 1 else folder / f"seed_{seed:04d}"
        if not (member / "observables.h5").exists():
            continue
        try:
            results = Results(member)
            for index, load in enumerate(results.loads["mean_pressure"]):
                expected = fields[seed, min((key[1] for key in fields), key=lambda each: abs(each - load))]
                off = np.linalg.norm(results.field("pressure", load=index) - expected) / np.linalg.norm(expected)
                if not off < 1e-6:
                    return f"load {index} of seed {seed} is {off:.1e} off"
        except (InputError, OSError, KeyError) as error:
            return f"seed {seed}: {error}"
    return ""


def inject(chance: random.Random, folder: Path, fields: dict[tuple[int, float], np.ndarray]) -> tuple[str, str]:
    """One run with an error: ("right", "wrong" or "not met", what happened)."""
    place, error = chance.choice(list(CALLS)), chance.choice(ERRORS)
    call, ranks, seeds = chance.randint(1, CALLS[place]), chance.choice([2, 3]), chance.choice([SEEDS, SEEDS[:1]])
    rank, mark, out = chance.randrange(ranks), folder / "mark", folder / "out"
    module, name = place.split(":")
    text = SCRIPT.format(module=module, name=name, rank=rank, call=call, error=error, mark=str(mark),
                         groups=min(2, ranks // 2 + 1))  # fmt: skip
    (folder / "faulty.py").write_text(text)
    before = chance.random() < 0.5
    if before:
        old = folder.parent / f"old {len(seeds)}"
        if not old.exists():
            run_alone(folder / "job.toml", job(seeds, OLD), old)
        shutil.copytree(old, out)
    (folder / "job.toml").write_text(job(seeds, NEW))
    arguments = ("run", folder / "job.toml", "--output", out, *["--overwrite"] * before)
    run = launching.start(ranks, *arguments, script=(folder / "faulty.py",))
    case = f"{place} call {call}, {error}, rank {rank} of {ranks}, {len(seeds)} seeds, {'old' * before or 'no'} results"
    try:
        code, stderr = launching.wait(run, 90)
    except (subprocess.TimeoutExpired, AssertionError):
        return "wrong", f"{case}: hangs"
    ended = time.time()
    said = [line for line in stderr.splitlines() if line.startswith("pgfmd: ")]
    met, wrong = mark.exists(), wrong_results(out, seeds, fields)
    seconds = ended - float(mark.read_text()) if met else 0.0
    if not met:
        return ("wrong", f"{case}: not met, but exit code {code}\n{stderr}") if code or wrong else ("not met", case)
    wrong = wrong or (f"{seconds:.0f} s" if seconds > LIMIT else "")
    wrong = wrong or ("traceback" if "Traceback" in stderr else "")
    wrong = wrong or (f"exit code {code}, {len(said)} messages" if len(said) != (code != 0) else "")
    return ("wrong", f"{case}: {wrong}\n{stderr}") if wrong else ("right", f"{case}: exit code {code}, {seconds:.0f} s")


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=20, help="errors that are met")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    chance, counts = random.Random(options.seed), {"right": 0, "wrong": 0, "not met": 0}
    with tempfile.TemporaryDirectory(prefix="pgfmd-faults-") as scratch:
        fields = undisturbed(Path(scratch))
        while counts["right"] + counts["wrong"] < options.count:
            folder = Path(scratch, "case")
            folder.mkdir()
            verdict, text = inject(chance, folder, fields)
            counts[verdict] += 1
            print(f"{verdict}: {text}", flush=True)
            shutil.rmtree(folder)
    print(", ".join(f"{number} {verdict}" for verdict, number in counts.items()))
    return int(counts["wrong"] > 0)


if __name__ == "__main__":
    raise SystemExit(main())
