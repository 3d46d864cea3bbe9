"""Plain text: what is a table of numbers, what are coordinates, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from pgfmd.errors import InputError
from pgfmd.surfaces.readers import read_text

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


def test_comments_at_the_ends_of_lines(tmp_path):
    """They are passed over on any line, the first too."""
    (tmp_path / "a.txt").write_text("1 2 3 4  # a\n5 6 7 8 # b\n")
    assert np.array_equal(read_text(tmp_path / "a.txt").array, [[1, 2, 3, 4], [5, 6, 7, 8]])


def test_separators_at_the_ends_of_lines(tmp_path):
    """Spreadsheets end each line with one: no column of missing heights."""
    (tmp_path / "a.csv").write_text("1,2,3,4,\n5,6,7,8,\n")
    assert read_text(tmp_path / "a.csv").shape == (2, 4)


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
