"""How a run is handled: more loads, other kinds, numbers for other programs, a log beside the results, time left."""

import csv
import io
import json
import logging
import time
from types import SimpleNamespace

import numpy as np
import pytest
from job_texts import rough_job

import pgfmd
from pgfmd.application import progress
from pgfmd.application.cli import main
from pgfmd.application.job import load, parse, tables_as_toml
from pgfmd.application.machine import available_memory, describe
from pgfmd.application.progress import LOG_FILE, Progress
from pgfmd.application.results import Results
from pgfmd.application.simulate import simulate
from pgfmd.errors import InputError


def text_of(control: str, values: list[float]) -> str:
    """A job with these values imposed."""
    output = {"fields": ["height", "pressure"], "observables": ["discretisation"]}
    return rough_job([32, 30], load={control: values}, solver={"tolerance": 1e-18}, output=output)


def job_of(control: str, values: list[float]):
    """The same, parsed."""
    return parse(text_of(control, values))


@pytest.fixture
def told(comm):
    """Messages of a run are logged on rank 0, as by the command line."""
    log = logging.getLogger("pgfmd")
    before = log.level
    log.setLevel(logging.INFO if comm.rank == 0 else logging.CRITICAL + 1)
    yield
    log.setLevel(before)


@pytest.mark.mpi
def test_the_modulus_is_said(comm, shared_tmp_path, capsys, caplog):
    """`new`, `check`, log and `info` say the contact modulus; at 1, the default of `solve`, areas are the same."""
    text = rough_job([32, 30], solid={"contact_modulus": 1.0}, load={"pressure": [0.02]}, output={"fields": ["height"]})
    folder = shared_tmp_path / "run"
    caplog.set_level(logging.INFO, "pgfmd")
    results = pgfmd.run(parse(text), folder, comm=comm)
    contact = pgfmd.solve(pgfmd.surface(parse(text), comm), 0.02, comm=comm)
    assert contact.contact_area == results.loads["contact_area"][0]
    if comm.rank == 0:
        assert "solid: homogeneous; contact_modulus = 1.0, thickness = inf" in caplog.text
        (shared_tmp_path / "job.toml").write_text(text)
        for words in (["new"], ["check", str(shared_tmp_path / "job.toml")], ["info", str(folder)]):
            assert main(words) == 0
            assert "contact_modulus = 1.0" in capsys.readouterr().out


@pytest.mark.mpi
def test_what_is_hardly_meant_is_named(comm, tmp_path, capsys, caplog):
    """[output.lowpass] where lowpass is not measured, a pressure above E': a warning of the run, a line of `check`."""
    output, line = {"observables": ["patches"], "lowpass": {"q": [1.0]}}, "output.lowpass: has no effect"
    large = "load.force: the mean pressure is 3 E'; are both in the same unit?"
    job = {"grid": {"n": 8}, "surface": {"kind": "sinusoid", "amplitude": 1.0}, "solid": {"contact_modulus": 1.0},
           "load": {"force": [64.0, 192.0]}, "output": output}  # fmt: skip
    pgfmd.run(job, comm=comm)
    (tmp_path / "job.toml").write_text(tables_as_toml(job))
    assert main(["check", str(tmp_path / "job.toml")]) == 0
    out = capsys.readouterr().out
    assert all(each in out and (each in caplog.text or comm.rank) for each in (line, large))
    output["observables"].append("lowpass")
    job["load"] = {"force": 64.0}
    caplog.clear()
    pgfmd.run(job, comm=comm)
    assert line not in caplog.text and large not in caplog.text


@pytest.mark.parametrize("control", ["pressure", "contact_area"])
def test_loads_are_added_to_a_run(comm, shared_tmp_path, control):
    """--restart with more values at the end of the list solves those alone: what was written stays byte for byte, the
    results are those of a run of all of them (each certified to 1e-18: pressures agree to 1e-7), and their job is the
    longer one.  The first job is then refused, as is one that changes an earlier value."""
    values, folder = [0.01, 0.03, 0.05, 0.02], shared_tmp_path / "out"
    simulate(job_of(control, values[:2]), comm, folder)
    comm.Barrier()
    first = {path.name: path.read_bytes() for path in (folder / "fields").iterdir()}
    comm.Barrier()
    simulate(job_of(control, values), comm, folder, restart=True)
    simulate(job_of(control, values), comm, shared_tmp_path / "whole")
    comm.Barrier()
    found, whole = Results(folder), Results(shared_tmp_path / "whole")
    assert (found.status, len(found), found.job["load"][control]) == ("complete", 4, values)
    assert found.provenance["loads_requested"] == 4
    assert all((folder / "fields" / name).read_bytes() == content for name, content in first.items())
    for index in range(4):
        expected = whole.field("pressure", index)
        np.testing.assert_allclose(found.field("pressure", index), expected, atol=1e-7 * expected.max())
    for other in (values[:2], [0.01, 0.031, 0.05, 0.02]):
        with pytest.raises(InputError, match=f"the job differs: load.{control}"):
            simulate(job_of(control, other), comm, folder, restart=True)


@pytest.mark.parametrize(("changes", "expected"), [
    (["load.contact_area=[0.1]", "wall.kind=hard"], {"contact_area": (0.1,), "pressure": None}),
    (["surface.radius=7", "surface.kind=paraboloid"], {"radius": 7.0, "kind": "paraboloid"}),
    (["wall.kind=hardness", "wall.hardness=0.2"], {"hardness": 0.2}),
    (["surface.kind=sinusoid", "surface.amplitude=2", "load.mean_gap=[1]"], {"amplitude": 2.0, "mean_gap": (1,)}),
])  # fmt: skip
def test_set_replaces_one_kind_by_another(tmp_path, changes, expected):
    """--set of another control, surface or wall removes what belongs to the one in the file; the order is free."""
    text = text_of("pressure", [0.1]) + '[wall]\nkind = "exponential"\nzeta = 0.5\n'
    (tmp_path / "job.toml").write_text(text)
    job = load(tmp_path / "job.toml", changes)
    for name, value in expected.items():
        (owner,) = [part for part in (job.surface, job.wall, job.load) if hasattr(part, name)][:1]
        assert getattr(owner, name) == value


@pytest.mark.parametrize(("changes", "message"), [
    (["load.contact_area=[0.1]", "load.pressure=[0.1]"], "exactly one of"),
    (["surface.kind=paraboloid", "surface.radius=7", "surface.hurst=0.8"], "surface.hurst = 0.8: belongs to"),
    (["surface.kind=parabola"], "surface.kind = \"parabola\": must be one of"),
    (["surface.radius=7"], "surface.radius = 7: belongs to kind = \"paraboloid\" or"),
])  # fmt: skip
def test_set_itself_must_fit_together(changes, message):
    """Two controls, or keys of two kinds, given by --set are refused; so is a key of a kind that is not chosen."""
    with pytest.raises(InputError, match=message):
        parse(text_of("pressure", [0.1]), overrides=changes)


def test_numbers_for_other_programs(comm, tmp_path, capsys):
    """`info --csv` and `--json` give every number to its last bit, its error and the job; JSON null for none."""
    simulate(job_of("pressure", [0.01, 0.0]), comm, tmp_path / "out")
    found = Results(tmp_path / "out")
    assert main(["info", "--csv", str(tmp_path / "out")]) == 0
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert main(["info", "--json", str(tmp_path / "out")]) == 0
    told = json.loads(capsys.readouterr().out, parse_constant=lambda word: pytest.fail(f"{word} is not JSON"))
    assert told["job"]["load"]["pressure"] == [0.01, 0.0] and told["job"]["solid"]["thickness"] is None
    assert told["status"] == "complete" and "HDF5" in told["provenance"]["libraries"]
    for index, (row, entry) in enumerate(zip(rows, told["loads"], strict=True)):
        assert row["load"] == str(index) and "contact_area_corrected_error" in row
        for name, values in found.loads.items():
            np.testing.assert_equal(float(row[name]), float(values[index]))
            expected = values[index].item() if np.isfinite(values[index]) else None
            assert entry[name] == expected


@pytest.mark.mpi
def test_the_log_is_kept(comm, shared_tmp_path, told, monkeypatch):
    """DIR/run.log holds what rank 0 logged, from the first line on, which has the time when the run began, and why a
    run ended; a restart adds to it; a run that is refused leaves it alone, and makes none."""
    folder = shared_tmp_path / "out"
    monkeypatch.setattr(progress, "time", SimpleNamespace(time=lambda: 365 * 86400.0, monotonic=time.monotonic))
    simulate(job_of("pressure", [0.01]), comm, folder)
    comm.Barrier()
    first = (folder / LOG_FILE).read_text()
    assert [line.startswith("1971") for line in first.splitlines()] == [True] + [False] * (first.count("\n") - 1)
    assert "MPI: " in first and "load 1/1  pressure 0.01" in first and f"on {comm.size} rank" in first
    comm.Barrier()
    for _ in range(2):
        with pytest.raises(InputError):
            simulate(job_of("pressure", [0.02]), comm, folder, restart=True)
        with pytest.raises(InputError):
            simulate(job_of("displacement", [1e300]), comm, shared_tmp_path / "refused")
    comm.Barrier()
    assert (folder / LOG_FILE).read_text() == first and not (shared_tmp_path / "refused").exists()
    comm.Barrier()
    simulate(job_of("pressure", [0.01, 0.02]), comm, folder, restart=True)
    comm.Barrier()
    text = (folder / LOG_FILE).read_text()
    assert text.startswith(first) and text.count("load 2/2  pressure 0.02") == 1
    assert not logging.getLogger("pgfmd").handlers or comm.rank == 0


def test_time_left(monkeypatch, caplog):
    """After 1 of 4 loads in 10 s, and half of the decades of the second in 5 more, 25 s are left; before the first is
    done nothing is said; without a terminal each step is a line of the log."""
    seconds = [0.0]
    shown = Progress(0, 4, (8, 8), 1e-8, clock=lambda: seconds[0])
    shown.begin("load 1/4")
    assert shown.left() == ""
    seconds[0] = 10.0
    shown.end()
    shown.begin("load 2/4")
    seconds[0] = 15.0
    caplog.set_level(progress.STEP, "pgfmd")
    monkeypatch.setattr(logging.getLogger("pgfmd"), "propagate", True)
    shown.step((4, 4), 1e-6, 0.5, 1.0)  # of a coarser grid
    shown.step((8, 8), 1e-4, 0.5, 1.0)
    assert shown.left() == "; about 25 s left"
    assert [record.message.split()[:4] for record in caplog.records] == [["load", "2/4", "error", "1.0e-04"]]


def test_one_updating_line_on_a_terminal(monkeypatch, capsys):
    """On a terminal the steps of a load update one line, which is cleared in the end."""
    monkeypatch.setattr(progress, "updates", lambda: True)
    shown = Progress(0, 1, (8, 8), 1e-8)
    shown.begin("load 1/1")
    for error in (1e-2, 1e-6):
        shown.step((8, 8), error, 0.5, 1.0)
    shown.hide()
    written = capsys.readouterr().err
    assert "\n" not in written and written.count("\r") > 2 and "error 1.0e-06" in written


def levels(found, per_rank):
    """Text of all lines, and of the warnings."""
    lines = describe(found, per_rank)
    return "\n".join(line for _, line in lines), [line for level, line in lines if level == logging.WARNING]


def test_ranks_nodes_and_memory():
    """Six ranks on two nodes are counted per node; the node that has least to spare is the one named."""
    found = 4 * [("fat", set(range(8)), 2, 64e9)] + 2 * [("thin", set(range(8)), 2, 16e9)]
    text, warnings = levels(found, 4e9)
    assert "6 ranks on 2 nodes (fat: 4, thin: 2) × 2 threads" in text
    assert "4 GB per rank, 8 GB on thin of 16 GB" in text and not warnings


def test_warnings():
    """Too little memory and more threads than cores are said beforehand; one thread per rank is never too many."""
    _, warnings = levels(2 * [("node", {0, 1, 2, 3}, 4, 10e9)], 6e9)
    assert len(warnings) == 2 and "memory will not suffice" in warnings[0] and "8 threads on 4 cores" in warnings[1]
    assert not levels([("node", {0, 1}, 2, 10e9), ("node", {2, 3}, 2, 10e9)], 1e9)[1]
    assert not levels(8 * [("node", {0, 1, 2, 3}, 1, 10e9)], 1e9)[1]


def test_available_memory_is_that_of_a_machine():
    """Between 10 MB and 1 PB."""
    assert 1e7 < available_memory() < 1e15
