"""The serial tools: fields in row blocks, fits, verdicts, and every figure made without MPI."""

from __future__ import annotations

import csv
import importlib
import json
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from pgfmd.errors import InputError
from pgfmd.job import job as config
from pgfmd.observables.statistics import spectra

ROOT = Path(__file__).resolve().parent.parent
TOOLS = ROOT / "tools"
sys.path.insert(0, str(TOOLS))

import contact_patches  # noqa: E402
import exponents  # noqa: E402
import pending  # noqa: E402
import plotting  # noqa: E402
import reading  # noqa: E402
import report  # noqa: E402
import rowblocks  # noqa: E402

JOB = """
[grid]
n = 64
[surface]
kind = "self-affine"
hurst = {hurst}
lambda_s = {shortest}
rms_slope = 0.031
seed = {seed}
[wall]
kind = "{wall}"
{zeta}
[load]
pressure = {pressures}
[output]
fields = ["height", "pressure"]
observables = {observables}
"""
ALL = ["histogram", "spectra", "acf", "patches", "bearing", "lowpass"]


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> dict[str, Path]:
    """Small runs, made once: name → result folder."""
    from mpi4py import MPI

    from pgfmd.simulate import simulate

    folder = tmp_path_factory.mktemp("runs")

    def run(name, pressures=(0.003, 0.02), observables=ALL, hurst=0.8, shortest=4.0, seed=1, zeta=None, n=64):
        text = JOB.format(
            hurst=hurst, shortest=shortest, seed=seed, pressures=list(pressures), observables=json.dumps(observables),
            wall="exponential" if zeta else "hard", zeta=f"zeta = {zeta}" if zeta else "",
        ).replace("n = 64", f"n = {n}")  # fmt: skip
        simulate(config.parse(text), MPI.COMM_SELF, folder / name)
        return folder / name

    made = {"kept": run("kept"), "bare": run("bare", observables=[])}
    made |= {f"seed{seed}": run(f"seed{seed}", shortest=1.0, seed=seed) for seed in (1, 2)}
    made |= {f"grid{n}": run(f"grid{n}", n=n, shortest=n / 16, observables=["histogram"]) for n in (16, 32, 64)}
    made["soft"] = run("soft", zeta=0.25, observables=["spectra"])
    return made


def _blocks(field, rows):
    """The field in blocks of that many rows."""
    return [(slice(i, min(i + rows, len(field))), field[i : i + rows]) for i in range(0, len(field), rows)]


@pytest.mark.parametrize("shape", [(24, 24), (15, 22), (9, 7)])
def test_spectrum_in_blocks_is_that_of_the_field(shape):
    """However a field is cut, its averaged spectrum is that of one transform; 1e-12 is rounding over a few adds."""
    field = np.random.default_rng(1).normal(size=shape)
    lengths = (3.0, 3.0 * shape[1] / shape[0])
    found = rowblocks.radial_spectrum(_blocks(field, 4), shape, lengths, memory=16 * shape[0] * 3)
    expected = spectra.radial_average(spectra.power_spectrum(field), shape, lengths)
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12)


@pytest.mark.parametrize("shape", [(24, 24), (15, 22), (9, 7)])
def test_autocorrelation_in_blocks_is_that_of_the_field(shape):
    """As for the spectrum, with the transforms back; means of the field's square set the scale of rounding."""
    field = np.random.default_rng(2).normal(size=shape)
    lengths = (3.0, 3.0 * shape[1] / shape[0])
    found = rowblocks.radial_autocorrelation(_blocks(field, 5), shape, lengths, memory=16 * shape[1] * 2)
    expected = spectra.radial_autocorrelation(spectra.autocorrelation(field), lengths)
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-13)


def test_fields_alone_give_what_the_run_would_have_kept(runs):
    """Spectra from the fields of a run that kept none are those that the run measured, up to rounding."""
    kept, bare = (reading.cases([runs[name]])[1] for name in ("kept", "bare"))
    for name in ("stress", "contact", "height"):
        for ours, theirs in zip(bare.spectrum(name), kept.spectrum(name), strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-9)
    for name in ("stress", "contact"):
        assert bare.correlation(name)[1][0] == pytest.approx(kept.correlation(name)[1][0], rel=1e-12)


def test_slope_from_the_height_spectrum(runs):
    """√Σ q²|h̃|² over the bins is the slope asked for, up to the width of the bins (20 to a decade: second order)."""
    case = reading.cases([runs["kept"]])[0]
    q, power, count = case.spectrum("height")
    assert np.sqrt(np.sum(q**2 * power * count)) == pytest.approx(0.031, rel=5e-3)


def test_sum_rules_of_the_spectra_of_a_run(runs):
    """Σ_{q≠0} |f̃|² = ⟨f²⟩ − ⟨f⟩² exactly, where no mode is cut off."""
    group = reading.cases([runs["seed1"], runs["seed2"]])
    assert all(round(case.spectrum("contact")[2].sum()) == 64**2 - 1 for case in group)
    for kind in ("contact", "stress"):
        assert abs(exponents.worst_sum(group, kind)) < 1e-12


def test_joint_power_law_is_exact_for_power_laws():
    """Two exact power laws of one exponent and different prefactors give both back."""
    x = np.geomspace(3, 50, 17)
    exponent, logarithms = plotting.fit_power_law(x, 5 * x**-1.3, 0.2 * x**-1.3)
    assert exponent == pytest.approx(-1.3, abs=1e-12)
    np.testing.assert_allclose(np.exp(logarithms), [5, 0.2], rtol=1e-12)


def test_joint_exponent_of_different_power_laws_is_their_mean():
    """With equal points the joint least squares of slopes −1 and −2 is −1.5."""
    x = np.geomspace(1, 10, 9)
    assert plotting.fit_power_law(x, x**-1.0, x**-2.0)[0] == pytest.approx(-1.5, abs=1e-12)


def test_patch_slope_of_an_exact_law():
    """Binned medians of l = a^{3/2} have slope 3/2 without scatter, wherever the bins lie."""
    size = np.geomspace(1, 1e4, 801)
    centres, medians, counts = contact_patches.binned(size, size**1.5)
    assert counts.sum() == len(size)
    assert contact_patches.slope(centres, medians) == (pytest.approx(1.5, abs=1e-3), pytest.approx(0, abs=1e-3))


def test_standard_error_of_seeds():
    """Mean and s/√n; a single number has no error; digits follow the error."""
    findings = plotting.Findings()
    findings.add("several", [1.0, 2.0, 3.0])
    findings.add("one", 4.5)
    assert findings["several"] == (2.0, pytest.approx(1 / np.sqrt(3)))
    assert findings["one"] == (4.5, None)
    assert findings.text("several") == "2.00 ± 0.58"


def test_verdict_allows_two_standard_errors():
    """With an error of 0.03, 0.95 and 1.25 agree with the interval from 1 to 1.2; 0.93 and 1.27 do not."""
    claim = report.Claim("", "", "x", expected=(1.0, 1.2))
    for value, verdict in ((0.93, "differs"), (0.95, "agrees"), (1.25, "agrees"), (1.27, "differs")):
        assert claim.verdict(plotting.Findings(x=(value, 0.03))) == verdict
    assert report.Claim("", "", "x").verdict(plotting.Findings(x=(1.27, 0.03))) == ""


def test_nearest_load_of_each_folder(runs):
    """One load of each folder, and none if the areas asked for are far from all."""
    found = reading.cases([runs["seed1"], runs["seed2"]])
    area = found[1].area
    chosen = reading.nearest(found, area, slack=0.2)
    assert [case.index for case in chosen] == [1, 1]
    with pytest.raises(InputError, match="0.9999"):
        reading.nearest(found, 0.9999)


def test_pending_names_only_what_is_to_be_done(runs, tmp_path):
    """A complete run of the same job is done; another job, or no folder, is not."""
    job = tmp_path / "job.toml"
    job.write_text(reading.cases([runs["kept"]])[0].results.provenance["job_toml"])
    assert pending.is_done(runs["kept"], str(job), [])
    assert not pending.is_done(runs["kept"], str(job), ["surface.seed=2"])
    assert not pending.is_done(tmp_path / "nothing", str(job), [])


# A figure of each tool: arguments with the folders' names in braces.
FIGURES = {
    "quickstart_figures": ["{kept}"],
    "pressure_distribution": ["{kept}"],
    "autocorrelations": ["{bare}"],
    "stress_contact_spectra": ["{seed1}", "{seed2}"],
    "bearing_area": ["{seed1}", "{seed2}", "--area", "{area}", "--window", "2", "20"],
    "exponents": ["{seed1}", "{seed2}", "--areas", "{area}", "--window", "4", "16"],
    "persson_spectrum": ["{kept}"],
    "field_theory": ["{soft}"],
    "contact_patches": ["{kept}", "--smallest", "2"],
    "area_load": ["{seed1}", "{seed2}"],
    "resolution": ["{grid16}", "{grid32}", "{grid64}"],
}


def test_every_tool_draws_without_mpi4py(runs, tmp_path):
    """Where mpi4py cannot be imported, each tool writes PNG, PDF, a CSV with curves, and its numbers."""
    area = np.mean([case.area for case in reading.cases([runs["seed1"], runs["seed2"]]) if case.index == 1])
    names = {name: str(path) for name, path in runs.items()} | {"area": f"{area:.3f}"}
    calls = {tool: [part.format(**names) for part in parts] for tool, parts in FIGURES.items()}
    script = f"""
import importlib, sys
sys.modules["mpi4py"] = None
sys.path.insert(0, {str(TOOLS)!r})
for tool, arguments in {calls!r}.items():
    assert importlib.import_module(tool).main([*arguments, "--output", {str(tmp_path)!r}]) == 0, tool
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr, done.stderr
    for tool in FIGURES:
        name = "quickstart" if tool == "quickstart_figures" else tool
        for kind in ("png", "pdf", "json"):
            assert (tmp_path / f"{name}.{kind}").stat().st_size > 0
        with open(tmp_path / f"{name}.csv", encoding="utf-8") as file:
            rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
        assert len({row["curve"] for row in rows}) >= 2
        assert all(np.isfinite(float(row["x"])) for row in rows)


def test_wrong_folder_is_one_line(tmp_path, capsys):
    """A folder without results: exit code 2 and one line on stderr."""
    import pressure_distribution

    assert pressure_distribution.main([str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("tool", [*FIGURES, "report", "pending"])
def test_every_tool_explains_itself(tool, capsys):
    """--help prints what the tool does, with an example, and ends well."""
    with pytest.raises(SystemExit) as end:
        importlib.import_module(tool).main(["--help"])
    assert end.value.code == 0
    assert f"tools/{tool}.py" in capsys.readouterr().out


def test_report_is_one_page_with_verdicts(runs, tmp_path):
    """Figures are inside the page, claims have verdicts, what was not run is said."""
    folder = tmp_path / "paper"
    folder.mkdir()
    for name in ("kept", "seed1"):
        (folder / name).symlink_to(runs[name])
    claims = tmp_path / "claims.toml"
    claims.write_text(
        """
[[figure]]
title = "Pressures"
text = "…"
tool = "pressure_distribution"
runs = ["kept"]
claims = [{ what = "κ", paper = "about 2", finding = "κ, raw area", expected = [1, 4] },
          { what = "m₂", paper = "3", finding = "m₂ = ⟨σ²⟩_c/σ_c²", expected = [3, 3], why = "since" }]
[[figure]]
title = "Never"
text = "…"
tool = "resolution"
runs = ["nowhere-*"]
claims = []
""",
        encoding="utf-8",
    )
    page = report.write_report(folder, tmp_path / "out", claims).read_text(encoding="utf-8")
    assert "data:image/png;base64," in page and 'src="http' not in page
    assert '<span class="agrees">agrees</span>' in page and "since" in page
    assert "Not run yet." in page
    with open(tmp_path / "out" / "report.csv", encoding="utf-8") as file:
        assert [row["verdict"] for row in csv.DictReader(file)] == ["agrees", "differs"]


def test_jobs_and_claims_of_the_paper_are_valid():
    """Every job of the paper parses, and every tool that its report names exists."""
    for path in sorted((ROOT / "jobs" / "paper").glob("*.toml")):
        config.load(path)
    tools = {table["tool"] for table in tomllib.loads((TOOLS / "paper.toml").read_text(encoding="utf-8"))["figure"]}
    assert all((TOOLS / f"{tool}.py").is_file() for tool in tools)
    assert report.read_figures(TOOLS / "paper.toml")


@pytest.mark.long
def test_small_paper_measures_every_claim(tmp_path):
    """`jobs/paper.sh --small` makes a report in which no claim lacks its number; started again, it runs nothing."""
    command = ["bash", ROOT / "jobs" / "paper.sh", "--small", tmp_path]
    subprocess.run(command, check=True, timeout=3000)
    with open(tmp_path / "report" / "report.csv", encoding="utf-8") as file:
        measured = {(row["figure"], row["quantity"]) for row in csv.DictReader(file)}
    figures = report.read_figures(TOOLS / "paper.toml")
    assert {(figure.title, claim.what) for figure in figures for claim in figure.claims} == measured
    again = subprocess.run(command, check=True, timeout=600, capture_output=True, text=True)
    assert " 0 of " in f" {again.stdout}"
