"""Columns that observables add to the table of loads: in files, tables, ensembles, after a restart, and in Python.

The spectrum of the gap: its sum rule, its modes, its place in the job and in the files.
"""

import math
from dataclasses import dataclass

import h5py
import numpy as np
import pytest
from contacts import solution_of, under_hard_wall
from job_texts import rough_job

import pgfmd
from pgfmd.application import job
from pgfmd.application.files import Form
from pgfmd.application.info import as_csv, summary
from pgfmd.application.machine import Origin
from pgfmd.application.results import Results
from pgfmd.application.writer import ResultWriter
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.contact import Contact
from pgfmd.observables.observable import Observable, layout_of
from pgfmd.observables.observable_kinds import OBSERVABLES
from pgfmd.observables.rough_surface import RoughSurface
from pgfmd.observables.schema import LOADS, Dataset

pytestmark = pytest.mark.mpi


@dataclass(frozen=True, kw_only=True)
class Peak(Observable):
    """The largest pressure, known on rank 0 only, with an error, and a curve."""

    name = "peak"
    layout = {
        "loads": {"peak": Dataset("{pressure}", "largest pressure"), "peak_error": Dataset("{pressure}", "its error")},
        "sorted": {"pressure": Dataset("{pressure}", "pressures in order", ("pressure",))},
    }

    def measure(self, contact):
        peak = contact.grid.reduction.max(contact.pressure)
        mine = {"peak": np.array(peak), "peak_error": np.array(peak / 10)} if contact.grid.comm.rank == 0 else {}
        return {"loads": mine, "sorted": {"pressure": np.array([0.0, peak])}}


def contact_of(comm, pressure, gap, kind, lengths=None):
    """The groups that an observable measures on whole fields, which are cut into slabs."""
    grid = SlabGrid(comm, gap.shape, lengths)
    local, opening = (field[grid.rows].copy() for field in (pressure, gap))
    surface = RoughSurface(under_hard_wall(grid, np.zeros_like(opening)), [kind])
    return Contact.of(surface, solution_of(local, opening)).measure()


def test_numbers_are_on_all_ranks(comm):
    """An observable, of any file, gives numbers on rank 0; all ranks receive them beside its datasets."""
    pressure = np.arange(48.0).reshape(8, 6)
    found = contact_of(comm, pressure, np.zeros((8, 6)), Peak())
    assert found["loads"] == {"peak": 47.0, "peak_error": 4.7} and list(found) == ["sorted", "loads"]


def test_columns_with_errors_in_files_and_tables(comm, shared_tmp_path):
    """Columns follow those of every run, with unit and description, their error beside the value, NaN where missing."""
    text = rough_job(16, {"lambda_s": 4.0}, load={"pressure": [0.01, 0.02]})
    origin = Origin(text, job.as_toml(job.parse(text)), 2)
    rows = SlabGrid(comm, (16, 16)).rows
    form = Form((16, 16), (16.0, 16.0), rows, groups=layout_of([Peak]), pressure_unit="GPa")
    with ResultWriter(comm, shared_tmp_path / "out", origin, form) as writer:
        writer.write_load(0, {"mean_pressure": 1.0, "peak": 2.5, "peak_error": 0.125}, {"sorted": {"pressure": [1.0]}})
        writer.write_load(1, {"mean_pressure": 2.0})
        with pytest.raises(ValueError, match="valley"):
            writer.write_load(1, {"valley": 2.0})
    results = Results(shared_tmp_path / "out")
    assert list(results.loads) == [*LOADS, "peak", "peak_error"]
    assert results.columns["peak"] == Dataset("GPa", "largest pressure")
    assert results[0].numbers["peak"] == 2.5 and math.isnan(results[1].numbers["peak"])
    assert list(results[0]) == ["sorted"]
    assert "2.5 ± 0.1" in summary(results) and "peak_error" not in summary(results)
    assert as_csv(results).splitlines()[1].endswith("2.5,0.125")
    assert results.to_dataframe()["peak_error"].tolist()[0] == 0.125


def test_no_column_has_two_meanings():
    """Names of columns are those of one observable, or of the table that every run has."""
    names = [name for kind in OBSERVABLES.values() for name in kind.layout.get("loads", {})]
    assert len(set(names)) == len(names) and not set(names) & LOADS.keys()


def test_gap_slope(comm):
    """gap_slope: √Σ q²|g̃|² by NumPy's FFT of the whole gap, on a stretched cell; rounding of N terms."""
    gap, lengths = np.random.default_rng(3).exponential(size=(15, 22)), (30.0, 7.0)
    qx, qy = (2 * np.pi * np.fft.fftfreq(n, length / n) for n, length in zip(gap.shape, lengths, strict=True))
    power = np.abs(np.fft.fft2(gap, norm="forward")) ** 2
    exact = np.sqrt(np.sum((qx[:, None] ** 2 + qy**2) * power))
    found = contact_of(comm, 1.0 * (gap == 0), gap, OBSERVABLES["gap_slope"](), lengths)
    assert found["loads"]["gap_rms_slope"] == pytest.approx(exact, rel=1e-12, abs=0)


def test_pressure_skewness(comm):
    """Of contact pressures a < b with shares 1 − s and s: (1 − 2s)/√(s(1 − s)); NaN of equal pressures or none."""
    pressure = np.zeros((8, 10))
    pressure[1:5, ::2], pressure[2, 4] = 1e-9, 3.0  # 20 points in contact, one of them at 3
    kind, share = OBSERVABLES["pressure_skewness"](), 1 / 20
    found = contact_of(comm, pressure, 1.0 * (pressure == 0), kind)["loads"]["pressure_skewness"]
    assert found == pytest.approx((1 - 2 * share) / math.sqrt(share * (1 - share)), rel=1e-12, abs=0)
    for even in (0.1 * (pressure > 0), np.zeros_like(pressure)):
        assert np.isnan(contact_of(comm, even, 1.0 * (even == 0), kind)["loads"]["pressure_skewness"])


JOB = {
    "grid": {"n": 24},
    "surface": {"kind": "self-affine", "hurst": 0.8, "lambda_s": 6.0, "rms_slope": 0.1, "seed": 3},
    "solid": {"contact_modulus": 1.0},
    "load": {"pressure": [0.004]},
    "output": {"fields": ["height", "pressure", "gap"], "observables": ["gap_slope", "pressure_skewness"]},
}


def test_columns_of_a_run(comm, shared_tmp_path):
    """Each load has its own numbers, those of a continued run too; `solve` of the same contact gives them."""
    pgfmd.run(JOB, shared_tmp_path / "out", comm=comm)
    longer = JOB | {"load": {"pressure": [0.004, 0.02]}}
    results = pgfmd.run(longer, shared_tmp_path / "out", comm=comm, restart=True)
    for load in results:
        pressure = load.field("pressure")
        inside = pressure[pressure > 0] - pressure[pressure > 0].mean()
        skewness = np.mean(inside**3) / np.mean(inside**2) ** 1.5
        assert load.numbers["pressure_skewness"] == pytest.approx(skewness, rel=1e-9, abs=0)
    light, heavy = results.loads["gap_rms_slope"]
    assert 0.1 > light > heavy > 0  # the surface's slope without contact, 0 in full contact
    heights = results.field("height")[SlabGrid(comm, (24, 24)).rows].copy()
    contact = pgfmd.solve(heights, 0.02, comm=comm)
    found = contact.observables("gap_slope", "pressure_skewness")["loads"]
    assert found["gap_rms_slope"] == pytest.approx(heavy, rel=1e-3, abs=0)
    assert found["pressure_skewness"] == pytest.approx(results.loads["pressure_skewness"][1], rel=1e-2, abs=0)


def test_columns_of_an_ensemble(comm, shared_tmp_path):
    """Mean and standard error over the seeds, with their number, in data frame and file.  A mean over fewer seeds than
    have solved the load says over how many, in the text and in the data frame."""
    light = {"pressure": [3e-5, 0.02]}  # some seeds touch in one pixel: no skewness
    job = JOB | {"surface": JOB["surface"] | {"seed": "1..6"}, "load": light}
    ensemble = pgfmd.run(job, shared_tmp_path / "out", comm=comm)
    finite = [int(sum(np.isfinite(run.loads["pressure_skewness"][load]) for run in ensemble.runs)) for load in (0, 1)]
    assert 0 < finite[0] < 6 == finite[1]
    frame = ensemble.mean()
    assert frame["pressure_skewness_seeds"].tolist() == finite and "contact_area_seeds" not in frame
    values = np.array([run.loads["gap_rms_slope"] for run in ensemble.runs])
    np.testing.assert_allclose(frame["gap_rms_slope"], values.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(frame["gap_rms_slope_error"], values.std(axis=0, ddof=1) / math.sqrt(6), rtol=1e-9)
    assert frame["seeds"].tolist() == [6, 6]
    with h5py.File(shared_tmp_path / "out" / "ensemble.h5") as file:
        assert list(file["loads/gap_rms_slope"]) == list(frame["gap_rms_slope"])
        assert file["loads/gap_rms_slope"].attrs["units"] == "1"
    first, second = repr(ensemble).splitlines()[-2:]
    assert first.count(f"({finite[0]})") == 1 and "(" not in second


def measure_gap(comm, gap, **options):
    """The spectrum of a whole gap (nx, ny), on every rank, on a surface that has modes up to 1.5."""
    grid = SlabGrid(comm, gap.shape)
    local = gap[grid.rows].copy()
    problem = under_hard_wall(grid, local)
    surface = RoughSurface(problem, [OBSERVABLES["gap_spectrum"](**options)], 1.5)
    return Contact.of(surface, solution_of(local, local)).measure()["gap_spectrum"]


@pytest.mark.uneven
@pytest.mark.parametrize("spacing", ["log", "linear"])
@pytest.mark.parametrize("shape", [(24, 24), (15, 22), (4, 9)])
def test_sum_rule(comm, shape, spacing):
    """Σ_{q≠0} |g̃|² = ⟨g²⟩ − ⟨g⟩², exactly, whatever the bins: rounding over N terms."""
    gap = np.random.default_rng(5).exponential(size=shape)
    found = measure_gap(comm, gap, spacing=spacing, all_modes=True)
    assert found["count"].sum() == gap.size - 1
    assert np.sum(found["count"] * found["value"]) == pytest.approx(gap.var(), rel=1e-12, abs=0)


@pytest.mark.uneven
def test_one_wave(comm):
    """A wave of amplitude A has |g̃|² = A²/4 in its two modes, none elsewhere; bins end at the surface's cut-off."""
    x = np.arange(24)[:, None] * np.ones((1, 24))
    found = measure_gap(comm, 3 + 0.8 * np.cos(2 * np.pi * 5 * x / 24), bins=100)
    place = np.argmin(abs(found["q"] - 2 * np.pi * 5 / 24))
    assert found["value"][place] * found["count"][place] == pytest.approx(2 * 0.8**2 / 4, rel=1e-12, abs=0)
    assert np.delete(found["value"], place) == pytest.approx(0, abs=1e-28)
    assert found["edges"][-1] == pytest.approx(1.5, rel=1e-8, abs=0)
