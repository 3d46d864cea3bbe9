"""Measured surfaces as people have them: spreadsheets, images, tilt and curvature, edges that do not match."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from conftest import saved

from pgfmd.errors import InputError
from pgfmd.grid.domain import OPEN
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.surfaces import readers
from pgfmd.surfaces.file import FromFile
from pgfmd.surfaces.readers import read_text

pytestmark = pytest.mark.mpi

SHAPE = (11, 24)


@pytest.fixture
def heights():
    """A rough array on a tilted bowl, on a scale of nanometres."""
    x, y = np.ogrid[: SHAPE[0], : SHAPE[1]]
    rough = np.random.default_rng(7).normal(size=SHAPE)
    return 1e-9 * (rough + 3.0 * x - 7.0 * y + 0.4 * x**2 - 0.3 * x * y + 0.05 * y**2 + 100)


def read(comm, path, shape=SHAPE, **options):
    """The heights of all ranks."""
    grid = SlabGrid(comm, shape)
    return grid.fetch(FromFile(path=str(path), **options).heights(grid, None), 0, shape[0])


@pytest.mark.parametrize("periodic", ["as-is", "mirror"])
@pytest.mark.parametrize("shape", [SHAPE, (11, 1), (2, 24)])
def test_quadratic(comm, shared_tmp_path, heights, periodic, shape):
    """The paraboloid of least squares over the measured points, as a general solver has it, is subtracted; also where
    mirror images follow, and where there are too few points for some of its terms; to rounding."""
    measured = heights[: shape[0], : shape[1]]
    x, y = np.indices(measured.shape).reshape(2, -1)
    columns = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1).astype(float)
    expected = measured - (columns @ np.linalg.lstsq(columns, measured.ravel(), rcond=None)[0]).reshape(shape)
    if periodic == "mirror":
        expected = np.block([[expected, expected[:, ::-1]], [expected[::-1], expected[::-1, ::-1]]])
    if comm.size > len(expected):
        pytest.skip("fewer rows than ranks")
    path = saved(comm, shared_tmp_path / "a.npy", lambda path: np.save(path, measured))
    found = read(comm, path, expected.shape, detrend="quadratic", periodic=periodic)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(measured).max())


TABLES = {
    "header": 'Instrument,"LS 3000"\nCalibration,1.5,nm\n\n"Height"\n{}',
    "quoted": '"no","unit"\n{quoted}',
    "german": "Höhe;nm\n{german}",
    "comments": "# a comment\nx0,x1,x2,x3\n{}",
    "plain": "{}",
}


@pytest.mark.parametrize("table", TABLES)
def test_tables_of_a_spreadsheet(comm, shared_tmp_path, heights, table):
    """A .csv with words first, quotes, decimal commas, comments: its numbers, bit for bit; unread words are told of."""
    rows = [[repr(float(value)) for value in row] for row in heights]
    text = TABLES[table].format(
        "\n".join(map(",".join, rows)),
        quoted="\n".join(",".join(f'"{word}"' for word in row) for row in rows),
        german="\n".join(";".join(row) for row in rows).replace(".", ","),
    )
    path = saved(comm, shared_tmp_path / "a.CSV", lambda path: path.write_text(text, encoding="utf-8-sig"))
    np.testing.assert_array_equal(read(comm, path), heights)
    said = read_text(str(path)).format
    assert ("lines of words, which are not read" in said) == (table != "plain")


def test_points_with_a_header(comm, shared_tmp_path, heights):
    """Columns x, y, height under their names are points of a lattice; a missing one is filled."""
    lines = [f"{i},{j},{float(heights[i, j])!r}" for i, j in np.ndindex(SHAPE) if (i, j) != (5, 5)]
    path = saved(comm, shared_tmp_path / "a.csv", lambda path: path.write_text("\n".join(["x,y,z", *lines])))
    with pytest.raises(InputError, match="missing"):
        read(comm, path, missing="refuse")
    found = read(comm, path)
    gap = np.zeros(SHAPE, bool)
    gap[5, 5] = True
    np.testing.assert_array_equal(found[~gap], heights[~gap])
    around = (heights[4, 5] + heights[6, 5] + heights[5, 4] + heights[5, 6]) / 4
    assert found[5, 5] == pytest.approx(around, rel=1e-9, abs=0)


@pytest.mark.parametrize("kind", [np.float32, np.uint16, np.uint8])
def test_images(comm, shared_tmp_path, heights, kind):
    """A TIFF of one channel holds the values of its pixels, [line, column], in its own precision."""
    image = pytest.importorskip("PIL.Image")
    values = (255 * (heights - heights.min()) / np.ptp(heights)).astype(kind)
    path = saved(comm, shared_tmp_path / "a.tif", lambda path: image.fromarray(values).save(path))
    np.testing.assert_array_equal(read(comm, path, height_scale=0.5), 0.5 * values)


def test_images_that_are_no_heights(comm, shared_tmp_path):
    """Colours, several images, and damaged files are refused in one line."""
    image = pytest.importorskip("PIL.Image")
    colours = image.fromarray(np.zeros((4, 4, 3), np.uint8))
    grey = image.fromarray(np.zeros((4, 4), np.uint8))
    cases = {
        "colours": lambda path: colours.save(path),
        "2 images": lambda path: grey.save(path, save_all=True, append_images=[grey]),
        "cannot be read as a TIFF image": lambda path: path.write_bytes(b"II*\0 and nothing else"),
    }
    for number, (message, write) in enumerate(cases.items()):
        path = saved(comm, shared_tmp_path / f"{number}.tiff", write)
        with pytest.raises(InputError, match=f"{path.name}: .*{message}"):
            read(comm, path, (4, 4))
    with pytest.raises(InputError, match="TIFF"):
        readers._tiff(str(shared_tmp_path / "missing.tif"))


@pytest.mark.parametrize(("surface", "options", "edges"), [
    ("tilted", {}, "xy"), ("tilted", {"detrend": "plane"}, ""), ("tilted", {"periodic": "mirror"}, ""),
    ("periodic", {}, ""), ("tilted along x", {}, "x"), ("noise", {}, ""),
])  # fmt: skip
def test_edges_that_do_not_match(comm, shared_tmp_path, caplog, monkeypatch, surface, options, edges):
    """Taken as it is, a surface whose opposite edges differ by much more than neighbours is warned of, once, with both
    pairs; one that is periodic, of noise alone, levelled or mirrored is not."""
    n = 32
    x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    rng = np.random.default_rng(3)
    values = {
        "tilted": 1.0 * x + 2.0 * y + rng.normal(size=(n, n)),
        "periodic": np.cos(2 * np.pi * x / n) * np.cos(2 * np.pi * y / n),
        "tilted along x": 1e-3 * x + 0.01 * y * (n - 1 - y),
        "noise": rng.normal(size=(n, n)),
    }[surface]
    path = saved(comm, shared_tmp_path / "a.npy", lambda path: np.save(path, values))
    monkeypatch.setattr(logging.getLogger("pgfmd"), "propagate", True)
    side = 2 * n if options.get("periodic") == "mirror" else n
    read(comm, path, (side, side), **options)
    said = [record.getMessage() for record in caplog.records if "opposite edges differ" in record.getMessage()]
    assert len(said) == (bool(edges) if comm.rank == 0 else 0)
    assert all((f"across {name} by" in line) == (name in edges) for name in "xy" for line in said)
    assert all('periodic = "mirror"' in line and 'boundary = "open"' in line for line in said)
    if "periodic" not in options:
        caplog.clear()
        heights = FromFile(path=str(path), **options).heights(SlabGrid(comm, (n, n), domain=OPEN), None)
        assert "opposite edges" not in caplog.text and heights.shape[1] == n
    else:
        with pytest.raises(InputError, match='boundary = "open" under .* has no cell to close'):
            FromFile(path=str(path), **options).heights(SlabGrid(comm, (2 * n, 2 * n), domain=OPEN), None)
