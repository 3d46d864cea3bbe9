"""The serial tools: fields in row blocks, fits, verdicts, and every figure made without MPI."""

import csv
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from xml.etree import ElementTree

import browser
import choosing
import claims
import contact_patches
import estimators
import exponents
import figures
import leakage
import numpy as np
import plotting
import pytest
import reading
import report
import rowblocks
import runs as many_runs
import samples
import whole_fields
from conftest import ROOT, broad, python
from formulas import marked

import pgfmd
from pgfmd.application import job as config
from pgfmd.application.results import Results
from pgfmd.errors import InputError

PAPER = ROOT / "tools" / "paper"
ALL = ("histogram", "spectra", "acf", "patches", "bearing", "lowpass")
FOLLOWING = {"percolation": ("gap",), "leakage": ("flux_x", "flux_y"), "partial_slip": ("traction", "pressure"),
             "subsurface": ("von_mises",)}  # fmt: skip
SOFT = {"wall": {"kind": "exponential", "zeta": 0.25}, "keep": ("spectra",)}


def _rough(shortest=4.0, seed=1):
    return {"kind": "self-affine", "hurst": 0.8, "lambda_s": shortest, "rms_slope": 0.031, "seed": seed}


ONE = {"pressure": [0.003]}
IN_FILE = {"kind": "file", "path": "heights.npy"}
RUNS = {  # sections of the job; n, observables and fields by themselves
    "kept": {}, "bare": {"keep": ()}, "nothing": {"keep": (), "fields": ()},
    **{f"seed{seed}": {"surface": _rough(1.0, seed)} for seed in (1, 2)},
    **{f"grid{n}": {"surface": _rough(n / 16), "n": n, "load": ONE} for n in (16, 32, 48)},
    **{f"soft{seed}": {"surface": _rough(seed=seed)} | SOFT for seed in (1, 2)},
    "sharp": {"keep": (), "solver": {"tolerance": 1e-13}},
    "file": {"surface": IN_FILE}, "soft file": {"surface": IN_FILE} | SOFT,
    "sinusoid": {"surface": {"kind": "sinusoid", "amplitude": 0.1, "waves": 2}},
    "paraboloid": {"surface": {"kind": "paraboloid", "radius": 100.0}, "load": {"pressure": [1e-4, 1e-3]}},
    "profile": {"surface": {"kind": "sinusoid", "amplitude": 0.1, "waves": 2}, "n": [48, 1]},
    "no patches": {"keep": ("histogram", "spectra"), "fields": ()}, "one load": {"load": ONE},
    "none to full": {"load": {"pressure": [0.0, 0.003, 0.3]}}, "areas": {"load": {"contact_area": [0.04, 0.08]}},
    "adhesive": {"wall": {"kind": "adhesive", "work": 0.02, "range": 1.0}, "n": 32, "keep": (),
                 "load": {"mean_gap": [0.6, 0.5, 0.4]}},
    "following": {"surface": _rough(8.0), "keep": tuple(FOLLOWING),
                  "fields": sorted({field for names in FOLLOWING.values() for field in names})},
}  # fmt: skip


class Made(dict):
    """Small runs, each made when first asked for: name → result folder."""

    def __init__(self, folder: Path):
        self.folder = folder
        np.save(folder / "heights.npy", np.random.default_rng(3).normal(size=(48, 48)).cumsum(0) * 1e-2)

    def __missing__(self, name: str) -> Path:
        job = {"surface": _rough(), "load": {"pressure": [0.003, 0.02]}, "solid": {"lame_lambda": 1.0, "lame_mu": 1.0}}
        job |= {"n": 48, "keep": ALL, "fields": ("height", "pressure")} | RUNS[name]
        job["grid"] = {"n": job.pop("n")}
        job["output"] = {"fields": job.pop("fields"), "observables": job.pop("keep"), "partial_slip": {"friction": 0.3}}
        self[name] = self.folder / name.replace(" ", "-")
        pgfmd.run(config.parse(config.tables_as_toml(job), folder=str(self.folder)), self[name])
        return self[name]


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> dict[str, Path]:
    return Made(tmp_path_factory.mktemp("runs"))


def _blocks(field, rows):
    """The field in blocks of that many rows."""
    return [(slice(i, min(i + rows, len(field))), field[i : i + rows]) for i in range(0, len(field), rows)]


@pytest.mark.parametrize("shape", [(24, 24), (15, 22), (9, 7)])
def test_spectrum_in_blocks_is_that_of_the_field(shape):
    """However a field is cut, its averaged spectrum is that of one transform; 1e-12 is rounding over a few adds."""
    field = np.random.default_rng(1).normal(size=shape)
    lengths = (3.0, 3.0 * shape[1] / shape[0])
    found = rowblocks.radial_spectrum(_blocks(field, 4), shape, lengths, memory=16 * shape[0] * 3)
    expected = whole_fields.radial_average(whole_fields.power_spectrum(field), shape, lengths)
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12)


@pytest.mark.parametrize("shape", [(24, 24), (15, 22), (9, 7)])
def test_autocorrelation_in_blocks_is_that_of_the_field(shape):
    """As for the spectrum, with the transforms back; means of the field's square set the scale of rounding."""
    field = np.random.default_rng(2).normal(size=shape)
    lengths = (3.0, 3.0 * shape[1] / shape[0])
    found = rowblocks.radial_autocorrelation(_blocks(field, 5), shape, lengths, memory=16 * shape[1] * 2)
    expected = whole_fields.radial_autocorrelation(whole_fields.autocorrelation(field), lengths)
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-13)


def test_fields_alone_give_what_the_run_would_have_kept(runs):
    """Spectra from the fields of a run that kept none are those that the run measured, up to rounding."""
    kept, bare = (reading.loads([runs[name]])[1] for name in ("kept", "bare"))
    for name in ("stress", "contact", "height"):
        for ours, theirs in zip(bare.spectrum(name), kept.spectrum(name), strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-9)
    for name in ("stress", "contact"):
        assert bare.correlation(name)[1][0] == pytest.approx(kept.correlation(name)[1][0], rel=1e-12, abs=0)


def test_slope_from_the_height_spectrum(runs):
    """√Σ q²|h̃|² over the bins is the slope asked for, up to the width of the bins (20 to a decade: second order)."""
    case = reading.loads([runs["kept"]])[0]
    q, power, count = case.spectrum("height")
    assert np.sqrt(np.sum(q**2 * power * count)) == pytest.approx(0.031, rel=5e-3, abs=0)


def test_sum_rules_of_the_spectra_of_a_run(runs):
    """Σ_{q≠0} |f̃|² = ⟨f²⟩ − ⟨f⟩² exactly, where no mode is cut off."""
    group = reading.loads([runs["seed1"], runs["seed2"]])
    assert all(round(case.spectrum("contact")[2].sum()) == 48**2 - 1 for case in group)
    for kind in ("contact", "stress"):
        assert abs(exponents.worst_sum(group, kind)) < 1e-12


def test_joint_power_law_is_exact_for_power_laws():
    """Of two power laws of one exponent both are found; of slopes −1 and −2 on equal points it is the mean."""
    x = np.geomspace(3, 50, 17)
    exponent, logarithms = estimators.fit_power_law(x, 5 * x**-1.3, 0.2 * x**-1.3)
    assert exponent == pytest.approx(-1.3, abs=1e-12)
    np.testing.assert_allclose(np.exp(logarithms), [5, 0.2], rtol=1e-12)
    assert estimators.fit_power_law(x, x**-1.0, x**-2.0)[0] == pytest.approx(-1.5, abs=1e-12)


def test_patch_slope_of_an_exact_law():
    """Binned medians of l = a^{3/2} have slope 3/2 without scatter, wherever the bins lie."""
    size = np.geomspace(1, 1e4, 801)
    centres, medians, counts = contact_patches.binned(size, size**1.5)
    assert counts.sum() == len(size)
    assert estimators.fit_power_law(centres, medians)[0] == pytest.approx(1.5, abs=1e-3)


def test_standard_error_of_seeds():
    """Mean and s/√n; a single number has no error; the farthest choice is the spread; digits follow the error."""
    findings = plotting.Findings()
    findings.add("several", [1.0, 2.0, 3.0])
    findings.add("one", 4.5)
    findings.add("chosen", [1.0, 2.0, 3.0], [1.5, 2.2])
    assert (findings["several"].value, findings["several"].seeds) == (2.0, pytest.approx(1 / np.sqrt(3)))
    assert (findings["one"].value, findings["one"].error) == (4.5, None)
    assert findings["chosen"].choices == 0.5
    assert findings["chosen"].error == pytest.approx(np.sqrt(1 / 3 + 1 / 4))
    assert findings.text("several") == "2.00 ± 0.58"


def _verdict(part: dict, value: float, error: float | None = 0.03) -> str:
    whole = claims.Part("", "F: x", **part)
    return whole.verdict(whole.measured({"F": plotting.Findings(x=plotting.Finding(value, error))}))


def test_verdict_on_a_number():
    """1.3 ± 0.1 with a standard error of 0.03, hence 95 % within 0.059: agrees within, differs from 0.159 on."""
    part = {"number": (1.3, 0.1)}
    for value, verdict in ((1.21, "agrees"), (1.39, "agrees"), (1.45, "cannot tell"), (1.47, "differs")):
        assert _verdict(part, value) == verdict
    assert _verdict(part, 1.3, 0.06) == "cannot tell"  # our uncertainty is larger than the paper's
    assert _verdict(part, 1.3, None) == "cannot tell"  # none is known
    assert _verdict(part | {"exact": True}, 1.3, None) == "agrees"


def test_uncertainty_is_students():
    """Four seeds, standard error s: 95 % within 3.182 s; the spread over choices counts without seeds only."""
    assert plotting.Finding(1.0, 0.1, 0.5, 4).uncertainty == pytest.approx(0.3182, rel=1e-3)
    assert plotting.Finding(1.0, None, 0.5).uncertainty == 0.5
    assert plotting.Finding(1.0).uncertainty is None


def test_verdict_on_a_statement():
    """Between 0.8 and 1.2, on one side of 1, and beyond a range, with a standard error of 0.03."""
    between, above, beyond = {"range": (0.8, 1.2)}, {"range": (1.0, np.inf)}, {"beyond": (0.8, 1.2)}
    for value, verdict in ((0.75, "cannot tell"), (0.81, "agrees"), (1.19, "agrees"), (1.27, "differs")):
        assert _verdict(between, value) == verdict
    assert _verdict(between, 1.0, 0.25) == "cannot tell"
    for value, verdict in ((1.06, "agrees"), (1.04, "cannot tell"), (0.95, "cannot tell"), (0.93, "differs")):
        assert _verdict(above, value) == verdict
    cases = ((1.26, "agrees"), (0.7, "agrees"), (1.21, "cannot tell"), (1.15, "cannot tell"), (1.1, "differs"))
    for value, verdict in cases:
        assert _verdict(beyond, value) == verdict


def test_verdict_of_a_claim():
    """All parts agree, half of them, fewer; the limit does not decide; identities are never agreement."""
    assert _verdict({"identity": (0.0, 1e-10)}, 1e-12) == "identity"
    assert _verdict({"identity": (0.0, 1e-10)}, 1e-9) == "violated"
    assert _verdict({}, 1.0) == ""

    def judged(**values: float) -> str:
        parts = [claims.Part("", f"F: {name}", number=(1.0, 0.1)) for name in "abc"]
        parts.append(claims.Part("", "F: d", number=(1.0, 0.1), column="limit"))
        found = {name: plotting.Finding(value, 0.01) for name, value in values.items()}
        return claims.Claim(1, "", "", "F", tuple(parts)).verdict({"F": plotting.Findings(found)})

    assert judged(a=1, b=1, c=1, d=2) == "agrees"
    assert judged(a=1, b=1, c=2, d=2) == "agrees in a range"
    assert judged(a=1, b=2, c=2, d=1) == "differs"
    assert judged(a=1, b=1.11, c=2, d=1) == "cannot tell"
    assert judged(a=1, b=1, d=1) == "not run"


def test_one_counterexample_refutes_only():
    """A claim that something happens there only differs where one part does, however many agree."""
    parts = [{"number": (1.0, 0.1)}, {"number": (1.0, 0.1)}, {"number": (2.0, 0.1)}]
    parts = tuple(claims.Part("x", "F: x", exact=True, **part) for part in parts)
    findings = {"F": plotting.Findings()}
    findings["F"].add("x", 1.0)
    verdicts = [claims.Claim(1, "", "", "F", parts, only=only).verdict(findings) for only in (False, True)]
    assert verdicts == ["agrees in a range", "differs"]


def test_paired_differences():
    """Seeds that share their scatter: the difference of their numbers is known better than either."""
    findings = plotting.Findings()
    findings.add("x", [1.0, 2.0, 3.0], [2.5])
    findings.add("y", [0.5, 1.6, 2.4], [2.2])
    less = claims.Part("", "F: x", minus="F: y", paired=True).measured({"F": findings})
    assert less.value == pytest.approx(0.5) and less.seeds == pytest.approx(0.1 / np.sqrt(3))
    assert less.choices == pytest.approx(0.2)


def test_differences_and_quotients_carry_both_errors():
    """(3 ± 0.3) − (2 ± 0.4) and over: errors add in squares, relative ones for the quotient."""
    found = {"F": plotting.Findings(x=plotting.Finding(3.0, 0.3), y=plotting.Finding(2.0, 0.4, 0.2))}
    less = claims.Part("", "F: x", minus="F: y").measured(found)
    assert (less.value, less.seeds, less.choices) == (1.0, pytest.approx(0.5), 0.2)
    over = claims.Part("", "F: x", over="F: y").measured(found)
    assert over.value == 1.5 and over.seeds == pytest.approx(1.5 * np.hypot(0.1, 0.2))


def test_nearest_load_of_each_folder(runs):
    """One load of each folder, and none if the areas asked for are far from all."""
    found = reading.loads([runs["seed1"], runs["seed2"]])
    area = found[1].area
    chosen = choosing.near(found, [area], slack=0.2)
    assert [case.index for case in chosen] == [1, 1]
    with pytest.raises(InputError, match="0.9999"):
        choosing.near(found, [0.9999])


def test_only_what_is_to_be_done_is_run(runs, tmp_path):
    """A complete run of the same job is done; another job, or no folder, is not."""
    job = tmp_path / "job.toml"
    job.write_text(reading.loads([runs["kept"]])[0].results.provenance["job_toml"])
    assert many_runs.is_done(runs["kept"], str(job), [])
    assert not many_runs.is_done(runs["kept"], str(job), ["surface.seed=2"])
    assert not many_runs.is_done(tmp_path / "nothing", str(job), [])


@pytest.mark.parametrize("number", broad([signal.SIGTERM, signal.SIGINT]), ids=["termination", "interrupt"])
def test_a_signal_ends_all_runs(tmp_path, number):
    """The processes of the runs end with the one that started them, which says nothing."""
    line = f"long {ROOT / 'jobs' / 'paper' / 'large.toml'} grid.n=1024\n"
    command = [sys.executable, str(PAPER / "runs.py"), str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdin.write(line)
        process.stdin.close()
        started = tmp_path / "long.log"
        while not (started.exists() and "load 1/" in started.read_text()) and process.poll() is None:
            time.sleep(0.1)
        family = [path.name for path in Path("/proc").glob("[0-9]*") if _state(path.name)[1:2] == [str(process.pid)]]
        process.send_signal(number)
        assert process.wait(60) == 128 + number
        assert process.stderr.read() == ""
    end = time.monotonic() + 60
    while any(_state(pid)[:1] not in ([], ["Z"]) for pid in family) and time.monotonic() < end:
        time.sleep(0.1)
    assert family and all(_state(pid)[:1] in ([], ["Z"]) for pid in family)


@pytest.mark.breadth
def test_a_run_that_is_killed_ends_all(tmp_path):
    """Of two runs one is killed, as where memory runs out: the other ends too, with one line and exit code 1."""
    job = ROOT / "jobs" / "paper" / "large.toml"
    command = [sys.executable, str(PAPER / "runs.py"), str(tmp_path), "--jobs", "2"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdin.write("".join(f"run{seed} {job} grid.n=1024 surface.seed={seed}\n" for seed in (1, 2)))
        process.stdin.close()
        while not all((tmp_path / f"run{seed}.log").exists() for seed in (1, 2)) and process.poll() is None:
            time.sleep(0.1)
        family = [path.name for path in Path("/proc").glob("[0-9]*") if _state(path.name)[1:2] == [str(process.pid)]]
        os.kill(int(max(family, key=int)), signal.SIGKILL)
        assert process.wait(60) == 1
        assert re.fullmatch("runs.py: error: a run ended without a result .*\n", process.stderr.read())


def _state(pid: str) -> list[str]:
    """State, parent, … of a process; nothing if it is not there."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return []


# Which kinds of run there are, and which figures each can give: all others refuse in one line.
GENERAL = {"overview", "area_load", "pressure_distribution", "autocorrelations", "stress_contact_spectra"}
GENERAL |= {"bearing_area", "exponents", "persson_spectrum", "contact_patches", "energy_by_scale", "correlation_decay"}
GENERAL |= {"contact_stiffness", "dependence"}
SOFT_ONES = {"overview", "persson_spectrum", "field_theory", "energy_by_scale", "area_load", "dependence"}
SOFT_ONES |= {"contact_stiffness"}
KINDS = {
    ("kept",): GENERAL,
    ("nothing",): {"area_load", "overview", "contact_stiffness", "dependence"},
    ("none to full",): GENERAL,
    ("profile",): GENERAL - {"autocorrelations", "correlation_decay"},
    ("soft1", "soft2"): SOFT_ONES,
    ("following",): {"area_load", "overview", "contact_stiffness", "autocorrelations", "correlation_decay",
                     "dependence", *FOLLOWING},
    ("grid16", "grid32", "grid48"): GENERAL - {"contact_stiffness"} | {"resolution"},
    ("kept", "file", "soft1", "nothing", "areas", "none to full"): GENERAL | {"field_theory"},
    ("seed1", "seed2"): GENERAL,
    ("bare",): GENERAL - {"pressure_distribution", "bearing_area", "contact_patches"},
    ("file",): GENERAL,
    ("sinusoid",): GENERAL,
    ("paraboloid",): GENERAL,
    ("soft file",): SOFT_ONES,
    ("no patches",): GENERAL - {"autocorrelations", "correlation_decay", "bearing_area", "contact_patches"},
    ("one load",): GENERAL - {"contact_stiffness"},
    ("areas",): GENERAL,
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("names", broad([(names,) for names in KINDS], 5), ids="+".join)
def test_every_figure_on_every_kind_of_run(runs, names):
    """A figure is drawn, with curves, or refuses in one line that says what is missing; nothing warns."""
    for figure in figures.FIGURES:
        folders = [runs[name] for name in names]
        if figure in KINDS[names]:
            sheet = figures.draw(figure, folders)
            assert sheet._table or figure == "overview", figure
            plotting.plt.close(sheet.figure)
        else:
            with pytest.raises(InputError, match="needs|takes one|nothing to draw") as refused:
                figures.draw(figure, folders)
            assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("name", "solved"), [("kept", True), ("bare", False)])
def test_the_legend_names_f_as_solved_only_where_it_is_drawn(runs, name, solved):
    """"bare" did not solve low-passed surfaces."""
    sheet = figures.draw("persson_spectrum", [runs[name]])
    labels = sum((panel.get_legend_handles_labels()[1] for panel in sheet.panels), [])
    assert "$f(q)$, Persson" in labels and ("$f(q)$, solved" in labels) == solved
    plotting.plt.close(sheet.figure)


def test_loads_are_never_taken_for_seeds(runs):
    """Loads of one run are settings of their own; runs that differ by the seed alone are samples of one setting."""
    both = samples.ensembles(reading.loads([runs["seed1"], runs["seed2"]]))
    assert [len(group) for group in both] == [2, 2]
    assert {load.seed for load in both[0]} == {1, 2}
    assert all("f_c = " in group.label for group in both)
    assert [len(group) for group in samples.ensembles(reading.loads([runs["kept"]]))] == [1, 1]
    sheet = figures.draw("pressure_distribution", [runs["kept"]])
    assert sum(name.startswith("κ, raw area") for name in sheet.findings) == 2


def test_settings_are_named_by_what_differs(runs):
    """Labels hold the key that differs, and no other."""
    labels = [group.label for group in samples.ensembles(reading.loads([runs["seed1"], runs["kept"]]), by_load=False)]
    assert labels == ["λ_s = 1", "λ_s = 4"]


def test_resolution_takes_grids_not_loads(runs):
    """Several loads of one grid, and grids of several problems, are refused, with what differs."""
    with pytest.raises(InputError, match="at least three grids"):
        figures.draw("resolution", [runs["kept"]])
    with pytest.raises(InputError, match="surface.seed"):
        figures.draw("resolution", [runs["seed1"], runs["seed2"]])


def test_loads_in_tension_have_no_place_on_a_logarithmic_axis(tmp_path):
    """area_load leaves them out, and is refused if no other load is there."""
    rough = {"kind": "self-affine", "hurst": 0.8, "lambda_s": 8.0, "rms_slope": 0.3, "seed": 1}
    wall = {"kind": "adhesive", "work": 0.3, "range": 1.5}
    job = {"grid": {"n": 16}, "surface": rough, "solid": {"contact_modulus": 1.0}, "wall": wall}
    found = pgfmd.run(job | {"load": {"displacement": 0.5}}, tmp_path)
    assert found.loads["mean_pressure"][0] < 0 < found.loads["contact_area"][0]
    with pytest.raises(InputError, match="a load above zero"):
        figures.draw("area_load", [tmp_path])


@pytest.mark.breadth
def test_every_figure_is_saved_without_mpi4py(runs, tmp_path):
    """Where mpi4py cannot be imported, each figure writes PNG, PDF, a CSV with curves, and its numbers."""
    soft, grids = ("soft1", "soft2"), ("grid16", "grid32", "grid48")
    which = {figure: ["kept"] for figure in figures.FIGURES} | {"field_theory": soft, "resolution": grids}
    which |= {"force_approach": ["adhesive"]} | dict.fromkeys(FOLLOWING, ["following"])
    calls = {figure: [str(runs[name]) for name in names] for figure, names in which.items()}
    script = f"""
import sys
sys.modules["mpi4py"] = None
from pgfmd.application.cli import main
for figure, folders in {calls!r}.items():
    assert main(["plot", figure, *folders, "--output", {str(tmp_path)!r}]) == 0, figure
"""
    done = python(script)
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr, done.stderr
    for figure in figures.FIGURES:
        for kind in ("png", "pdf", "json"):
            assert (tmp_path / f"{figure}.{kind}").stat().st_size > 0
        with open(tmp_path / f"{figure}.csv", encoding="utf-8") as file:
            rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
        # theories of adhesion are those of spheres; stiffness at fixed contact is an observable of its own; a number of
        # one setting is one curve
        least = 1 if figure in ("force_approach", "contact_stiffness", "partial_slip", "dependence") else 2
        assert len({row["curve"] for row in rows}) >= least
        assert all(np.isfinite(float(row["x"])) for row in rows)


def test_wrong_folder_is_one_line(tmp_path, capsys):
    """A folder without results, no folder, no figure, no option: exit code 2, one line that names what is wrong."""
    folder = str(tmp_path)
    for words in ([folder], ["no/such/folder"], [], [folder, "--no-option"], [folder, "--areas", "x"]):
        assert figures.main(["pressure_distribution", *words]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert figures.main(["no_such_figure", folder]) == 2
    assert "area_load" in capsys.readouterr().err
    assert figures.main([str(tmp_path / "typo")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "typo': neither a folder nor a figure" in said


@pytest.mark.breadth
def test_a_folder_alone_is_an_overview(runs, tmp_path, capsys):
    """`pgfmd plot DIR` draws `pgfmd plot overview DIR`."""
    assert figures.main([str(runs["kept"]), "--output", str(tmp_path)]) == 0
    assert (tmp_path / "overview.png").stat().st_size > 0


def test_every_folder_is_installed():
    """The packages named in pyproject.toml are the folders of pgfmd/ that hold modules, and the figures."""
    plan = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    folders = {path.parent.relative_to(ROOT) for path in (ROOT / "pgfmd").rglob("*.py")}
    assert sorted(plan["packages"]) == sorted({".".join(folder.parts) for folder in folders} | {"pgfmd_plots"})


def test_without_matplotlib_one_line_says_how_to_get_it(runs):
    """Exit code 2 and one line on stderr."""
    script = f"""
import sys
sys.modules["matplotlib"] = None
from pgfmd.application.cli import main
sys.exit(main(["plot", {str(runs["kept"])!r}]))
"""
    done = python(script)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "pip install" in done.stderr, done.stderr


def test_names_from_files_are_text(runs, tmp_path, capsys):
    """A folder's name with control characters reaches the terminal without them, and never becomes a formula."""
    folder = tmp_path / "a\x1b[31m$b_{"
    folder.symlink_to(runs["bare"])
    assert figures.main(["contact_patches", str(folder)]) == 2
    assert "\x1b" not in capsys.readouterr().err
    other = tmp_path / "c\x1b[31m$d^{"
    other.symlink_to(runs["kept"])
    assert figures.main(["contact_patches", str(folder), str(other), "--output", str(tmp_path / "out")]) == 0
    assert "\x1b" not in capsys.readouterr().out


@pytest.mark.parametrize("figure", figures.FIGURES)
def test_every_figure_explains_itself(figure, capsys):
    """It stands in the list with what it needs; --help prints what it shows, with its command; it has a caption."""
    with pytest.raises(SystemExit) as end:
        figures.main([figure, "--help"])
    assert end.value.code == 0
    assert f"pgfmd plot {figure}" in capsys.readouterr().out
    drawn = figures.module(figure)
    assert drawn.CAPTION and set(drawn.NEEDS) <= set(choosing.NEEDS)
    assert figures.main([]) == 0
    assert figure in capsys.readouterr().out


def test_an_exact_field_theory_reads_one(runs):
    """Stress spectra that obey field theory exactly, mode by mode, give 1 in every band up to rounding (1e-12)."""
    import field_theory

    load = reading.loads([runs["soft1"]])[0]
    x, count = load.spectrum("stress")[0] / load.q_unit, load.spectrum("stress")[2]
    height = load.results.field("height")
    qx, qy = rowblocks.wave_numbers(height.shape, load.results.lengths)
    q = np.hypot(qx, qy)
    g1 = 1 / (1 + load.zeta * q * load.modulus / (2 * load.mean_pressure))
    exact = (g1 * load.modulus * q / 2) ** 2 * whole_fields.power_spectrum(height)
    sums = rowblocks.accumulate(load.edges, q, rowblocks.hermitian_weight(height.shape[1]), exact)
    obeyed = rowblocks.radial_mean(sums)[1]
    ratios = estimators.band_ratio(field_theory.BANDS, np.round(x), count, obeyed, field_theory.summed(load))
    seen = np.isfinite(ratios)
    assert np.count_nonzero(seen) >= 3
    np.testing.assert_allclose(ratios[seen], 1, rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "within"), [("kept", 4 * 2**-24), ("file", 4 * 2**-24), ("soft1", 1e-12), ("sharp", 1e-12)]
)
def test_energy_of_all_scales_is_that_of_the_run(runs, name, within):
    """½ Σ |σ̃|²/stiffness over all modes is the elastic energy of the table of loads.  Where a run takes it from a
    response in single precision, compliance, spectrum and two transforms each round by up to 2⁻²⁴."""
    import energy_by_scale

    for load in reading.loads([runs[name]]):
        energy = load.number("elastic_energy")
        assert energy_by_scale.energies(load)[1].sum() == pytest.approx(energy, rel=within, abs=0)


def test_energy_from_spectra_is_that_of_the_field_up_to_the_bins(runs):
    """The mean q of a bin in place of each mode's: second order in bins of 12 %, of all modes together below 1e-3."""
    import energy_by_scale

    kept = reading.loads([runs["seed1"]])[0]
    q, stress, count = kept.spectrum("stress")
    assert round(count.sum()) == 48**2 - 1
    assert np.sum(count * stress / (kept.modulus * q)) == pytest.approx(
        energy_by_scale.energies(kept)[1].sum(), rel=1e-3, abs=0
    )


@pytest.mark.parametrize(("tau", "most"), [(1.85, np.inf), (2.3, np.inf), (0.4, 30.0), (1.0, 30.0), (-0.5, 30.0)])
def test_exponent_of_a_drawn_power_law(tau, most):
    """Maximum likelihood finds τ of 4000 members within four standard errors, and the law is not excluded."""
    sample = estimators.draw_power_law(np.random.default_rng(7), 4000, tau, 1.0, most)
    found, error, _ = estimators.tail_exponent(sample, 1.0, most)
    assert error < 0.05
    assert abs(found - tau) < 4 * error
    assert estimators.goodness(sample, 1.0, most, draws=50) > 0.01


def test_a_sample_of_no_power_law_is_excluded():
    """Log-normal areas are no power law, and the test of goodness says so."""
    sample = np.exp(np.random.default_rng(8).normal(size=2000)) * 3
    assert estimators.goodness(sample, 1.0, draws=50) < 0.05


def test_crossover_of_two_power_laws():
    """Two exact laws that meet at 2 give slopes and the meeting point, to the step of the search."""
    x = np.geomspace(0.01, 100, 25)
    below, above, knot = estimators.broken_power_law(x, np.where(x < 2, (x / 2) ** 1.5, x / 2))
    assert (below, above) == (pytest.approx(1.5, abs=0.01), pytest.approx(1.0, abs=0.01))
    assert np.log(knot / 2) == pytest.approx(0, abs=np.log(1e4) / 100)


def test_report_is_one_page_with_verdicts(runs, tmp_path):
    """Figures are inside the page, claims have verdicts, what was not run is said, and names are text, not HTML."""
    folder = tmp_path / "paper"
    folder.mkdir()
    for name, path in (("kept<b>", "kept"), ("seed1", "seed1")):
        (folder / name).symlink_to(runs[path])
    source = tmp_path / "claims.toml"
    source.write_text(
        """
departures = ["<i>none</i>"]
[[figure]]
key = "P"
title = "Pressures <script>"
tool = "pressure_distribution"
options = { targets = [0.003] }
runs = ["kept*"]
[[figure]]
key = "N"
title = "Never"
tool = "resolution"
runs = ["nowhere-*"]
[[claim]]
number = 1
says = "κ is about 2 <"
where = "figure 1"
figure = "P"
parts = [{ what = "κ", finding = "P: κ, raw area, p̄ = 0.003", range = [1, 4], exact = true }]
[[claim]]
number = 2
says = "m₂ is 3"
where = "figure 1"
figure = "P"
why = "since"
parts = [{ what = "m₂", finding = "P: m₂ = ⟨σ²⟩_c/σ_c², p̄ = 0.003", number = [3, 0.1], exact = true }]
[[claim]]
number = 3
says = "never"
where = "figure 2"
figure = "N"
parts = [{ what = "x", finding = "N: y", number = [1, 1] }]
""",
        encoding="utf-8",
    )
    page = report.write_report(folder, tmp_path / "out", source).read_text(encoding="utf-8")
    assert "data:image/png;base64," in page and 'src="http' not in page
    assert '<span class="v agrees">agrees</span>' in page and "since" in page
    assert "not run yet" in page
    assert "<script>" not in page and "<i>none" not in page and "kept<b>" not in page and "2 <" not in page
    verdicts = (tmp_path / "out" / "report.csv").read_bytes()
    with open(tmp_path / "out" / "report.csv", encoding="utf-8") as file:
        assert [row["verdict"] for row in csv.DictReader(file)] == ["agrees", "differs", "not run"]
    assert report.write_page(tmp_path / "out", source).read_text(encoding="utf-8") == page  # from its own files
    assert (tmp_path / "out" / "report.csv").read_bytes() == verdicts
    if browser.executable():
        assert (tmp_path / "out" / "report.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(("text", "formulas"), [
    ("At f_c = 0.3 % it is near <1>", ["<msub>f c</msub>=0.3"]),
    ("C_c ≤ C_σ/σ_c² ≤ m₂ C_c, everywhere", ["<msub>C c</msub>≤<msub>C σ</msub>/<msubsup>σ c 2</msubsup>≤"
                                            "<msub>m 2</msub><msub>C c</msub>"]),
    ("falls as q^(−(1+H)) up to q*.", ["<msup>q −(1+H)</msup>", "<msup>q *</msup>"]),
    ("a patch of 8 a, (λ_s = a)", ["(<msub>λ s</msub>=a)"]),
    ("κ = f_c E'g/p̄ and √(8/π), ⟨σ²⟩_c", ["κ=<msub>f c</msub><msup>E ′</msup>g/<mover>p ¯</mover>",
                                          "<msqrt>8 / π</msqrt>", "<msub>⟨<msup>σ 2</msup>⟩ c</msub>"]),
    ("at H = 0.8 (32 surfaces): below", ["H=0.8"]),
    ("at 0.1 λ_s² (τ = 0.09 up to there)", ["0.1<msubsup>λ s 2</msubsup>", "τ=0.09"]),
    ("Figure 2, Campañá's “P” over 4 to 8", []),
])  # fmt: skip
def test_formulas_in_sentences(text, formulas):
    """A sentence is valid XML, keeps its words, and has exactly these formulas in MathML."""
    tree = ElementTree.fromstring(f"<p>{marked(text)}</p>")
    assert [_written(found) for found in tree.iter("math")] == formulas
    assert tree.text is None or text.startswith(tree.text)
    assert not formulas or len("".join(tree.itertext())) >= len(re.sub(r"[\s_^()√]", "", text))


def _written(node) -> str:
    """A formula with the tags that say how it looks."""
    inner = [_written(child) for child in node if child.tag != "mspace"] or [node.text or ""]
    shown = node.tag in ("msub", "msup", "msubsup", "mover", "msqrt")
    return f"<{node.tag}>{' '.join(inner)}</{node.tag}>" if shown else "".join(inner)


def test_claims_of_the_paper_are_valid():
    """The 27 claims refer to figures that exist, drawn by tools that exist."""
    plan = report.read_figures(PAPER / "claims.toml")
    assert {figure.tool for figure in plan} <= set(figures.FIGURES)
    asked, _ = claims.read(PAPER / "claims.toml", {figure.key for figure in plan})
    assert [claim.number for claim in asked] == list(range(1, 28))
    assert all(claim.parts for claim in asked)


@pytest.mark.long
def test_small_paper_measures_every_claim(tmp_path):
    """`jobs/paper.sh --small` makes a report in which claims have their numbers; started again, it runs nothing."""
    command = ["bash", ROOT / "jobs" / "paper.sh", "--small", tmp_path]
    subprocess.run(command, check=True, timeout=3000)
    with open(tmp_path / "report" / "report.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    unmeasured = {(row["claim"], row["part"]) for row in rows if not row["measured"]}
    assert unmeasured <= {
        ("25", "exponent of small patches (to 0.1 λ_s²)")
    }  # too few pixels there at an eighth of the size
    assert {int(row["claim"]) for row in rows} == set(range(1, 28))
    again = subprocess.run(command, check=True, timeout=600, capture_output=True, text=True)
    assert " 0 of " in f" {again.stdout}"


def test_stiffness_between_loads_lies_between_that_of_both(tmp_path):
    """K(p̄₁) ≤ Δp̄/Δδ ≤ K(p̄₂), as the contact only grows with the load; bars are the errors that the run estimated."""
    load, wanted = {"pressure": [0.004, 0.01, 0.02]}, {"observables": ["stiffness", "spectra", "discretisation"]}
    rough = {"kind": "self-affine", "hurst": 0.8, "lambda_s": 8.0, "rms_slope": 0.1}
    job = {"grid": {"n": 64}, "surface": rough, "solid": {"contact_modulus": 1.0}, "load": load, "output": wanted}
    pgfmd.run(job, tmp_path / "run")
    sheet = figures.draw("contact_stiffness", [tmp_path / "run"])
    rows = sheet._tables["means"][1]
    fixed, between = ([row[3:5] for row in rows if row[1] == kind] for kind in ("fixed contact", "between loads"))
    for (low, _), (secant, _), (high, _) in zip(fixed, between, fixed[1:], strict=False):
        assert low < secant < high
    assert len(between) == 2 and all(0 < error < 1e-2 * value for value, error in fixed)
    errors = [row[4] for row in figures.draw("area_load", [tmp_path / "run"])._table if row[:2] == (1, "simulation")]
    bars = [load.numbers["contact_area_corrected_error"] for load in Results(tmp_path / "run")]
    np.testing.assert_allclose(errors, bars, rtol=1e-12)


def test_power_laws_and_levels_of_one_number_against_another(runs):
    """p̄/(2 p̄)² is a power law of exponent −1, without error; it reaches the geometric mean of its ends at that of p̄."""
    import dependence

    found = reading.loads([runs["seed1"], runs["seed2"]])
    law = dependence.Quantity("", lambda load: 0.25 / load.mean_pressure)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(dependence.QUANTITIES, "inverse", law)
        loads = sorted({load.mean_pressure for load in found})
        level = 0.25 / np.sqrt(loads[0] * loads[-1])
        options = {"of": ["inverse"], "on": "mean_pressure", "fit": (0.0, 1.0), "level": level}
        sheet = figures.draw("dependence", [runs["seed1"], runs["seed2"]], **options)
    places = sheet.findings[f"mean_pressure where inverse reaches {level:g}"]
    assert places.count == 2 and loads[0] < places.value < loads[-1]
    assert "exponent of inverse against mean_pressure" not in sheet.findings  # of two loads
    x = np.geomspace(1.0, 8.0, 7)
    assert dependence.reached(x, 1 / x, 0.25) == pytest.approx(4.0, rel=1e-12)
    assert dependence.reached(x, x**2, 4.0) == pytest.approx(2.0, rel=1e-12)
    lines = [[(a, -3 * c * a**-1.5) for a in x] for c in (0.9, 1.0, 1.1)]
    dependence._fit(sheet, "law", lines, (1.5, 5.0), (0, "black"))
    assert sheet.findings["law"].value == pytest.approx(-1.5, rel=1e-12)
    assert sheet.findings["law"].seeds == pytest.approx(0, abs=1e-12)
    with pytest.raises(InputError, match="'nothing' is no column"):
        figures.draw("dependence", [runs["seed1"]], of=["nothing"])


def test_a_setting_without_a_number_keeps_the_colours_of_others(runs):
    """Of two settings one has no second moment: the other's curves have one colour in both panels."""
    sheet = figures.draw("dependence", [runs["kept"], runs["soft1"]], of=["mean_gap", "m2"])
    (whole, _), (alone,) = (panel.lines for panel in sheet.panels)
    assert alone.get_color() == whole.get_color() == plotting.style(0)["color"]
    plotting.plt.close(sheet.figure)


def test_a_report_takes_figures_of_which_it_has_no_runs(tmp_path):
    """From the committed folder, with the rows of their runs; a figure that is there stays."""
    plan = [report.Figure("A", "", "area_load", ("a-*",)), report.Figure("B", "", "area_load", ("b-*",))]
    source, output = tmp_path / "committed", tmp_path / "report"
    for folder in (source, output):
        folder.mkdir()
    for name in ("A_area_load.json", "A_area_load_means.csv", "AA_area_load.json", "B_area_load.json"):
        (source / name).write_text("old")
    (source / "runs.csv").write_text("run,grid\na-1,8\nb-1,8\n")
    (output / "B_area_load.json").write_text("new")
    assert report._take(plan, source, output) == {"a-1": {"run": "a-1", "grid": "8"}}
    assert sorted(path.name for path in output.iterdir()) == [
        "A_area_load.json", "A_area_load_means.csv", "B_area_load.json"
    ]  # fmt: skip
    assert (output / "B_area_load.json").read_text() == "new"


def test_a_curve_without_points_has_no_entry_in_the_legend():
    """Nor has one whose points are all NaN."""
    sheet = plotting.Sheet()
    sheet.curve(0, [1.0, 2.0], [np.nan, np.nan], "nowhere")
    sheet.curve(0, [], [], "nothing", error=[])
    sheet.curve(0, [1.0, 2.0], [1.0, np.nan], "there")
    assert sheet.panels[0].get_legend_handles_labels()[1] == ["there"]
    plotting.plt.close(sheet.figure)


def test_lines_of_the_flow_cross_the_row_of_the_constriction(runs):
    """Flow along x crosses each row of the cell, and so do lines along it."""
    sheet = figures.draw("leakage", [runs["following"]])
    pieces = sheet.panels[1].collections[0].get_segments()
    flowing = [load for load in reading.loads([runs["following"]]) if load.number("flow_factor_x") > 0]
    x, _ = leakage.constriction(flowing[-1])
    assert sum(piece[:, 0].min() <= x < piece[:, 0].max() for piece in pieces) > 0
    plotting.plt.close(sheet.figure)
