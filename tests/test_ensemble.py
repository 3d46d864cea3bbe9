"""Ensembles: many surfaces in one job, each as if it had been run alone."""

import json
import math
import weakref
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from conftest import once

import pgfmd
from pgfmd.application import ensemble_run as ensembles
from pgfmd.application import files
from pgfmd.application import simulate as runner
from pgfmd.application.ensemble import Column, folders, mean_loads, solved_runs
from pgfmd.application.estimate import Plan
from pgfmd.application.files import Form
from pgfmd.application.info import as_json, summary_of_ensemble
from pgfmd.application.job import as_toml, parse, tables_as_toml
from pgfmd.application.machine import Origin
from pgfmd.application.one_process import doubts
from pgfmd.application.results import Results
from pgfmd.application.writer import ResultWriter
from pgfmd.errors import InputError, SolverError, Stopped
from pgfmd.parallel.collectives import slab

pytestmark = pytest.mark.mpi

JOB = {
    "grid": {"n": 32},
    "surface": {"kind": "self-affine", "hurst": 0.8, "lambda_s": 8.0, "rms_slope": 0.1, "seed": "3..7"},
    "solid": {"lame_lambda": 1.0, "lame_mu": 1.0},
    "load": {"pressure": [0.004, 0.02]},
    "solver": {"tolerance": 1e-18},
    "output": {"observables": ["spectra", "histogram"]},
}


def failing(monkeypatch, error, seeds):
    """From now on those seeds of a run end with that error."""
    simulate = runner.simulate

    def stand_in(job, group, directory, **options):
        if job.surface.seed in seeds:
            raise error
        simulate(job, group, directory, **options)

    monkeypatch.setattr(runner, "simulate", stand_in)


def with_seeds(seeds, **tables) -> dict:
    return JOB | {"surface": JOB["surface"] | {"seed": seeds}} | tables


@pytest.mark.parametrize(
    ("written", "seeds"), [("2..4", (2, 3, 4)), ([5, 1], (5, 1)), ("7..7", (7,)), ([9], (9,)), (3, ())]
)
def test_seeds_of_an_ensemble(written, seeds):
    """A list or "first..last"; one number is one surface.  The effective job gives the same seeds again."""
    job = parse(tables_as_toml(with_seeds(written)))
    assert job.surface.seeds == seeds and parse(as_toml(job)) == job
    assert all(job.of_seed(seed).surface.seed == seed for seed in seeds)


@pytest.mark.parametrize(
    "written",
    ["4..2", "1...3", "a..b", "1..3..5", "-1..3", f"{2**63 - 1}..{2**63}", [], [1, 1], [1, -1], "1..2000001", 1.5, "3"],
)
def test_wrong_seeds_are_refused(written):
    """In one line that names the key."""
    with pytest.raises(InputError, match="surface.seed = ") as caught:
        parse(tables_as_toml(with_seeds(written)))
    assert "\n" not in str(caught.value)


def test_each_seed_is_what_it_is_alone(comm, shared_tmp_path):
    """Results of a seed in an ensemble are those of a run of that seed alone, on any number of ranks: the same areas,
    mean gaps to 1e-7 (both are certified to 1e-18, errors of second order in the gap)."""
    found = pgfmd.run(JOB, shared_tmp_path / "all", comm=comm)
    assert found.status == "complete" and found.seeds == [3, 4, 5, 6, 7] and len(found) == 10
    for seed, run in zip(found.seeds, found.runs, strict=True):
        alone = pgfmd.run(with_seeds(seed), shared_tmp_path / f"alone-{seed}", comm=comm)
        assert run.job["surface"] == alone.job["surface"] and run.status == "complete"
        np.testing.assert_array_equal(run.loads["contact_area"], alone.loads["contact_area"])
        np.testing.assert_allclose(run.loads["mean_gap"], alone.loads["mean_gap"], rtol=1e-7)


def test_means_and_standard_errors(comm, shared_tmp_path):
    """Mean and σ/√n are NumPy's, in file, Python and table; groups with other axes for each seed have no mean."""
    job = JOB | {"output": {"observables": ["spectra", "histogram", "patches", "discretisation"]}}
    found = pgfmd.run(job, shared_tmp_path / "out", comm=comm)
    areas = np.array([run.loads["contact_area"] for run in found.runs])
    error = areas.std(axis=0, ddof=1) / math.sqrt(5)
    spectra = np.array([run.load(1)["stress_spectrum"]["value"] for run in found.runs])
    curve = found.load(1)
    np.testing.assert_allclose(curve["stress_spectrum"]["value"], spectra.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(curve["stress_spectrum"]["value_error"], spectra.std(axis=0, ddof=1) / math.sqrt(5))
    assert "patches" not in curve and "pressure_histogram" not in curve
    with h5py.File(shared_tmp_path / "out" / "ensemble.h5", "r", locking=False) as file:
        np.testing.assert_allclose(file["loads/contact_area"], areas.mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(file["loads/contact_area_error"], error, rtol=1e-12)
        stored = file["load_0001/stress_spectrum/value_error"]
        np.testing.assert_allclose(stored, curve["stress_spectrum"]["value_error"], rtol=1e-12)
        assert stored.dims[0]["q"] == file["load_0001/stress_spectrum/q"] and stored.attrs["units"] == "pressure^2"
        assert list(file["loads/seeds"]) == [5, 5]
    assert f"{areas.mean(axis=0)[1]:.5g} ± {error[1]:.1g}" in summary_of_ensemble(found)
    frame = pytest.importorskip("pandas") and found.mean()
    np.testing.assert_allclose(frame["contact_area_error"], error, rtol=1e-12)


def test_standard_errors_leave_out_what_is_missing():
    """Entries that are not finite do not count; one sample has no error, none has no mean."""
    column = Column()
    for values in ([1.0, np.nan, np.nan], [3.0, 2.0, np.nan]):
        column.add(np.array(values))
    np.testing.assert_array_equal(column.mean, [2, 2, np.nan])
    np.testing.assert_array_equal(column.error, [1, np.nan, np.nan])


def test_means_leave_out_loads_that_were_not_solved(comm, shared_tmp_path):
    """Where a seed could not reach a load, the means of all numbers and curves are those of the other seeds."""
    folder = shared_tmp_path / "out"
    others = pgfmd.run(with_seeds([3, 5]), folder, comm=comm).load(1)
    pgfmd.run(with_seeds([3, 4, 5]), folder, comm=comm, restart=True)
    rows, origin = slab(32, comm.size, comm.rank), Origin(effective_toml=as_toml(parse(tables_as_toml(JOB))), loads=2)
    with ResultWriter(comm, folder / "seed_0004", origin, Form((32, 32), (32.0, 32.0), rows), "overwrite") as writer:
        for index in range(2):
            writer.write_load(index, {"target": 0.02})
    comm.Barrier()
    found = pgfmd.Ensemble(folder)
    assert found.load(1).keys() == others.keys()
    for title, group in others.items():
        for name, values in group.items():
            np.testing.assert_array_equal(found.load(1)[title][name], values)
    iterations = [run.loads["iterations"][1] for run in (found.runs[0], found.runs[2])]
    assert mean_loads(found.runs)["iterations"].mean[1] == np.mean(iterations) > 0
    assert json.loads(as_json(found.runs[1]))["loads"][1]["iterations"] is None
    assert list(solved_runs(found.runs)) == [2, 2]


def test_a_seed_that_fails_does_not_stop_the_others(comm, shared_tmp_path, monkeypatch):
    """The other seeds are complete, error and ensemble name the seed and the reason, and --restart does it alone."""
    failing(monkeypatch, SolverError("it does not converge"), [5])
    with pytest.raises(SolverError, match="1 of 5 seeds failed.*seed 5: it does not converge"):
        pgfmd.run(JOB, shared_tmp_path / "out", comm=comm)
    found = pgfmd.Ensemble(shared_tmp_path / "out")
    assert found.status == "failed" and found.failed == {5: "it does not converge"} and len(found.runs) == 4
    monkeypatch.undo()
    again = pgfmd.run(JOB, shared_tmp_path / "out", comm=comm, restart=True)
    assert again.status == "complete" and not again.failed and len(again) == 10


def test_a_load_that_a_seed_cannot_reach_costs_it_no_other(comm, shared_tmp_path):
    """A displacement beyond the full contact of the lower surfaces: each seed solves the other load, whose mean is over
    all of them.  The table, the file and the figure say over how many seeds each mean is; so does `check`."""
    heights = {seed: pgfmd.surface(with_seeds(seed)) for seed in (3, 4, 5)}
    low, mid, high = sorted(float(field.max() - field.mean()) for field in heights.values())
    job = with_seeds([3, 4, 5], load={"displacement": [0.3 * low, (mid + high) / 2]})
    with pytest.raises(SolverError, match="2 of 3 seeds failed"):
        pgfmd.run(job, shared_tmp_path / "out", comm=comm)
    found = pgfmd.Ensemble(shared_tmp_path / "out")
    assert list(solved_runs(found.runs)) == [3, 1] and len(found.failed) == 2
    assert all("must be below" in message for message in found.failed.values())
    areas = [run.loads["contact_area"][0] for run in found.runs]
    assert mean_loads(found.runs)["contact_area"].mean[0] == pytest.approx(np.mean(areas), rel=1e-14)
    rows = [line.split() for line in summary_of_ensemble(found).splitlines()]
    title = next(row for row in rows if row[:2] == ["load", "seeds"])
    assert [row[1] for row in rows[rows.index(title) + 2 :]] == ["3", "1"]
    assert len(doubts(parse(tables_as_toml(job)))) == 2
    if comm.size == 1 and pytest.importorskip("matplotlib"):
        from pgfmd.application import cli

        printed = cli._plot(["area_load", str(shared_tmp_path / "out"), "--output", str(shared_tmp_path / "pictures")])
        assert "not all of 3 seeds have solved each load, which biases the means (load 1: 1)" in printed
        table = (shared_tmp_path / "pictures" / "area_load_means.csv").read_text().splitlines()
        assert [line.rpartition(",")[2] for line in table] == ["seeds", "3", "1"]


def test_more_seeds_are_added_by_restart(comm, shared_tmp_path):
    """A longer list, also with another [run], continues; other changes are refused by key, and nothing is touched."""
    pgfmd.run(with_seeds([3, 4]), shared_tmp_path / "out", comm=comm)
    other = {"io_hints": ["cb_nodes=1"], "time_limit": 1e6}
    longer = pgfmd.run(with_seeds([3, 4, 9], run=other), shared_tmp_path / "out", comm=comm, restart=True)
    assert longer.seeds == [3, 4, 9] and longer.status == "complete" and len(longer.runs) == 3
    with pytest.raises(InputError, match="job differs: grid.n"):
        pgfmd.run(with_seeds([3], grid={"n": 16}), shared_tmp_path / "out", comm=comm, restart=True)
    with pytest.raises(InputError, match="holds an ensemble"):
        pgfmd.run(with_seeds([3]), shared_tmp_path / "out", comm=comm)
    assert pgfmd.Ensemble(shared_tmp_path / "out").status == "complete"


def test_a_restart_mends_a_complete_seed(comm, shared_tmp_path):
    """Of a complete ensemble a restart solves what is damaged, and leaves the other seeds alone."""
    job = with_seeds([3, 4], output={"fields": ["pressure"]})
    folder = shared_tmp_path / "out"
    before = pgfmd.run(job, folder, comm=comm).runs[1].field("pressure", 0)
    whole, damaged = folder / "seed_0003", folder / "seed_0004" / "fields" / "load_0000.h5"
    stamp = (whole / "observables.h5").stat().st_mtime_ns
    once(comm, damaged.write_bytes, damaged.read_bytes()[:3000])
    found = pgfmd.run(job, folder, comm=comm, restart=True)
    assert np.allclose(found.runs[1].field("pressure", 0), before, atol=1e-5 * before.max())
    assert (whole / "observables.h5").stat().st_mtime_ns == stamp


def test_an_overwriting_that_was_stopped_is_continued(comm, shared_tmp_path, monkeypatch):
    """Where --overwrite is stopped, old results of the other seeds are in no mean, and --restart makes them anew."""
    folder = shared_tmp_path / "out"
    pgfmd.run(with_seeds([3, 4, 5, 6]), folder, comm=comm)
    other = with_seeds([3, 4, 5, 6], load={"pressure": [0.01]})
    failing(monkeypatch, Stopped("stopped by a test"), [5, 6])
    with pytest.raises(Stopped):
        pgfmd.run(other, folder, comm=comm, overwrite=True)
    found = pgfmd.Ensemble(folder)
    done = {run.directory.name for run in found.runs}  # none, if the rank that was stopped was faster than the others
    assert found.status == "stopped" and done <= {"seed_0003", "seed_0004"} and (done or comm.size > 1)
    with h5py.File(folder / "ensemble.h5", "r", locking=False) as file:
        assert list(file["loads/seeds"]) == [len(done)] * bool(done)
    monkeypatch.undo()
    found = pgfmd.run(other, folder, comm=comm, restart=True)
    assert [len(run) for run in found.runs] == [1, 1, 1, 1] and found.status == "complete"


def test_a_wrong_input_leaves_a_folder_as_it_was(comm, shared_tmp_path):
    """A surface without a mode fails for every seed alike: one line, and no folder, or not a byte of it has changed."""
    none, folder = shared_tmp_path / "none", shared_tmp_path / "out"
    pgfmd.run(with_seeds([3, 4]), folder, comm=comm)
    before = (folder / "ensemble.h5").read_bytes()
    job = with_seeds([3, 4])
    job["surface"] |= {"lambda_s": 10.1, "lambda_l": 10.1}
    for place, mode in ((none, {}), (folder, {"overwrite": True})):
        with pytest.raises(InputError, match="no mode"):
            pgfmd.run(job, place, comm=comm, **mode)
    comm.Barrier()
    assert not none.exists()
    assert (folder / "ensemble.h5").read_bytes() == before and len(pgfmd.Ensemble(folder)) == 4


@pytest.mark.mpi("breadth")
def test_one_surface_and_an_ensemble_do_not_share_a_folder(comm, shared_tmp_path):
    """Neither takes the other's folder, whatever the mode; readers say which it is."""
    pgfmd.run(with_seeds(3), shared_tmp_path / "one", comm=comm)
    pgfmd.run(with_seeds([3]), shared_tmp_path / "all", comm=comm)
    for mode in ({}, {"overwrite": True}, {"restart": True}):
        with pytest.raises(InputError, match="one surface"):
            pgfmd.run(with_seeds([3]), shared_tmp_path / "one", comm=comm, **mode)
        with pytest.raises(InputError, match="ensemble"):
            pgfmd.run(with_seeds(3), shared_tmp_path / "all", comm=comm, **mode)
    with pytest.raises(InputError, match="an ensemble"):
        Results(shared_tmp_path / "all")
    with pytest.raises(InputError, match=r"not the folder of an ensemble: there is no .*ensemble.h5$"):
        pgfmd.Ensemble(shared_tmp_path / "one")
    assert folders(shared_tmp_path / "all") == [shared_tmp_path / "all" / "seed_0003"]
    assert folders(shared_tmp_path / "one") == [shared_tmp_path / "one"]


def test_an_ensemble_is_no_surface(comm):
    """The heights of a job with several seeds are asked for: one line."""
    with pytest.raises(InputError, match="surface.seed"):
        pgfmd.surface(JOB, comm)


@pytest.mark.parametrize(("n", "seeds", "ranks", "groups"), [
    (64, "1..64", 4, 4),  # small surfaces: one rank each
    (4096, "1..64", 4, 4),  # also large ones, as long as there are as many as ranks
    (4096, "1..2", 4, 2),  # else ranks share a surface
    (64, "1..2", 4, 2),
    (4096, "1..5", 4, 1),  # 5/(.8 · 4) rounds together, 2 side by side
    (64, "1..5", 4, 4),
])  # fmt: skip
def test_ranks_are_shared_out_by_size(n, seeds, ranks, groups):
    """Surfaces are solved side by side; a surface is shared where that is faster, by the speed that slabs have."""
    assert Plan(parse(tables_as_toml(with_seeds(seeds, grid={"n": n})))).rank_groups(ranks) == groups


def test_ranks_share_what_one_cannot_hold():
    """Where one rank has not the memory for a whole surface, as many share it as are needed."""
    plan = Plan(parse(tables_as_toml(with_seeds("1..64", grid={"n": 4096}))))
    alone = 4096**2 * 40 + 2.5e8
    assert plan.rank_groups(8, alone * 3) == 8 and plan.rank_groups(8, alone * 0.6) < 8
    assert plan.rank_groups(3, alone * 0.6) == 1  # not two groups, one of which is a single rank


@pytest.mark.mpi("breadth")
def test_memory_is_judged_for_the_groups_that_run(comm, shared_tmp_path, monkeypatch):
    """A node that holds one surface at a time runs an ensemble: refused is only what the chosen groups do not hold."""
    from pgfmd.application import estimate, machine

    if comm.size == 1:
        pytest.skip("one rank is one group")
    for name in ("BASE_BYTES", "LIBRARY_BYTES"):  # so that the grid alone counts
        monkeypatch.setattr(estimate, name, 0.0)
    alone = estimate.Plan(parse(tables_as_toml(JOB))).estimate(1).memory
    monkeypatch.setattr(machine, "largest_memory", lambda: 0.7 * alone * comm.size)
    assert pgfmd.run(JOB, shared_tmp_path / "out", comm=comm).status == "complete"
    monkeypatch.setattr(machine, "largest_memory", lambda: 0.3 * alone)
    with pytest.raises(InputError, match="take more nodes, or a smaller grid"):
        pgfmd.run(JOB, shared_tmp_path / "small", comm=comm)


def test_too_many_ranks_are_told_of_in_a_check(comm, tmp_path, capsys):
    """An ensemble takes a rank for each row of each surface, not more; the line names rows and surfaces."""
    from pgfmd.application.cli import main

    (tmp_path / "job.toml").write_text(tables_as_toml(JOB))
    assert main(["check", str(tmp_path / "job.toml"), "--ranks", "160"]) == 0
    assert main(["check", str(tmp_path / "job.toml"), "--ranks", "161"]) == 2
    assert comm.rank or "the 32 rows of the grid, of each of 5 surfaces" in capsys.readouterr().err


def test_a_disk_that_fails_fails_the_seed(comm, shared_tmp_path, monkeypatch):
    """A file that the leader of a group cannot sync fails that seed, on all ranks alike; the ensemble is written."""
    sync = files._sync

    def fails(path):
        if path.name == "seed_0006":
            raise OSError(5, "Input/output error")
        sync(path)

    monkeypatch.setattr(files, "_sync", fails)
    with pytest.raises(SolverError, match="1 of 5 seeds failed.*seed 6: .*Input/output error"):
        pgfmd.run(JOB, shared_tmp_path / "out", comm=comm)
    found = pgfmd.Ensemble(shared_tmp_path / "out")
    assert found.status == "failed" and found.failed.keys() == {6} and len(found) == 8


def test_a_seed_that_takes_too_much_memory_does_not_stop_the_others(comm, shared_tmp_path, monkeypatch):
    """With a rank for each surface, a seed without memory has failed; its memory is free before the next begins."""
    simulate, kept = runner.simulate, []

    class Big:
        pass

    def stand_in(job, group, directory, **options):
        assert not kept or kept[-1]() is None
        if job.surface.seed == 4:
            heights = Big()
            kept.append(weakref.ref(heights))
            raise MemoryError
        simulate(job, group, directory, **options)

    monkeypatch.setattr(runner, "simulate", stand_in)
    monkeypatch.setattr(ensembles, "Plan", lambda _: SimpleNamespace(rank_groups=lambda *_: comm.size))
    with pytest.raises(SolverError, match="1 of 5 seeds failed.*seed 4: MemoryError"):
        pgfmd.run(JOB, shared_tmp_path / "out", comm=comm)
    assert pgfmd.Ensemble(shared_tmp_path / "out").failed == {4: "MemoryError"}


def test_each_seed_keeps_its_log(tmp_path, mpirun):
    """The terminal has a line for each seed, its own run.log steps and loads, whichever rank led its group."""
    (tmp_path / "job.toml").write_text(tables_as_toml(JOB))
    done = mpirun(2, "-m", "pgfmd", "run", tmp_path / "job.toml", "--output", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert done.stderr.count(" of 5)") == 5 and "certified" not in done.stderr and "kappa" not in done.stderr
    for folder in folders(tmp_path / "out"):
        text = (folder / "run.log").read_text()
        assert "MPI: " in text and text.count("kappa") == 2 and "load 2/2  error" in text


def test_tools_take_the_folder(comm, shared_tmp_path, monkeypatch):
    """Figures are drawn of the folder of an ensemble as of its seeds' folders."""
    if comm.size > 1:
        pytest.skip("tools are serial")
    pytest.importorskip("matplotlib")
    from pgfmd.application import cli

    pgfmd.run(JOB, shared_tmp_path / "out", comm=comm)
    pictures = shared_tmp_path / "pictures"
    cli._plot(["area_load", str(shared_tmp_path / "out"), "--output", str(pictures)])
    rows = (pictures / "area_load.csv").read_text().splitlines()
    errors = [row.rpartition(",")[2] for row in rows if row.startswith("2,simulation,")]
    assert len(errors) == 2 and all(float(error) > 0 for error in errors)
