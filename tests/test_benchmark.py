"""tools/bench/benchmark.py measures what it says, on problems of a second; jobs/acceptance.sh writes its page."""

import csv
import json
import math
import os
import shutil
import subprocess
import sys
from types import SimpleNamespace

import acceptance
import numpy as np
import pytest
from benchmarks import ratios, total_error, worker
from benchmarks import recorder as recording
from benchmarks.case import Case
from benchmarks.cores import PLAN as CORES
from benchmarks.recorder import EnoughError, Recorder
from conftest import ROOT, starts_mpirun


@pytest.fixture
def now(monkeypatch) -> list[float]:
    """The time of a clock that is set by hand, in place of those of `Recorder`."""
    now = [1000.0]
    clock = SimpleNamespace(perf_counter=lambda: now[0], process_time=lambda: now[0])
    monkeypatch.setattr(recording, "time", clock)
    return now


def test_the_clock_stands_still_while_errors_are_measured(now):
    """A note costs its run nothing, though its certificate takes 5 s."""

    def certify(_):
        now[0] += 5
        return 0.0, 0.0

    recorder = Recorder(np.ones((4, 4)), certify=certify)
    recorder.start()
    for error in (1e-4, 1e-7):
        recorder.note(np.full((4, 4), 1 + error), 0)
    assert [point["cpu"] for point in recorder.points] == [point["seconds"] for point in recorder.points] == [0, 0]


def test_errors_are_relative_two_norms_and_relative_areas():
    """‖s p − p*‖/‖p*‖ with the scale s, and |A − A*|/A*, by NumPy."""
    rng = np.random.default_rng(0)
    reference = np.maximum(rng.standard_normal((600, 7)), 0)
    pressure = -2 * np.maximum(reference - 0.1, 0)
    recorder = Recorder(reference)
    recorder.start()
    recorder.note(pressure, 3, scale=-0.5)
    (point,) = recorder.points
    expected = np.linalg.norm(-0.5 * pressure - reference) / np.linalg.norm(reference)
    assert point["pressure_error"] == pytest.approx(expected, rel=1e-12, abs=0)
    area, right = np.sum(pressure < 0), np.sum(reference > 0)
    assert point["area_error"] == pytest.approx(1 - area / right, rel=1e-12, abs=0)


@pytest.mark.parametrize("area", [0.01, 0.2, 0.7, 0.99])
def test_the_load_of_a_count_is_where_check_expects_that_area(area):
    """The inverse of what `pgfmd check` takes as the contact area of a mean pressure."""
    from benchmarks.counts import RMS_SLOPE, pressure_of

    from pgfmd.application.estimate import Plan
    from pgfmd.application.job import parse, tables_as_toml

    surface = {"kind": "self-affine", "hurst": 0.8, "lambda_s": 8.0, "rms_slope": RMS_SLOPE}
    tables = {"grid": {"n": 64}, "surface": surface, "solid": {"contact_modulus": 1.0}}
    job = parse(tables_as_toml(tables | {"load": {"pressure": pressure_of(area)}}))
    assert Plan(job).contact_areas() == pytest.approx([area], rel=1e-9)


def test_pressures_are_certified_where_they_pass_a_level():
    """Once for each of the levels 1e-3, 1e-4, 1e-6 of the pressure error that a point is the first to reach, scaled."""
    seen, reference = [], np.ones((2, 2))
    recorder = Recorder(reference, certify=lambda pressure: (seen.append(pressure) or len(seen), 0.5))
    recorder.start()
    for error in (1e-1, 5e-4, 2e-4, 1e-7):
        recorder.note(-2 * (reference + error), 0, scale=-0.5)
    expected = [np.nan, 1, np.nan, 2]
    np.testing.assert_array_equal([point["certified_error"] for point in recorder.points], expected)
    np.testing.assert_allclose(seen[0], 1 + 5e-4, rtol=1e-12)


def test_the_certified_error_of_a_peer_bounds_the_true_one():
    """In any unit the true error of a solution to 1e-4 (against 1e-18) is between half the bound and the bound."""
    pytest.importorskip("mpi4py")
    from benchmarks.case import CONTACT_MODULUS

    import pgfmd

    surface = {"kind": "self-affine", "hurst": 0.8, "lambda_s": 8.0, "rms_slope": 0.1}
    heights = pgfmd.surface({"grid": {"n": 64}, "surface": surface})
    rough, exact = (
        pgfmd.solve(heights, 0.02, contact_modulus=CONTACT_MODULUS, tolerance=tolerance) for tolerance in (1e-4, 1e-18)
    )
    for unit in (1.0, 1e6):
        bound, true = worker.certified(heights, exact.pressure, unit * rough.pressure)
        assert 0.5 * bound < true <= bound <= 1e-4


def test_what_follows_the_last_note_is_charged_to_every_point(now):
    """A run that ends 50 ms after its last note is 50 ms longer, wherever it would have stopped."""
    recorder = Recorder(np.ones((2, 2)))
    recorder.start()
    recorder.note(np.ones((2, 2)), 1)
    now[0] += 0.05
    recorder.add_tail()
    assert recorder.points[0]["seconds"] == pytest.approx(0.05)


def test_a_run_ends_once_it_is_accurate_enough():
    """At the floor of the error, EnoughError."""
    recorder = Recorder(np.ones((2, 2)), floor=1e-3)
    recorder.start()
    recorder.note(np.full((2, 2), 1.1), 1, may_stop=True)
    with pytest.raises(EnoughError):
        recorder.note(np.full((2, 2), 1.0001), 2, may_stop=True)
    assert not recorder.truncated


def test_cost_interpolates_for_those_who_could_stop_anywhere():
    """Between (1 s, 1e-2) and (3 s, 1e-4), 1e-3 is reached after 2 s; without interpolation after 3 s; 1e-5 never."""
    points = [{"seconds": 1.0, "pressure_error": 1e-2}, {"seconds": 3.0, "pressure_error": 1e-4}]
    assert ratios.cost(points, 1e-3) == pytest.approx(2.0)
    assert ratios.cost(points, 1e-3, between=False) == 3.0
    assert ratios.cost(points, 1e-5) == np.inf


def test_peers_areas_lose_the_pixels_that_edges_count_too_much():
    """A square patch of m² pixels has 4 m edges, some of them across the border of the cell: m² − 4 m (π−1+ln 2)/24."""
    n, m = 32, 9
    pressure = np.zeros((n, n))
    pressure[:m, 5 : 5 + m] = 0.3
    recorder = total_error.AreaRecorder(0.07, 1.0)
    recorder.start()
    recorder.note(pressure, 0)
    right = (m * m - 4 * m * (np.pi - 1 + np.log(2)) / 24) / n**2
    assert recorder.points[0]["error"] == pytest.approx(right / 0.07 - 1, rel=1e-12, abs=0)


def test_an_area_counts_once_it_stays_within_the_error():
    """Errors .1, .001, .1, .002, .001: the fourth is the first of two that stay; three that stay there are not."""
    recorder = total_error.AreaRecorder(1.0, 1.0)
    recorder.start()
    for number, error in enumerate((0.1, 0.001, 0.1, 0.002, 0.001)):
        recorder.note_area(1 + error, recorder._began + number, recorder._began_cpu)
    assert recorder.reached(2)["error"] == pytest.approx(0.002, rel=1e-9, abs=0)
    assert recorder.reached(3) is None


def test_a_method_has_the_quickest_grid_on_which_every_surface_gets_there(tmp_path, capsys):
    """Three of four surfaces at 8 points do not count; 16 points in 4 s do, not 32 in 9 s; ours in 1 s: ratio 4."""
    rows = [("peer", 8, 2.0, 3), ("peer", 16, 4.0, 4), ("peer", 32, 9.0, 4), ("pgfmd", 4, 1.0, 4), ("slow", 8, 1.0, 2)]
    lines = [",".join(total_error.COLUMNS)]
    for method, points, seconds, reached in rows:
        for seed in total_error.SEEDS:
            lines.append(f"0.8,64,{method},,{points},{seed},{seconds},{seconds},0.002,{int(seed <= reached)}")
    (tmp_path / "total.csv").write_text("\n".join(lines) + "\n")
    total_error._print(tmp_path / "total.csv", (0.8, 64), "cpu")
    table = {line.split()[0]: line.split()[1:] for line in capsys.readouterr().out.splitlines()[3:]}
    assert table["peer"] == ["16", "0.20%", "4.000", "4.0"]
    assert table["slow"] == ["on", "no", "grid"]


def test_total_errors_are_against_the_limit_of_the_areas_of_finer_grids(tmp_path, monkeypatch):
    """The raw area of each surface on its grids is A (1 + 1/points): runs on that surface are compared with A."""
    from benchmarks.total_error import AREA, SEEDS, total

    def solved(case, points):
        area = AREA * case.seed
        return {"contact_area": area * (1 + 1 / points), "contact_area_corrected": area}

    jobs = []
    monkeypatch.setattr(total_error.error_bars, "solved", solved)
    monkeypatch.setattr(total_error, "_row", lambda path, job: jobs.append(job) or {"reached": 1, "cpu": 1.0})
    total(tmp_path, (0.8, 64), [("pgfmd", {})], 1.0, "cpu")
    assert [job["limit"] for job in jobs[:4]] == pytest.approx([AREA * seed for seed in SEEDS], rel=1e-9, abs=0)


def test_names_of_cases_differ():
    """Every number of a case is in its name, which names its files."""
    numbers = [(64, 0.8, 4, 0.1), (32, 0.8, 4, 0.1), (64, 0.3, 4, 0.1), (64, 0.8, 1, 0.1), (64, 0.8, 4, 0.9)]
    assert len({Case(*values).name for values in numbers}) == len(numbers)


@pytest.mark.breadth
def test_a_small_benchmark_from_end_to_end(tmp_path):
    """Ours and plain Polonsky–Keer reach the reference to 1e-6; a second call measures nothing again."""
    if os.environ.get("OMPI_COMM_WORLD_SIZE") or shutil.which("mpirun") is None:
        pytest.skip("starts processes of its own")
    command = [sys.executable, str(ROOT / "tools" / "bench" / "benchmark.py"), "run", str(tmp_path), "--n", "64"]
    command += ["--lambda-s", "8", "--repeat", "1", "--threads", "1"]
    command += ["--methods", "pgfmd", "pgfmd steps", "Polonsky-Keer"]
    for _ in range(2):
        done = subprocess.run(command, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
    rows = list(csv.DictReader(open(tmp_path / "runs.csv", newline="")))
    keys = [(row["method"], row["tolerance"], row["point"]) for row in rows]
    assert len(keys) == len(set(keys))
    for method in ("pgfmd", "pgfmd steps", "Polonsky-Keer"):
        assert min(float(row["pressure_error"]) for row in rows if row["method"] == method) < 1e-6
    assert (tmp_path / "ratios.csv").exists() and list(tmp_path.glob("*.png"))
    assert not list(tmp_path.glob("*.npy"))


@pytest.mark.breadth
def test_cores_are_compared_in_turns(tmp_path):
    """Each way once a round, two relaxations each; a second call adds rounds; gains are over one thread's."""
    if os.environ.get("OMPI_COMM_WORLD_SIZE") or shutil.which("mpirun") is None:
        pytest.skip("starts processes of its own")
    command = [sys.executable, str(ROOT / "tools" / "bench" / "benchmark.py"), "cores", str(tmp_path), "--n", "64"]
    command += ["--lambda-s", "8", "--repeat", "1"]
    for rounds in (1, 2):
        environment = dict(os.environ)  # without what MPI adds for this process behind it
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=environment)
        assert done.returncode == 0, done.stderr
        rows = list(csv.DictReader(open(tmp_path / "cores.csv", newline="")))
        assert [row["cores"] for row in rows] == [kind for _ in range(rounds) for kind in CORES for _ in range(2)]
        assert [int(row["round"]) for row in rows] == [number for number in range(rounds) for _ in range(8)]
    best = {kind: min(float(row["seconds"]) for row in rows if row["cores"] == kind) for kind in CORES}
    table = {line[:12].strip(): line.split() for line in done.stdout.splitlines()[-4:]}
    for kind, (_, _, copies) in CORES.items():
        assert float(table[kind][4]) == pytest.approx(copies * best["one thread"] / best[kind], abs=0.006)


@starts_mpirun
@pytest.mark.breadth
def test_acceptance_writes_its_page(tmp_path):
    """On one and two ranks all is right, and the page has a row for each, with its seconds and messages."""
    environment = os.environ | {"FOLDER": str(tmp_path), "N": "128", "PYTHON": sys.executable}
    command = ["bash", str(ROOT / "jobs" / "acceptance.sh"), "2"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "acceptance.md").read_text()
    assert "**All is right on 1, 2 ranks.**" in page
    for ranks in (1, 2):
        assert f"| {ranks} | {ranks} |" in page and f"| 128 | {ranks} | 1 |" in page


@pytest.mark.parametrize("name", acceptance.ALLOWED)
@pytest.mark.parametrize("value", [1.0, math.nan])
def test_acceptance_says_what_is_wrong(tmp_path, capsys, name, value):
    """An error that is too large, or is no number, stands in the first line, and the exit code is 1."""
    line = {"ranks": 4, "errors": dict.fromkeys(acceptance.ALLOWED, 0.0) | {name: value}, "nodes": [4], "machine": {}}
    (tmp_path / "checks.jsonl").write_text(json.dumps(line) + "\n")
    assert acceptance.main(["report", str(tmp_path)]) == 1
    assert f"**WRONG: 4 ranks: {name} " in (tmp_path / "acceptance.md").read_text()


def test_acceptance_says_which_ranks_failed(tmp_path):
    """Runs that ended with an error, or not at all, stand in the first line, also where no other has ended."""
    assert acceptance.main(["report", str(tmp_path), "--failed", "8", "16"]) == 1
    text = (tmp_path / "acceptance.md").read_text()
    assert (
        "**WRONG: 8 ranks: ended with an error, or did not end; 16 ranks: ended" in text and "no run has ended" in text
    )
