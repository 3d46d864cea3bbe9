"""Metadata of a release agree with the package; the reference set and what reads it."""

import csv
import hashlib
import json
import re
import sys
import tomllib
from pathlib import Path

import pytest

import pgfmd
from pgfmd.errors import InputError
from pgfmd.theory.reference_set import _table

TOP = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((TOP / "pyproject.toml").read_text())["project"]


def test_the_version_is_the_same_everywhere():
    """pyproject.toml, the package, and the metadata of archives and recipes."""
    version = PROJECT["version"]
    assert pgfmd.__version__ == version
    for name in ("tools/release/codemeta.json", ".zenodo.json"):
        assert json.loads((TOP / name).read_text())["version"] == version
    for name, pattern in (
        ("CITATION.cff", rf"^version: {version}$"),
        ("tools/release/conda/meta.yaml", rf'version = "{version}"'),
        ("tools/release/spack/package.py", rf'version\("{version}"\)'),
    ):
        assert re.search(pattern, (TOP / name).read_text(), re.MULTILINE), name


def test_recipes_require_what_the_package_requires():
    """Each dependency stands in the conda and the Spack recipe and in codemeta."""
    folder = TOP / "tools/release"
    texts = [(folder / name).read_text() for name in ("conda/meta.yaml", "spack/package.py", "codemeta.json")]
    for requirement in PROJECT["dependencies"]:
        name = re.match(r"[\w-]+", requirement).group()
        assert all(name in text for text in texts), name


def test_the_paper_cites_what_its_bibliography_has():
    """Each @key of paper.md is an entry of paper.bib, and the other way round."""
    folder = TOP / "tools/release"
    cited = set(re.findall(r"@([A-Z][a-zA-Z]+\d{4})", (folder / "paper.md").read_text()))
    assert cited == set(re.findall(r"^@article\{(\w+),", (folder / "paper.bib").read_text(), re.MULTILINE))


def test_the_package_page_has_nothing_relative():
    """No picture and no link that the package page could not follow."""
    text = (TOP / "tools/release/package.md").read_text()
    assert not re.search(r"\]\((?!https://)", text)


def test_the_reference_returns_its_own_entries():
    """At an entry of the set: its value, its error and its scatter."""
    row = next(row for row in _table() if row["rolloff"] == 4 and row["hurst"] == 0.8)
    found = pgfmd.reference(hurst=0.8, scales=row["scales"], pressure=row["pressure"])["gap"]
    assert found.value == pytest.approx(row["gap"], rel=1e-12)
    assert (found.error, found.scatter) == pytest.approx((row["gap_error"], row["gap_scatter"]), rel=1e-6)


def test_a_fresh_surface_agrees_with_the_reference():
    """A surface whose seed is not in the set, between two pressures: area within four times the scatter of one."""
    rough = {"kind": "self-affine", "hurst": 0.8, "lambda_s": 8.0, "lambda_r": 128.0, "rms_slope": 0.1, "seed": 99}
    heights = pgfmd.surface({"grid": {"n": 512}, "surface": rough})
    area = pgfmd.solve(heights, 0.005, contact_modulus=1.0, tolerance=1e-6).contact_area_corrected
    expected = pgfmd.reference(hurst=0.8, scales=16, pressure=0.05, rolloff=4)["area"]
    assert abs(area - expected.value) < 4 * (8**0.5 * expected.scatter + expected.error)


@pytest.mark.parametrize("asked", [{"hurst": 0.1}, {"scales": 1000}, {"pressure": 3}, {"rolloff": 2}])
def test_outside_of_the_set_is_refused(asked):
    """One line that names what is allowed."""
    with pytest.raises(InputError, match=f"{next(iter(asked))} = .*: must"):
        pgfmd.reference(**{"hurst": 0.8, "scales": 16, "pressure": 0.02, "rolloff": 4} | asked)


def test_the_table_is_the_one_that_its_description_names():
    """The checksum in jobs/reference/reference.json is that of the table in the package."""
    about = json.loads((TOP / "jobs/reference/reference.json").read_text())
    assert hashlib.sha256((TOP / "pgfmd/theory/reference.csv").read_bytes()).hexdigest() == about["sha256"]


def test_the_table_is_made_from_the_runs(tmp_path, capsys):
    """Means over the surfaces in units of slope and cell; the finer grid beside; no runs are refused."""
    sys.path.insert(0, str(TOP / "tools" / "bench"))
    import reference_table

    rough = {"kind": "self-affine", "hurst": 0.8, "lambda_s": 8.0, "lambda_r": 64.0, "rms_slope": 0.1}
    job = {"solid": {"contact_modulus": 1.0}, "load": {"pressure": [0.004]}}
    job |= {"output": {"observables": ["discretisation"]}}
    for name, seed, grid in (("s1", 1, {}), ("s2", 2, {}), ("s1-fine", 1, {"refine": 2})):
        surface = {"surface": rough | {"seed": seed}, "grid": {"n": 64} | grid}
        pgfmd.run(job | surface, tmp_path / f"h0.8-l1-r8-{name}")
    assert reference_table.main([str(tmp_path), "--output", str(tmp_path / "table")]) == 0
    (row,) = csv.DictReader((tmp_path / "table/reference.csv").open())
    gaps = [pgfmd.Results(tmp_path / f"h0.8-l1-r8-s{seed}")[0].numbers["mean_gap"] for seed in (1, 2)]
    assert float(row["gap"]) == pytest.approx(sum(gaps) / 2 / (0.1 * 64), rel=1e-5)
    assert float(row["gap_scatter"]) == pytest.approx(abs(gaps[0] - gaps[1]) / 2 / (0.1 * 64), rel=1e-5)
    assert (row["seeds"], float(row["pressure"])) == ("2", pytest.approx(0.04))
    assert len(list(csv.DictReader((tmp_path / "table/fine.csv").open()))) == len(reference_table.NUMBERS)
    assert '"nayak": ' in (tmp_path / "table/reference.html").read_text()
    assert reference_table.main([str(tmp_path / "none"), "--output", str(tmp_path / "table")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
