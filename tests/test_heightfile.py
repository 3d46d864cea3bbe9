"""Heights from files: what is read, how it is made periodic, and instruments' formats with their size and unit."""

import hashlib
import logging
import re
import sys
from functools import partial

import h5py
import numpy as np
import pytest
from conftest import ROOT, SIZE, python, saved, whole
from job_texts import SOLID
from mpi4py import MPI

import pgfmd
from pgfmd.application import job
from pgfmd.application.simulate import simulate
from pgfmd.errors import InputError
from pgfmd.grid.cell import Cell
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.surfaces import measurement
from pgfmd.surfaces.file import FromFile, digest, fill_missing
from pgfmd.surfaces.sinusoid import Sinusoid

pytestmark = [pytest.mark.mpi, pytest.mark.uneven]

SHAPE = (11, 24)
SDF, NPY = ROOT / "jobs" / "data" / "measured.sdf", ROOT / "jobs" / "data" / "measured.npy"
SDF_SHAPE, SDF_LENGTHS = (128, 96), (12.8e-6, 11.52e-6)


def read_heights(grid, path, length_unit=None, **options):
    return FromFile(path=str(path), **options).heights(grid, length_unit)


@pytest.fixture
def tilted():
    """A rough array on a steep plane."""
    x, y = np.ogrid[: SHAPE[0], : SHAPE[1]]
    return np.random.default_rng(5).normal(size=SHAPE) + 3.0 * x - 7.0 * y + 100


def without_plane(heights):
    """By a general least-squares solver."""
    x, y = np.indices(heights.shape).reshape(2, -1)
    columns = np.stack([np.ones_like(x), x, y], axis=1).astype(float)
    return heights - (columns @ np.linalg.lstsq(columns, heights.ravel(), rcond=None)[0]).reshape(heights.shape)


def four_images(heights):
    return np.block([[heights, heights[:, ::-1]], [heights[::-1], heights[::-1, ::-1]]])


@pytest.mark.parametrize("periodic", ["as-is", "mirror"])
def test_plane(comm, shared_tmp_path, tilted, periodic):
    """The plane is that of the measurement, also where its images follow; to rounding of heights up to 300."""
    path = saved(comm, shared_tmp_path / "a.npy", lambda path: np.save(path, tilted))
    expected = without_plane(tilted) if periodic == "as-is" else four_images(without_plane(tilted))
    grid = SlabGrid(comm, expected.shape)
    found = whole(grid, read_heights(grid, path, detrend="plane", height_scale=-2.0, periodic=periodic))
    assert np.allclose(found, -2 * expected, rtol=0, atol=1e-11)


def test_taper(comm, shared_tmp_path, tilted):
    """The inner four fifths are the measured heights; at the edges nothing is left but their mean."""
    path = saved(comm, shared_tmp_path / "a.npy", lambda path: np.save(path, np.kron(tilted, np.ones((8, 8)))))
    grid = SlabGrid(comm, (88, 192))
    before = whole(grid, read_heights(grid, path, detrend="plane"))
    after = whole(grid, read_heights(grid, path, detrend="plane", periodic="taper"))
    inner = (slice(9, 79), slice(20, 172))
    assert np.allclose(after[inner], before[inner], rtol=0, atol=1e-13 * np.abs(before).max())
    edge = np.concatenate([after[0], after[-1], after[:, 0], after[:, -1]])
    # The weight half a spacing from the edge is sin²(π/2 · 10/2n): 0.8 % and 0.2 %.
    assert np.abs(edge - before.mean()).max() < 0.01 * np.abs(before).max()
    assert (np.abs(after) <= np.abs(before) + 1e-12).all()


def test_mirror_images_need_twice_the_points(comm, shared_tmp_path, tilted):
    """Odd grids cannot be halved, by a job neither; what the file holds is said."""
    path = saved(comm, shared_tmp_path / "a.npy", lambda path: np.save(path, tilted))
    with pytest.raises(InputError, match="11 x 24 points cannot be halved"):
        read_heights(SlabGrid(comm, SHAPE), path, periodic="mirror")
    with pytest.raises(InputError, match="holds 22 x 48 points, with its mirror images, the grid has 24 x 48"):
        read_heights(SlabGrid(comm, (24, 48)), path, periodic="mirror")


def made(path, heights, **attributes):
    """A file of heights by its suffix; attributes for HDF5."""
    if path.suffix == ".npy":
        np.save(path, heights)
    elif path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            file["other"], file["heights"] = np.ones((3, 3)), heights
            file["heights"].attrs.update(attributes)
    elif path.suffix == ".xyz":
        x, y = np.indices(heights.shape)
        points = np.stack([x, y, heights], axis=2)[~np.isnan(heights)]
        np.savetxt(path, np.random.default_rng(1).permutation(points), delimiter=",")
    else:
        np.savetxt(path, heights)


@pytest.mark.parametrize("suffix", ["npy", "h5", "txt"])
@pytest.mark.parametrize("periodic", ["as-is", "mirror"])
def test_rows_of_every_rank(comm, shared_tmp_path, tilted, suffix, periodic):
    """The ranks together hold the array bit for bit, or it and its three mirror images, from any format: line i is at
    x = i aₓ, in the job's units."""
    path = saved(comm, shared_tmp_path / f"a.{suffix}", lambda path: made(path, tilted))
    expected = tilted if periodic == "as-is" else four_images(tilted)
    grid = SlabGrid(comm, expected.shape, (expected.shape[0], 2.0 * expected.shape[1]))
    assert np.array_equal(whole(grid, read_heights(grid, path, "length", periodic=periodic)), expected)


@pytest.mark.parametrize("periodic", ["as-is", "mirror"])
@pytest.mark.parametrize("suffix", ["npy", "h5", "txt", "xyz"])
def test_first_axis(comm, shared_tmp_path, tilted, suffix, periodic):
    """first_axis = "y" is the transposed array, bit for bit, whatever the format; the other shape is hinted at."""
    path = saved(comm, shared_tmp_path / f"a.{suffix}", lambda path: made(path, tilted))
    expected = tilted.T if periodic == "as-is" else four_images(tilted.T)
    grid = SlabGrid(comm, expected.shape)
    assert np.array_equal(whole(grid, read_heights(grid, path, first_axis="y", periodic=periodic)), expected)
    with pytest.raises(InputError, match=r"write n = \[.*\] under \[grid\] \(or first_axis"):
        read_heights(grid, path, periodic=periodic)


UNITS = [("m", "µm", 1e6), (b"nm", "nm", 1.0), ("micrometers", "m", 1e-6), ("step", "step", 1.0), ("length", "m", 1.0)]


@pytest.mark.parametrize("name", ["units", "unit"])
@pytest.mark.parametrize(("given", "wanted", "factor"), UNITS)
def test_unit_of_a_dataset(comm, shared_tmp_path, tilted, name, given, wanted, factor):
    """The attribute is honoured; "length", which results without a unit say, is none."""
    path = saved(comm, shared_tmp_path / "a.h5", lambda path: made(path, tilted, **{name: given}))
    grid = SlabGrid(comm, SHAPE)
    assert np.array_equal(whole(grid, read_heights(grid, path, wanted)), tilted * factor)


@pytest.mark.parametrize(
    ("given", "wanted", "words"), [("µm", "length", 'write length_unit = "µm"'), ("V", "m", "is in 'V', which is none")]
)
def test_units_that_cannot_be_converted(comm, shared_tmp_path, tilted, given, wanted, words):
    """Never taken as they are."""
    path = saved(comm, shared_tmp_path / "a.h5", lambda path: made(path, tilted, units=given))
    with pytest.raises(InputError, match=words):
        read_heights(SlabGrid(comm, SHAPE), path, wanted)


def test_heights_of_results_come_back(comm, shared_tmp_path):
    """fields.h5 of a run in nanometres, read by a job in metres: the same surface, to rounding of the unit."""
    text = SOLID + "[grid]\nn = 16\nlength = {}\n[surface]\n{}\n[load]\npressure = 1\n[output]\nlength_unit = '{}'\n"
    wave = "kind = 'sinusoid'\namplitude = 3.0"
    simulate(job.parse(text.format(100.0, wave, "nm") + "fields = ['height']"), comm, shared_tmp_path / "out")
    back = f"kind = 'file'\npath = '{shared_tmp_path}/out/fields.h5:height'"
    surface = job.parse(text.format(1e-7, back, "m")).surface
    grid = SlabGrid(comm, (16, 16), (1e-7, 1e-7))
    expected = Sinusoid(amplitude=3e-9).heights(grid)
    assert np.allclose(surface.heights(grid, "m"), expected, rtol=0, atol=1e-14 * 3e-9)


def test_packed_dataset(comm, shared_tmp_path):
    """Integers with scale_factor, add_offset and _FillValue, as netCDF packs them."""
    packed = np.arange(24, dtype=np.int16).reshape(4, 6)
    attributes = {"scale_factor": 0.5, "add_offset": 100.0, "_FillValue": np.int16(7)}
    path = saved(comm, shared_tmp_path / "a.h5", lambda path: made(path, packed, **attributes))
    grid = SlabGrid(comm, (4, 6))
    with pytest.raises(InputError, match=r"\[1, 1\] is nan"):
        read_heights(grid, path, missing="refuse")
    found = whole(grid, read_heights(grid, path))
    assert np.allclose(found, 0.5 * packed + 100, rtol=1e-11, atol=0)


def filled(heights, spacing):
    """NaN replaced by the solution of Laplace's equation with closed edges, by a dense solver."""
    (nx, ny), weights = heights.shape, [1 / step**2 for step in spacing]
    matrix, right = np.zeros((nx * ny, nx * ny)), np.zeros(nx * ny)
    for i in range(nx):
        for j in range(ny):
            row = i * ny + j
            if np.isfinite(heights[i, j]):
                matrix[row, row], right[row] = 1, heights[i, j]
                continue
            for k, m, weight in ((i - 1, j, 0), (i + 1, j, 0), (i, j - 1, 1), (i, j + 1, 1)):
                if 0 <= k < nx and 0 <= m < ny:
                    matrix[row, row] += weights[weight]
                    matrix[row, k * ny + m] -= weights[weight]
    return np.linalg.solve(matrix, right).reshape(nx, ny)


@pytest.mark.parametrize("suffix", ["npy", "h5", "txt", "xyz"])
@pytest.mark.parametrize("seed", range(3))
def test_missing_points(comm, shared_tmp_path, suffix, seed):
    """Points that were not measured, up to half of them, edges included, are filled with what a dense solver of
    Laplace's equation gives, to 1e-10, on any number of ranks, mirrored or turned, before the plane is taken out; by
    default if they are at most a third, on request always or never."""
    chance = np.random.default_rng(seed)
    heights = chance.normal(size=SHAPE)
    gone = chance.random(SHAPE) < (0.02, 0.3, 0.45)[seed]
    gone[0], gone[:, 0], gone[-1, -1] = False, False, False
    heights[gone] = np.nan
    path = saved(comm, shared_tmp_path / f"a.{suffix}", lambda path: made(path, heights))
    spacing = (1.0, 1.0) if suffix == "xyz" else (0.3, 1.7)
    lengths = tuple(count * step for count, step in zip(SHAPE, spacing, strict=True))
    expected = filled(heights, spacing)
    grid = SlabGrid(comm, SHAPE, lengths)
    with pytest.raises(InputError, match=r"is nan; .* missing = \"interpolate\""):
        read_heights(grid, path, missing="refuse")
    if gone.sum() > gone.size / 3:
        with pytest.raises(InputError, match=rf"{gone.sum()} of 264 points .*too many.* missing = \"interpolate\""):
            read_heights(grid, path)
    else:
        assert np.allclose(whole(grid, read_heights(grid, path)), expected, rtol=0, atol=1e-10)
    found = whole(grid, read_heights(grid, path, missing="interpolate"))
    assert np.allclose(found, expected, rtol=0, atol=1e-10)
    assert np.array_equal(found[~gone], heights[~gone])
    twice = SlabGrid(comm, (2 * SHAPE[0], 2 * SHAPE[1]), tuple(2 * length for length in lengths))
    found = whole(twice, read_heights(twice, path, missing="interpolate", periodic="mirror", detrend="plane"))
    assert np.allclose(found, four_images(without_plane(expected)), rtol=0, atol=1e-10)
    turned = SlabGrid(comm, SHAPE[::-1], lengths[::-1])
    found = whole(turned, read_heights(turned, path, missing="interpolate", first_axis="y"))
    assert np.allclose(found, expected.T, rtol=0, atol=1e-10)


@pytest.mark.parametrize("exponent", [-600, 600])
def test_holes_are_filled_in_any_unit(comm, exponent):
    """Heights times a power of two are filled with those times it, bit by bit, though squares are 0 or infinite."""
    grid, chance = SlabGrid(comm, SHAPE), np.random.default_rng(1)
    heights = np.where(chance.random(SHAPE) < 0.3, np.nan, chance.normal(size=SHAPE))[grid.rows]
    other = np.ldexp(heights, exponent)
    fill_missing(grid, heights)
    fill_missing(grid, other)
    assert np.isfinite(heights).all() and np.array_equal(other, np.ldexp(heights, exponent))


def test_nothing_measured_or_not_finite(comm, shared_tmp_path):
    """Infinite heights are no holes, and a file of holes is no surface."""
    nothing = saved(comm, shared_tmp_path / "a.npy", lambda path: np.save(path, np.full(SHAPE, np.nan)))
    with pytest.raises(InputError, match="no point was measured"):
        read_heights(SlabGrid(comm, SHAPE), nothing, missing="interpolate")
    endless = saved(comm, shared_tmp_path / "b.npy", lambda path: np.save(path, np.full(SHAPE, -np.inf)))
    with pytest.raises(InputError, match=r"\[\d, 0\] is -inf; all must be finite$"):
        read_heights(SlabGrid(comm, SHAPE), endless, missing="interpolate")


def test_log_says_what_was_understood(comm, shared_tmp_path, tilted, caplog):
    """Format, shape, orientation, size, unit, range; a slope that a wrong unit gives is warned of, on rank 0."""
    caplog.set_level(logging.INFO, "pgfmd")
    logging.getLogger("pgfmd").propagate = True
    path = saved(comm, shared_tmp_path / "a.xyz", lambda path: made(path, tilted))
    grid = SlabGrid(comm, SHAPE)
    read_heights(grid, path, height_scale=1e-2)
    words = (
        r"text, coordinates and heights, 11 x 24 points, first axis x, 11 x 24, unit not said",
        rf"heights {tilted.min() / 100:.6g} to {tilted.max() / 100:.6g} .*rms .*slope",
    )
    said = "\n".join(record.getMessage() for record in caplog.records)
    assert all(re.search(each, said) for each in words) == (comm.rank == 0)
    warnings = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert all("opposite edges" in line for line in warnings)  # it is tilted
    for scale in (1e4, 1e-9):
        caplog.clear()
        read_heights(grid, path, height_scale=scale)
        assert ("no rough surface has a slope" in caplog.text) == (comm.rank == 0)


BAD = {
    "nan.npy": np.full(SHAPE, np.nan),
    "turned.npy": np.ones(SHAPE[::-1]),
    "complex.npy": np.ones(SHAPE, complex),
    "cube.h5": np.ones((2, *SHAPE)),
    "unit.h5": np.ones(SHAPE),
    "small.xyz": np.ones((3, 5)),
    "holes.txt": np.diag([1, 2, 3, 4]) + np.where(np.arange(4) % 2, np.nan, 0),
    "good.npy": np.ones(SHAPE),
}


@pytest.mark.parametrize("name", BAD)
def test_check_finds_what_a_run_finds(comm, shared_tmp_path, name):
    """Without MPI, before the run, in the same words; nothing where the run finds nothing."""
    path = saved(comm, shared_tmp_path / name, lambda path: made(path, BAD[name], units="V"))
    surface, outcome = FromFile(path=str(path)), []
    for attempt in (
        lambda: surface.check_inputs(Cell(n=SHAPE), "m"),
        lambda: surface.heights(SlabGrid(comm, SHAPE), "m"),
    ):
        try:
            attempt()
            outcome.append("")
        except InputError as error:
            outcome.append(str(error))
    assert [bool(words) for words in outcome] == 2 * [name != "good.npy"]
    assert outcome[0] == outcome[1] or comm.rank > 0  # which names the first of its own rows


@pytest.mark.skipif(SIZE > 1, reason="serial")
def test_check_opens_the_file(tmp_path):
    """`pgfmd check` refuses heights that a run would refuse, says what it understood of others, and needs no MPI."""
    head = "[grid]\nn = [11, 24]\n[surface]\nkind='file'\nmissing = 'interpolate'\npath = 'a.npy'\n[load]\npressure = 1"
    heights = np.random.default_rng(0).normal(size=SHAPE)
    heights[3, 4] = np.nan
    code = "import sys; sys.modules['mpi4py'] = None; from pgfmd.application.cli import main; sys.exit(main())"
    (tmp_path / "job.toml").write_text(SOLID + head)
    said = "11 x 24 points, first axis x, unit not said; 1 of 264 points"
    for shape, words in ((SHAPE, said), ((24, 11), "24 x 11")):
        made(tmp_path / "a.npy", heights.reshape(shape))
        done = python(code, "check", tmp_path / "job.toml")
        assert done.returncode == (0 if shape == SHAPE else 2) and words in done.stdout + done.stderr


def test_fingerprint(comm, shared_tmp_path, tilted):
    """It tells other heights or units, alike on any ranks, and nothing else in the file; a text's is of its bytes."""
    chance = np.random.default_rng(4)
    found = set()
    for number in range(6):
        heights = tilted.copy()
        if number:
            heights[chance.integers(11), chance.integers(24)] *= 1 + 2.2e-16 * number
        path = saved(comm, shared_tmp_path / f"{number}.h5", partial(made, heights=heights, units="m"))
        found.add(digest(comm, FromFile(path=f"{path}:heights").source))
        assert digest(MPI.COMM_SELF, FromFile(path=f"{path}:heights").source) in found
    assert len(found) == 6
    other = saved(comm, shared_tmp_path / "same.h5", lambda path: made(path, tilted, units="m", note="new"))
    assert digest(comm, FromFile(path=f"{other}:heights").source) in found
    other = saved(comm, shared_tmp_path / "unit.h5", lambda path: made(path, tilted, units="nm"))
    assert digest(comm, FromFile(path=f"{other}:heights").source) not in found
    path = saved(comm, shared_tmp_path / "a.txt", lambda path: made(path, tilted))
    assert digest(comm, FromFile(path=str(path)).source) == hashlib.sha256(path.read_bytes()).hexdigest()


def test_without_the_package_the_command_is_named(comm, monkeypatch):
    """Where SurfaceTopography is not installed, one line on every rank says how it gets there."""
    monkeypatch.setitem(sys.modules, "SurfaceTopography", None)
    with pytest.raises(InputError, match=r"measured\.sdf: is neither .*tools/setup\.sh surfaces"):
        read_heights(SlabGrid(comm, SDF_SHAPE, SDF_LENGTHS), SDF)


def test_units_are_exact_powers_of_ten():
    """All pairs, and the spellings of µm and Å."""
    for given, power in measurement.UNITS.items():
        for wanted, other in measurement.UNITS.items():
            assert measurement.conversion(given, wanted) == float(f"1e{power - other}")
    assert measurement.conversion("um", "nm") == measurement.conversion("\u03bcm", "nm") == 1000.0
    assert measurement.conversion("nm", "A") == 10.0
    with pytest.raises(InputError, match="is in 'V'"):
        measurement.conversion("V", "m")


def test_fields_behind_a_link_are_part_of_the_job(comm, shared_tmp_path):
    """fields.h5 of results holds links only: other heights behind them are another surface, which --restart refuses."""
    pieces = [shared_tmp_path / "linked.h5", shared_tmp_path / "fields.h5"]

    def link(path):
        with h5py.File(path, "w") as file:
            file["height"] = h5py.ExternalLink("linked.h5", "heights")

    saved(comm, shared_tmp_path / "linked.h5", lambda path: made(path, np.eye(8)))
    saved(comm, shared_tmp_path / "fields.h5", link)
    text = SOLID + f"[grid]\nn = 8\n[surface]\nkind = 'file'\npath = '{pieces[1]}:height'\n[load]\npressure = 0.01\n"
    simulate(job.parse(text), comm, shared_tmp_path / "out")
    saved(comm, shared_tmp_path / "linked.h5", lambda path: made(path, 2 * np.eye(8)))
    with pytest.raises(InputError, match=r"content of .*fields\.h5 has changed"):
        simulate(job.parse(text), comm, shared_tmp_path / "out", restart=True)


def test_masked_heights_of_a_script(comm):
    """A mask is not dropped."""
    heights = np.ma.masked_greater(np.random.default_rng(0).normal(size=(8, 8)), 1)
    with pytest.raises(InputError, match="heights: .* are masked"):
        pgfmd.solve(heights, 0.01)
    assert (pgfmd.solve(np.ma.array(heights.data), 0.01).pressure > 0).any()


@pytest.fixture
def package():
    return pytest.importorskip("SurfaceTopography", reason="tools/setup.sh test")


@pytest.mark.parametrize(("unit", "metre"), [("m", 1.0), ("nm", 1e9), ("µm", 1e6)])
def test_instrument_s_file(comm, package, unit, metre):
    """A standard file (ISO 25178-71) arrives in the job's unit, each rank with its rows; to rounding."""
    grid = SlabGrid(comm, SDF_SHAPE, tuple(metre * length for length in SDF_LENGTHS))
    expected = metre * np.load(NPY).astype(float)
    found = whole(grid, read_heights(grid, SDF, length_unit=unit))
    assert np.allclose(found, expected, rtol=1e-14, atol=0)


def test_instrument_s_file_is_mirrored_and_levelled_like_any_other(comm, package):
    """The same numbers as from .npy, to rounding of the units."""
    grid = SlabGrid(comm, (256, 192), (25.6e-6, 23.04e-6))
    found, expected = (read_heights(grid, path, "m", detrend="plane", periodic="mirror") for path in (SDF, NPY))
    assert np.allclose(found, expected, rtol=0, atol=1e-14 * 1.7e-7)


@pytest.mark.parametrize(("shape", "lengths", "periodic", "unit", "words"), [
    ((128, 128), SDF_LENGTHS, "as-is", "m", r"write n = \[128, 96\] under \[grid\]"),
    ((128, 96), (128.0, 96.0), "as-is", "m", r"write length = \[1\.28e-05, 1\.152e-05\] under \[grid\]"),
    ((256, 192), SDF_LENGTHS, "mirror", "nm", r"25600 x 23040 nm, with its mirror images, the cell"),
    ((128, 96), SDF_LENGTHS, "as-is", "length", r'write length_unit = "µm" under \[output\]'),
])  # fmt: skip
def test_grid_cell_and_unit_must_be_those_of_the_file(comm, package, shape, lengths, periodic, unit, words):
    """What does not fit is named with what to write."""
    with pytest.raises(InputError, match=words):
        read_heights(SlabGrid(comm, shape, lengths), SDF, periodic=periodic, length_unit=unit)


@pytest.mark.parametrize(("header", "unit", "words"), [
    ("", "m", 'if it is in µm, begin it with "# Lateral units: µm" and "# Value units: µm"'),
    ("# Lateral units: um\n# Value units: um\n", "um", 'length_unit = "m" under [output]'),
    ("", "length", '"# Value units: µm", and write length_unit = "m" under [output]); or leave out'),
])  # fmt: skip
def test_points_in_another_unit_than_the_job(comm, shared_tmp_path, header, unit, words):
    """A list of points in µm, a job in metres: the advice names the unit that one of them does not say."""
    points = "".join(f"{x} {y} {(3 * x + y) % 5}\n" for x in range(8) for y in range(8))
    path = saved(comm, shared_tmp_path / "a.xyz", lambda path: path.write_text(header + points))
    with pytest.raises(InputError, match=re.escape(words)):
        read_heights(SlabGrid(comm, (8, 8), (8e-6, 8e-6)), path, length_unit=unit)


@pytest.mark.parametrize(("content", "words"), [
    (SDF.read_bytes()[:5000], "cannot be read by SurfaceTopography"),
    (b"neither heights nor anything else\n", "read by SurfaceTopography: .* numbers, but .* begin with #$"),
    (b"", "is empty$"),
    (SDF.read_bytes()[:81] + 6000 * b"\0\0\xc0\x7f" + SDF.read_bytes()[24081:], "6000 of 12288 points .* too many"),
    ("\n".join(f"{x} {x % 3}" for x in range(20)).encode(), "line scan"),
])  # fmt: skip
def test_files_that_hold_no_surface(comm, package, shared_tmp_path, content, words):
    """Cut off, of no known format, with a hole, a profile: one line on every rank."""
    path = saved(comm, shared_tmp_path / "a.dat", lambda path: path.write_bytes(content))
    with pytest.raises(InputError, match=words) as caught:
        read_heights(SlabGrid(comm, SDF_SHAPE, SDF_LENGTHS), path, length_unit="m")
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


def test_want_of_memory_is_no_fault_of_the_file(comm, shared_tmp_path, monkeypatch):
    """A file that memory does not hold is not called damaged, on any rank."""

    def rows(self, first, stop):
        raise MemoryError("no room")

    path = saved(comm, shared_tmp_path / "a.npy", lambda path: np.save(path, np.ones((8, 8))))
    monkeypatch.setattr(measurement.Measurement, "rows", rows)
    with pytest.raises(MemoryError, match="no room"):
        read_heights(SlabGrid(comm, (8, 8)), path)


def test_text_sdf_of_either_standard(comm, package, shared_tmp_path):
    """The BCR report's magic word and ISO's: the same heights and size, in metres, with a bad point that is missing."""
    head = "ManufacID = x\nCreateDate = 010101000000\nModDate = 010101000000\nNumPoints = 5\nNumProfiles = 4\n"
    head += "Xscale = 1e-7\nYscale = 2e-7\nZscale = 1e-9\nZresolution = -1\nCompression = 0\nDataType = 7\n"
    head += "CheckType = 0\n"
    values = np.arange(20.0).reshape(4, 5)
    body = "\n".join(" ".join(map(str, row)) for row in values).replace("7.0", "BAD", 1)
    grid = SlabGrid(comm, (5, 4), (5e-7, 8e-7))
    for word in ("aISO-1.0", "aBCR-1.0"):
        content = f"{word}\n{head}*\n{body}\n*\n"
        path = saved(comm, shared_tmp_path / f"{word}.sdf", lambda path, content=content: path.write_text(content))
        found = whole(grid, read_heights(grid, path, "m", missing="interpolate"))
        assert np.allclose(found, 1e-9 * values.T, rtol=1e-9, atol=0)
