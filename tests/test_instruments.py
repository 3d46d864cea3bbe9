"""From an instrument's file to an answer: what the file says need not be typed, what is typed is compared."""

import gzip
import logging
import tomllib
import zipfile

import h5py
import numpy as np
import pytest
from conftest import ROOT, saved

import pgfmd
from pgfmd.application import job
from pgfmd.application.cli import main
from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.surfaces.file import FromFile, fill_missing

SDF = ROOT / "jobs" / "data" / "measured.sdf"
REST = "[solid]\ncontact_modulus = 1e9\n[load]\npressure = 1e6\n"


def asked(path, more="", rest=REST):
    """The job on a file of heights that says nothing of points, size and unit but what `more` does."""
    return job.parse(f'[surface]\nkind = "file"\npath = "{path}"\n{more}\n{rest}', folder=str(ROOT))


@pytest.mark.parametrize(("more", "n", "length", "unit"), [
    ("", (128, 96), (12.8, 11.52), "µm"),
    ('first_axis = "y"', (96, 128), (11.52, 12.8), "µm"),
    ('periodic = "mirror"', (256, 192), (25.6, 23.04), "µm"),
    ('[output]\nlength_unit = "nm"', (128, 96), (12800, 11520), "nm"),
    ('[output]\nlength_unit = "length"', (128, 96), (12.8, 11.52), "µm"),
    ("[grid]\nn = [128, 96]", (128, 96), (12.8, 11.52), "µm"),
    ("[grid]\nspacing = [0.1, 0.12]", (128, 96), (12.8, 11.52), "µm"),
])  # fmt: skip
def test_points_size_and_unit_come_from_the_file(more, n, length, unit):
    """What the job leaves out is as in the file, turned, mirrored or converted like the heights; to rounding."""
    pytest.importorskip("SurfaceTopography", reason="tools/setup.sh test")
    found = asked(SDF, more)
    assert found.grid.n == n and found.output.length_unit == unit
    assert found.grid.lengths == pytest.approx(length, rel=1e-14)
    assert job.parse(job.as_toml(found)) == found  # results say all of it, and open no file


def test_what_a_file_does_not_say_keeps_its_default(tmp_path):
    """An array has points only, and perhaps a unit of heights: one that is no length is left to the job."""
    np.save(tmp_path / "a.npy", np.eye(4, 6))
    found = asked(tmp_path / "a.npy")
    assert (found.grid.n, found.grid.spacings, found.output.length_unit) == ((4, 6), (1, 1), "length")
    for unit, expected in (("um", "µm"), ("V", "length"), ("length", "length")):
        with h5py.File(tmp_path / "a.h5", "w") as file:
            file["heights"] = np.eye(4, 6)
            file["heights"].attrs["units"] = unit
        assert asked(tmp_path / "a.h5").output.length_unit == expected


def test_all_that_disagrees_is_named_at_once():
    """Points, size and unit that differ from the file's, each with what to write, in one line."""
    pytest.importorskip("SurfaceTopography", reason="tools/setup.sh test")
    for unit, words in (
        ("m", ("measures 1.28e-05 x 1.152e-05 m, the cell is 1 x 2: write length",)),
        ("K", ('is in µm: write length_unit = "µm" under [output]',)),
    ):
        wrong = asked(SDF, f'[grid]\nn = 128\nlength = [1, 2]\n[output]\nlength_unit = "{unit}"')
        with pytest.raises(InputError) as caught:
            wrong.surface.check_inputs(wrong.grid, unit)
        common = ("holds 128 x 96 points", "write n = [128, 96] under [grid]", "leave out what the file says")
        assert all(each in str(caught.value) for each in (*common, *words))


def test_a_job_in_another_unit_is_not_told_to_relabel_its_lengths():
    """Lengths in metres, and a file in micrometres: the unit of the job is what is missing."""
    pytest.importorskip("SurfaceTopography", reason="tools/setup.sh test")
    wrong = asked(SDF, "[grid]\nlength = [12.8e-6, 11.52e-6]")
    with pytest.raises(InputError, match=r'or length_unit = "m" under \[output\], if the lengths of the job are in it'):
        wrong.surface.check_inputs(wrong.grid, wrong.output.length_unit)
    asked(SDF, '[grid]\nlength = [12.8e-6, 11.52e-6]\n[output]\nlength_unit = "m"')


@pytest.mark.mpi
@pytest.mark.parametrize("suffix", ["gz", "zip"])
@pytest.mark.parametrize("inner", ["a.npy", "a.h5", "a.txt"])
def test_packed_files(comm, shared_tmp_path, suffix, inner):
    """A .gz or .zip of a readable file is that file, bit for bit, on any number of ranks."""
    heights = np.random.default_rng(1).normal(size=(8, 6))

    def write(path):
        if inner == "a.npy":
            np.save(path, heights)
        elif inner == "a.txt":
            np.savetxt(path, heights)
        else:
            with h5py.File(path, "w") as file:
                file["other"], file["x/y"] = np.eye(3), heights
        if suffix == "gz":
            with gzip.open(f"{path}.gz", "wb") as packed:
                packed.write(path.read_bytes())
        else:
            with zipfile.ZipFile(f"{path}.zip", "w") as packed:
                packed.write(path, "folder/" + inner)
        path.unlink()

    path = saved(comm, shared_tmp_path / inner, write)
    name = f"{path}.{suffix}" + ":x/y" * (inner == "a.h5")
    grid = SlabGrid(comm, (8, 6))
    found = FromFile(path=name, detrend="none").heights(grid, None)
    assert np.array_equal(grid.fetch(found, 0, 8), heights)


@pytest.mark.mpi
def test_archives_of_several_files(comm, shared_tmp_path):
    """One of them is named after a colon; without a name, and for a damaged archive, one line says what to do."""

    def write(path):
        with zipfile.ZipFile(path, "w") as packed:
            for name, factor in (("a.txt", 1), ("b/c.txt", 2)):
                packed.writestr(name, "\n".join(" ".join(map(str, row)) for row in factor * np.eye(4)))

    path, grid = saved(comm, shared_tmp_path / "a.zip", write), SlabGrid(comm, (4, 4))
    found = FromFile(path=f"{path}:b/c.txt").heights(grid, None)
    assert np.array_equal(grid.fetch(found, 0, 4), 2 * np.eye(4))
    with pytest.raises(InputError, match=r"say which of its files .*found: a\.txt, b/c\.txt"):
        FromFile(path=str(path)).heights(grid, None)
    for name in ("cut.zip", "cut.npy.gz"):
        cut = saved(comm, shared_tmp_path / name, lambda path: path.write_bytes(b"PK\3\4 no archive"))
        with pytest.raises(InputError, match=f"{name}: cannot be unpacked"):
            FromFile(path=str(cut)).heights(grid, None)


@pytest.mark.mpi
def test_holes_are_counted_in_the_log(comm, shared_tmp_path, caplog, monkeypatch):
    """It says how many points of the file, without images, were filled; over a hundredth of them is a warning."""
    monkeypatch.setattr(logging.getLogger("pgfmd"), "propagate", True)
    caplog.set_level(logging.INFO, "pgfmd")
    for holes, level in ((1, logging.INFO), (5, logging.WARNING)):
        heights = np.random.default_rng(1).normal(size=(16, 16))
        heights.flat[2 : 2 + holes] = np.nan
        path = saved(comm, shared_tmp_path / f"{holes}.npy", lambda path, values=heights: np.save(path, values))
        FromFile(path=str(path), periodic="mirror").heights(SlabGrid(comm, (32, 32)), None)
        said = [record for record in caplog.records if f"{holes} of 256 points" in record.getMessage()]
        assert [record.levelno for record in said] == [level] * (comm.rank == 0)


def topography(heights, **options):
    """Of the package SurfaceTopography."""
    package = pytest.importorskip("SurfaceTopography", reason="tools/setup.sh test")
    return package.Topography(heights, (6.4, 3.2), unit="nm", **options)


@pytest.mark.mpi
def test_a_topography_is_solved_as_its_heights(comm, caplog, monkeypatch):
    """Its spacing is taken, undefined points are filled as those of a file, edges that do not match are warned of
    unless it is periodic; another spacing or too many holes are refused.  Bit for bit, on any number of ranks."""
    monkeypatch.setattr(logging.getLogger("pgfmd"), "propagate", True)
    x = np.arange(32) / 32
    heights = np.cos(2 * np.pi * x)[:, None] * np.cos(2 * np.pi * x[:16] * 2) + 2 * x[:, None]
    rows = SlabGrid(comm, heights.shape).rows
    contact = pgfmd.solve(topography(heights), 0.1, comm=comm)
    expected = pgfmd.solve(heights[rows], 0.1, spacing=0.2, comm=comm)
    assert np.array_equal(contact.pressure, expected.pressure)
    assert pgfmd.certify(topography(heights), expected.pressure, comm=comm).certified_error < 1e-7
    assert caplog.text.count("opposite edges differ across x") == 2 * (comm.rank == 0)
    pgfmd.solve(topography(heights, periodic=True), 0.1, comm=comm)
    assert caplog.text.count("opposite edges differ") == 2 * (comm.rank == 0)
    holes = np.ma.array(heights, mask=np.abs(heights - 1) < 0.02)
    grid, filled = SlabGrid(comm, heights.shape), holes.filled(np.nan)[rows]
    fill_missing(grid, filled)
    contact, expected = pgfmd.solve(topography(holes), 0.1, comm=comm), pgfmd.solve(filled, 0.1, spacing=0.2, comm=comm)
    assert np.array_equal(contact.pressure, expected.pressure)
    for wrong, options, words in (
        (topography(heights), {"spacing": 1.0}, "the topography's is 0.2, 0.2; leave it out"),
        (topography(np.ma.masked_less(heights, 2)), {}, "too many to fill them unasked"),
    ):
        with pytest.raises(InputError, match=words):
            pgfmd.solve(wrong, 0.1, comm=comm, **options)


def test_a_new_job_on_a_file(tmp_path, monkeypatch, capsys):
    """`pgfmd new --heights` prints a job that runs as it is; missing points and edges that do not match are treated."""
    monkeypatch.chdir(tmp_path)
    heights = np.random.default_rng(1).normal(size=(32, 12))
    for name, values, keys in (
        ("noise.npy", heights, {"detrend"}),
        ("cubic.npy", np.linspace(-1, 1, 32)[:, None] ** 3 + 0 * heights, {"detrend", "boundary"}),
        ("holes.npy", np.where(heights > 0, heights, np.nan), {"detrend", "missing"}),
    ):
        np.save(name, values)
        assert main(["new", "--heights", name]) == 0
        text = capsys.readouterr().out
        assert tomllib.loads(text)["surface"].keys() - {"kind", "path"} == keys - {"boundary"}
        assert tomllib.loads(text).get("grid", {}).get("boundary") == ("open" if "boundary" in keys else None)
        (tmp_path / "job.toml").write_text(text)
        found = job.load(tmp_path / "job.toml")
        assert found.grid.n == (32, 12)
    assert pgfmd.run(tmp_path / "job.toml")[0].numbers["contact_area"] == pytest.approx(0.05, abs=0.01)
    assert main(["new", "--heights", "none.npy"]) == 2


@pytest.mark.breadth
def test_a_folder_of_instruments_files(tmp_path, capsys):
    """Each file that SurfaceTopography reads is solved from path, modulus and load, also packed, with the package's
    heights, size and unit, which the export and the page of figures keep; other files do not count."""
    pytest.importorskip("SurfaceTopography", reason="tools/setup.sh test")
    import instrument_files

    (tmp_path / "a.sdf").write_bytes(SDF.read_bytes())
    waves = np.cos(np.arange(8) / 2)[:, None] * np.cos(np.arange(6))
    rows = "\n".join(" ".join(f"{value:.6e}" for value in row) for row in waves)
    text = f"# Channel: a\n# Width: 3 nm\n# Height: 4 nm\n# Value units: nm\n{rows}\n"
    with gzip.open(tmp_path / "b.txt.gz", "wt") as packed:
        packed.write(text)
    (tmp_path / "c.txt").write_text("no heights")
    assert instrument_files.main([str(tmp_path), "--pictures"]) == 0
    said = capsys.readouterr().out
    assert "2 two-dimensional files, 2 solved, 0 after a remedy" in said
    assert "| b.txt.gz | 6 x 8 | 3 x 4 nm |" in said
