"""Heights from files: what is read, how it is made periodic, and instruments' formats with their size and unit."""

from __future__ import annotations

import sys

import h5py
import numpy as np
import pytest
from conftest import ROOT

from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.surfaces import measurement
from pgfmd.surfaces.file import FromFile

pytestmark = pytest.mark.mpi

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


def saved(comm, folder, name, make):
    """Path of a file that rank 0 makes."""
    path = folder / name
    if comm.rank == 0:
        make(path)
    comm.Barrier()
    return path


def whole(grid, heights):
    return grid.fetch(heights, 0, grid.shape[0])


def without_plane(heights):
    """By a general least-squares solver."""
    x, y = np.indices(heights.shape).reshape(2, -1)
    columns = np.stack([np.ones_like(x), x, y], axis=1).astype(float)
    return heights - (columns @ np.linalg.lstsq(columns, heights.ravel(), rcond=None)[0]).reshape(heights.shape)


def four_images(heights):
    return np.block([[heights, heights[:, ::-1]], [heights[::-1], heights[::-1, ::-1]]])


@pytest.mark.parametrize("suffix", ["npy", "h5"])
@pytest.mark.parametrize("periodic", ["as-is", "mirror"])
def test_rows_of_every_rank(comm, shared_tmp_path, tilted, suffix, periodic):
    """The ranks together hold the file bit for bit, or it and its three mirror images."""

    def make(path):
        if suffix == "npy":
            np.save(path, tilted)
        else:
            with h5py.File(path, "w") as file:
                file["heights"] = tilted

    path = saved(comm, shared_tmp_path, f"a.{suffix}", make)
    expected = tilted if periodic == "as-is" else four_images(tilted)
    grid = SlabGrid(comm, expected.shape)
    assert np.array_equal(whole(grid, read_heights(grid, path, periodic=periodic)), expected)


@pytest.mark.parametrize("periodic", ["as-is", "mirror"])
def test_plane(comm, shared_tmp_path, tilted, periodic):
    """The plane is that of the measurement, also where its images follow; to rounding of heights up to 300."""
    path = saved(comm, shared_tmp_path, "a.npy", lambda path: np.save(path, tilted))
    expected = without_plane(tilted) if periodic == "as-is" else four_images(without_plane(tilted))
    grid = SlabGrid(comm, expected.shape)
    found = whole(grid, read_heights(grid, path, detrend="plane", height_scale=-2.0, periodic=periodic))
    assert np.allclose(found, -2 * expected, rtol=0, atol=1e-11)


def test_taper(comm, shared_tmp_path, tilted):
    """The inner four fifths are the measured heights; at the edges nothing is left but their mean."""
    path = saved(comm, shared_tmp_path, "a.npy", lambda path: np.save(path, np.kron(tilted, np.ones((8, 8)))))
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
    """Odd grids cannot be halved; the shape that the file should have is said."""
    path = saved(comm, shared_tmp_path, "a.npy", lambda path: np.save(path, tilted))
    with pytest.raises(InputError, match="11 x 24 points cannot be halved"):
        read_heights(SlabGrid(comm, SHAPE), path, periodic="mirror")
    with pytest.raises(InputError, match="mirror images of 12 x 24"):
        read_heights(SlabGrid(comm, (24, 48)), path, periodic="mirror")


def test_text_is_what_npy_is(comm, shared_tmp_path, tilted):
    """A bare matrix of numbers, as `numpy.savetxt` writes it, is bit for bit the surface that .npy gives: line i is at
    x = i aₓ, in the job's units.
    """
    path = saved(comm, shared_tmp_path, "a.txt", lambda path: np.savetxt(path, tilted))
    grid = SlabGrid(comm, SHAPE, (1.0, 2.0))
    assert np.array_equal(whole(grid, read_heights(grid, path, length_unit="length")), tilted)


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


# ---- with the package -----------------------------------------------------------------------------------------------


@pytest.fixture
def package():
    return pytest.importorskip("SurfaceTopography", reason="tools/setup.sh surfaces")


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


@pytest.mark.parametrize(
    ("shape", "lengths", "periodic", "unit", "words"),
    [
        ((128, 128), SDF_LENGTHS, "as-is", "m", r"write n = \[128, 96\] under \[grid\]"),
        ((128, 96), (128.0, 96.0), "as-is", "m", r"write length = \[1\.28e-05, 1\.152e-05\] under \[grid\]"),
        ((256, 192), SDF_LENGTHS, "mirror", "nm", r"25600 x 23040 nm, with its mirror images, the cell"),
        ((128, 96), SDF_LENGTHS, "as-is", "length", r'write length_unit = "µm" under \[output\]'),
    ],
)
def test_grid_cell_and_unit_must_be_those_of_the_file(comm, package, shape, lengths, periodic, unit, words):
    """What does not fit is named with what to write."""
    with pytest.raises(InputError, match=words):
        read_heights(SlabGrid(comm, shape, lengths), SDF, periodic=periodic, length_unit=unit)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (SDF.read_bytes()[:5000], "cannot be read by SurfaceTopography"),
        (b"neither heights nor anything else\n", "cannot be read by SurfaceTopography"),
        (SDF.read_bytes()[:81] + b"\0\0\xc0\x7f" + SDF.read_bytes()[85:], "not measured"),
        ("\n".join(f"{x} {x % 3}" for x in range(20)).encode(), "line scan"),
    ],
)
def test_files_that_hold_no_surface(comm, package, shared_tmp_path, content, words):
    """Cut off, of no known format, with a hole, a profile: one line on every rank."""
    path = saved(comm, shared_tmp_path, "a.dat", lambda path: path.write_bytes(content))
    with pytest.raises(InputError, match=words) as caught:
        read_heights(SlabGrid(comm, SDF_SHAPE, SDF_LENGTHS), path, length_unit="m")
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)
