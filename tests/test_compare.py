"""`pgfmd compare` and `pgfmd cite`."""

import json
import math

import pytest

import pgfmd
from pgfmd.application.cli import main
from pgfmd.application.compare import Row

JOB = {
    "grid": {"n": 32},
    "surface": {"kind": "self-affine", "hurst": 0.8, "lambda_s": 8.0, "rms_slope": 0.1},
    "solid": {"contact_modulus": 1.0},
    "load": {"pressure": [0.005, 0.01]},
    "output": {"observables": ["discretisation"]},
}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """The same surface on the grid and on one of twice the points, and three seeds."""
    top = tmp_path_factory.mktemp("compare")
    pgfmd.run(JOB, top / "coarse")
    pgfmd.run(JOB | {"grid": {"n": 32, "refine": 2}, "load": {"pressure": [0.02, 0.01]}}, top / "fine")
    pgfmd.run(JOB | {"surface": JOB["surface"] | {"seed": [1, 2, 3]}}, top / "seeds")
    return top


def rows(capsys, *arguments):
    assert main(["compare", *map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_loads_are_paired_by_their_target(folders, capsys):
    """Only p̄ = .01 stands in both, as load 1; the difference and the joint error are those of the tables."""
    found = rows(capsys, folders / "coarse", folders / "fine")
    one, two = (pgfmd.Results(folders / name)[1].numbers for name in ("coarse", "fine"))
    assert {row["load"] for row in found["numbers"]} == {1}
    gap = next(row for row in found["numbers"] if row["name"] == "mean_gap")
    assert gap["difference"] == two["mean_gap"] - one["mean_gap"]
    assert gap["error"] == math.hypot(one["mean_gap_error"], two["mean_gap_error"])
    assert any("grid.refine: 1 → 2" in line for line in found["differs"])
    assert any("2 loads of one run have no partner" in line for line in found["differs"])


def test_a_ratio_needs_an_error():
    """Difference over the joint error; NaN where no error is known."""
    row = {"run": "a", "load": 0, "target": 0.01, "name": "kappa", "first": 2.0, "other": 2.5}
    assert Row(**row, first_error=0.3, other_error=0.4).ratio == pytest.approx(1.0)
    assert math.isnan(Row(**row, first_error=math.nan, other_error=math.nan).ratio)


def test_an_ensemble_is_compared_by_its_mean(folders, capsys):
    """The other value is the mean over the seeds, its error the standard error."""
    found = rows(capsys, folders / "coarse", folders / "seeds")
    mean = pgfmd.Ensemble(folders / "seeds").mean()
    row = next(row for row in found["numbers"] if row["name"] == "mean_gap" and row["load"] == 0)
    assert row["other"] == pytest.approx(mean["mean_gap"][0], rel=1e-14)
    assert row["other_error"] == pytest.approx(mean["mean_gap_error"][0], rel=1e-14)


def test_text_and_csv_show_each_number(folders, capsys):
    """A line for each number that differs, and what distinguishes the jobs; the CSV has a row for each number."""
    assert main(["compare", str(folders / "coarse"), str(folders / "fine")]) == 0
    text = capsys.readouterr().out
    assert "grid.refine: 1 → 2" in text and "mean_gap" in text and "target" not in text
    assert main(["compare", str(folders / "coarse"), str(folders / "fine"), "--csv"]) == 0
    lines = capsys.readouterr().out.split()
    assert lines[0].startswith("run,load,target,name,first") and len(lines) > 5


def test_what_cannot_be_compared_is_refused(folders, capsys):
    """One folder, another kind of load, or no load in common: one line, exit code 2."""
    pgfmd.run(JOB | {"load": {"contact_area": [0.1]}}, folders / "area")
    pgfmd.run(JOB | {"load": {"pressure": [0.03]}}, folders / "other")
    capsys.readouterr()  # the log, if a command in this process has opened it
    for others, words in (((), "two result folders"), (("area",), "imposes"), (("other",), "same target")):
        assert main(["compare", *(str(folders / name) for name in ("coarse", *others))]) == 2
        message = capsys.readouterr().err
        assert words in message and message.count("\n") == 1


def test_cite_names_the_version_and_the_sources(folders, capsys):
    """The version and commit that ran; the surface's paper; nothing that the job did not use."""
    assert main(["cite", str(folders / "coarse")]) == 0
    text = capsys.readouterr().out
    commit = pgfmd.Results(folders / "coarse").provenance["commit"]
    assert commit in text and "10.1088/0953-8984/20/35/354013" in text
    assert "Barber" not in text and text.count("{") == text.count("}")
