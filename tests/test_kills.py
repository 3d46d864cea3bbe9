"""Runs that are killed at random moments, and go on."""

import contextlib
import shutil
import subprocess
import time

import launching
import numpy as np
import pytest
from conftest import contents

from pgfmd.application.ensemble import Ensemble
from pgfmd.application.results import Results

SAME = 1e-10  # relative L2 of the pressure; solved to a certified energy error of 1e-12, measured 1e-12


def campaign(tmp_path, n: int, kills: int, interval: float):
    """Runs of six loads, each killed at a random moment, restarted on 1 to 3 ranks, killed again …, until it gets
    through; until there were so many kills.  Every load that a run leaves behind is compared with an undisturbed run.
    """
    chance = launching.by_chance()
    job = launching.write_job(tmp_path / "job.toml", n, lambda_s=n / 64, interval=interval)
    began = time.monotonic()
    launching.run_to_end(2, "run", job, "--output", tmp_path / "reference")
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
            saved = (folder / "fields" / "checkpoint.h5").exists()
            print(
                f"kill {done:2}, {way:6} of {ranks} ranks, {moment:5.1f} s: {there} loads, differing by {found:.0e}"
                + " + checkpoint" * saved,
                flush=True,
            )  # fmt: skip
            assert found < SAME
        there, found = launching.distance(folder, tmp_path / "reference")
        print(f"run {runs} complete, pressures differ by {found:.1e}", flush=True)
        assert found < SAME
        assert not list(folder.glob("**/.*tmp")) and not list(folder.glob("**/checkpoint.h5"))


def changed(tmp_path, n: int, kills: int):
    """Complete results are replaced by runs of other heights, of another job, or of another version, each killed at a
    random moment: what is there is what was, or what was to be, and goes on as that and as nothing else."""
    chance, lengths = launching.by_chance(), []
    jobs, heights = {}, tmp_path / "heights.npy"
    rough = np.random.default_rng(1).normal(size=(n, n))
    rough = np.fft.rfft2(rough) * (np.hypot(*np.meshgrid(np.fft.rfftfreq(n), np.fft.fftfreq(n))) < 4.5 / n)
    rough = np.fft.irfft2(rough) * (n / 64) ** 2  # rms slope 0.03
    surfaces = {"old": rough, "inputs": 1.5 * rough[::-1], "job": rough, "version": rough}
    for name, surface in surfaces.items():
        pressure = 1.5e-3 if name == "job" else 1e-3
        jobs[name] = launching.write_file_job(tmp_path / f"{name}.toml", n, heights, pressure)
        np.save(heights, surface)
        began = time.monotonic()
        launching.run_to_end(2, "run", jobs[name], "--output", tmp_path / f"as {name}")
        lengths.append(time.monotonic() - began)
    other_version = tmp_path / "other.py"
    other_version.write_text(
        "import sys, pgfmd\npgfmd.__version__ = '9.9'\nfrom pgfmd.application import cli\nsys.exit(cli.main())\n"
    )
    seen = []
    for number in range(kills):
        folder, name = tmp_path / f"kill {number}", ("inputs", "job", "version")[number % 3]
        script = (other_version,) if name == "version" else ("-m", "pgfmd")
        shutil.copytree(tmp_path / "as old", folder)
        before = contents(folder)
        np.save(heights, surfaces[name])
        ranks = chance.choice([1, 2, 3])
        refused = launching.start(ranks, "run", jobs[name], "--output", folder, "--restart", script=script)
        code, stderr = launching.wait(refused, 300)
        assert code == 2 and "cannot be continued" in stderr, stderr
        assert before == contents(folder)
        run = launching.start(ranks, "run", jobs[name], "--output", folder, "--overwrite", script=script)
        launching.wait_for_folder(run, folder)
        time.sleep(chance.choice([0.02, 1]) * chance.uniform(0, 0.6 * max(lengths)))  # also before the first load
        launching.kill(run, chance.choice(["one", "all", "mpirun"]), chance.choice)
        launching.wait(run)
        read = Results(folder)
        version = read.provenance["softwareVersion"]
        new = {"inputs": read.provenance["inputs"] != Results(tmp_path / "as old").provenance["inputs"],
               "job": read.job["load"]["pressure"][0] == 1.5e-3, "version": version == "9.9"}[name]  # fmt: skip
        seen.append(new)
        _, found = launching.distance(folder, tmp_path / f"as {name if new else 'old'}", complete=not new)
        assert found < SAME
        present = name if new else "old"
        np.save(heights, surfaces[present])
        script = script if new else ("-m", "pgfmd")
        launching.run_to_end(1, "run", jobs[present], "--output", folder, "--restart", script=script)
        _, found = launching.distance(folder, tmp_path / f"as {present}")
        print(f"kill {number + 1:2} of {ranks} ranks, other {name}: {present}, {found:.0e}", flush=True)
        assert found < SAME
        shutil.rmtree(folder)
    return seen


@pytest.mark.breadth
def test_a_killed_ensemble_goes_on_with_more_seeds(tmp_path):
    """Killed twice at random moments, restarted on other rank counts, then with seeds added: what was complete is kept
    as it is (its seconds are those of the first time), and all seeds and their means are those of an undisturbed run.
    """
    chance = launching.by_chance()
    job = launching.write_job(tmp_path / "job.toml", 128, lambda_s=8, pressures=[0.001, 0.002])
    reference, folder, kept = tmp_path / "reference", tmp_path / "out", {}
    every = ("--set", "surface.seed=1..8")
    launching.run_to_end(2, "run", job, "--output", reference, *every)

    def completed() -> dict[str, list[float]]:
        """The seconds of the loads of each seed that is complete."""
        runs = [Results(path.parent) for path in folder.glob("seed_*/observables.h5")]
        return {run.directory.name: run.loads["seconds"].tolist() for run in runs if run.status == "complete"}

    for least in (1, 3):
        ranks = chance.choice([1, 2, 3])
        run = launching.start(ranks, "run", job, "--output", folder, "--restart", "--set", "surface.seed=1..6")
        while len(completed()) < least and run.poll() is None:
            time.sleep(0.05)
        time.sleep(chance.uniform(0, 0.5))
        launching.kill(run, chance.choice(["one", "all"]), chance.choice)
        code, stderr = launching.wait(run)
        now = completed()
        print(f"killed with {len(now)} seeds complete, exit code {code}")
        assert len(now) >= least and kept.items() <= now.items(), stderr
        assert Ensemble(folder).status in ("interrupted", "complete")  # the kill may come when all is written
        kept = now
    ranks = chance.choice([1, 2, 3])
    launching.run_to_end(ranks, "run", job, "--output", folder, "--restart", *every)
    found, expected = Ensemble(folder), Ensemble(reference)
    assert found.status == "complete" and found.seeds == list(range(1, 9)) and kept.items() <= completed().items()
    for mine, other in zip(found.runs, expected.runs, strict=True):
        assert launching.distance(mine.directory, other.directory)[1] < SAME
    for name in ("contact_area", "mean_gap"):
        np.testing.assert_allclose(found.mean()[name], expected.mean()[name], rtol=1e-9)
    assert not list(folder.glob("**/.*tmp")) and not list(folder.glob("**/checkpoint.h5"))


@pytest.mark.breadth
def test_killed_replacements(tmp_path):
    """Three kills, one for each kind of change."""
    changed(tmp_path, 64, 3)


@pytest.mark.long
def test_thirty_killed_replacements(tmp_path):
    """Thirty, at 256²; among them some before and some after the first new load."""
    assert set(changed(tmp_path, 256, 30)) == {True, False}


def test_killed_runs_go_on(tmp_path):
    """Killed at random, in a way drawn by chance, and restarted on any ranks: the result of an undisturbed run."""
    campaign(tmp_path, 128, 1, 0.1)


@pytest.mark.long
def test_thirty_kills(tmp_path):
    """The same for 30 kills of 1024² runs."""
    campaign(tmp_path, 1024, 30, 0.5)
