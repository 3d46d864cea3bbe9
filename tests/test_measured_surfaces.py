"""Measured surfaces as people have them: text, spreadsheets, images, tilt and curvature, edges that do not match."""

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


STYLES = [(" ", "."), ("\t", "."), (",", "."), (", ", "."), (";", "."), (";", ","), ("\t", ","), (" ", ",")]


def written(path, table, separator, mark, missing="nan"):
    """A table of numbers as text; NaN as the word `missing`."""
    lines = (
        separator.join(missing if np.isnan(value) else repr(float(value)).replace(".", mark) for value in row)
        for row in table
    )
    path.write_text("# made by hand\n\n" + "\n".join(lines) + "\n", encoding="utf-8")
    return str(path)


@pytest.mark.parametrize(("separator", "mark"), STYLES)
def test_every_style_gives_back_the_numbers(tmp_path, separator, mark):
    """Number j of line i is [i, j], bit for bit, in every style and with holes; 30 random tables of up to 8 × 12."""
    for seed in range(30):
        chance = np.random.default_rng(seed)
        table = chance.normal(size=chance.integers([1, 4], [9, 13])) * 10.0 ** chance.integers(-12, 12)
        table[0, 0] = 1.5  # a line of whole numbers does not tell what its commas are
        words = ["nan", "BAD", "n/a", "--"] + [""] * (separator in ",;" or separator == "\t")
        if seed % 2:
            table[chance.random(table.shape) < 0.3] = np.nan
            table[0, 0], table[:, -1] = 1.5, 2.5
        path = written(tmp_path / "a.txt", table, separator, mark, words[seed % len(words)])
        assert np.array_equal(read_text(path).array, table, equal_nan=True), f"seed {seed}"


@pytest.mark.parametrize("text", ["1 2 3 4  # a\n5 6 7 8 # b\n", "1,2,3,4,\n5,6,7,8,\n"])
def test_what_ends_a_line_is_no_number(tmp_path, text):
    """A comment, also on the first line, and the separator by which spreadsheets end each line."""
    (tmp_path / "a.csv").write_text(text)
    assert np.array_equal(read_text(tmp_path / "a.csv").array, [[1, 2, 3, 4], [5, 6, 7, 8]])


def test_coordinates_in_any_order(tmp_path):
    """Lines x, y, height in any order, of any origin and spacing to five digits, up to a third missing (NaN)."""
    for seed in range(50):
        chance = np.random.default_rng(seed)
        shape, step, origin = chance.integers(3, 15, 2), 10.0 ** chance.uniform(-6, 3, 2), chance.normal(size=2)
        heights = chance.normal(size=shape)
        gone = chance.random(shape) < chance.choice([0, 0.1, 0.3])
        if shape[0] > 4 and seed % 3 == 0:
            gone[shape[0] // 2] = True
        gone[[0, -1], :2] = gone[:2, [0, -1]] = gone[:2, 1] = False  # the corners, and one pair of neighbours each way
        i, j = (index[~gone] for index in np.indices(shape))
        points = np.stack([origin[0] * step[0] + i * step[0], origin[1] * step[1] + j * step[1], heights[~gone]], 1)
        points[:, :2] = np.vectorize(lambda value: float(f"{value:.5g}"))(points[:, :2])
        path = written(tmp_path / "a.xyz", chance.permutation(points), *STYLES[seed % 4])
        found = read_text(path)
        assert np.array_equal(found.array, np.where(gone, np.nan, heights), equal_nan=True), f"seed {seed}"
        assert np.allclose(found.lengths, shape * step, rtol=1e-3, atol=0), f"seed {seed}"


def test_units_of_points(tmp_path):
    """Units as Gwyddion exports them: heights arrive in the unit of the coordinates."""
    points = "0 0 1000\n0 2 2000\n1 0 3000\n1 2 4000\n"
    (tmp_path / "a.xyz").write_text("# Lateral units: µm\n# Value units: nm\n" + points, encoding="utf-8")
    found = read_text(tmp_path / "a.xyz")
    assert np.allclose(found.array, [[1, 2], [3, 4]], rtol=1e-15, atol=0)
    assert found.unit == "µm" and found.lengths == (2, 4)


@pytest.mark.parametrize(("content", "words"), [
    ("1 2\n2 3\n3 4\n", "line scan"),
    ("0 0 1\n1 0 2\n2 0 3\n", "line scan"),
    ("0 0 1\n1 1 2\n0.3 .7 2\n.2 .5 1\n", "no lattice"),
    ("0 0 1\n0 1 2\n1 0 3\n1 0 4\n", "two heights at one point"),
    ("\n".join(f"{i} {7 * i % 40} {i}" for i in range(40)), "40 points do not fill the lattice of 40 x 40"),
    ("nan 0 1\n0 1 2\n1 0 3\n1 1 4\n", "not all of them are finite"),
    ("1 2 3 4\n1 2 3\n", "line 2 has 3 numbers, unlike the first, which has 4"),
    ("1 2 3 4\n1 2 c 4\n", "line 2 is not a line of numbers"),
])  # fmt: skip
def test_tables_that_are_no_surface(tmp_path, content, words):
    """What is wrong with it, and where."""
    (tmp_path / "a.txt").write_text(content)
    with pytest.raises(InputError, match=words):
        read_text(tmp_path / "a.txt")


@pytest.mark.parametrize(
    "content", [b"", b"\n# only a comment\n", b"a b c d\n1 2 3 4\n", b"\x89PNG\r\n\x1a\n\0\1", b"aISO-1.0\n1 2 3 4\n"]
)
def test_what_is_no_table(tmp_path, content):
    """Left to other readers."""
    (tmp_path / "a").write_bytes(content)
    assert read_text(tmp_path / "a") is None


@pytest.mark.parametrize("comment", ["# Width: 10 µm", "# Value units: m\n# Height = 3", "# scale 1e-9 units"])
def test_sizes_and_units_of_a_matrix_are_not_dropped(tmp_path, comment):
    """A comment that gives them is for SurfaceTopography, which understands it."""
    (tmp_path / "a.txt").write_text(comment + "\n1 2 3 4\n5 6 7 8\n", encoding="utf-8")
    assert read_text(tmp_path / "a.txt") is None
