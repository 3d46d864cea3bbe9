"""The overview page: tiles hold the field, patches are right, the page is whole and safe, and works in a browser."""

import json
import re
import shutil
from pathlib import Path

import browser
import figures
import numpy as np
import overview_charts
import overview_page
import patch_areas
import pyramid
import pytest
import reading
from job_texts import rough_job
from scipy import ndimage
from test_patches import flood_fill

import pgfmd
from pgfmd.application.job import parse

ALL = ["height", "pressure", "gap", "labels"], ["histogram", "spectra", "patches", "discretisation"]
RUNS = {  # folder, fields, observables, wall
    "all": ("<i>all & é", *ALL, {}),
    "pressures": ("pressures", ["pressure"], [], {}),
    "nothing": ("nothing", [], [], {}),
    "soft": ("soft", ["height", "pressure", "gap"], ["spectra"], {"kind": "exponential", "zeta": 0.02}),
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> dict[str, Path]:
    """Small runs: everything kept, nothing but numbers kept, and an exponential wall."""
    top, units = tmp_path_factory.mktemp("runs"), {"length_unit": "µm", "pressure_unit": "<b>GPa"}
    job = {"grid": {"length": [12.0, 10.0]}, "solid": {"contact_modulus": 1.0}, "load": {"pressure": [0.004, 0.02]}}
    for folder, fields, observables, wall in RUNS.values():
        output = {"fields": fields, "observables": observables} | units
        text = rough_job([240, 200], {"lambda_s": 12.0}, **job, wall=wall, output=output)
        pgfmd.run(parse(text), top / folder)
    return {name: top / folder for name, (folder, *_) in RUNS.items()}


@pytest.fixture
def small_tiles(monkeypatch):
    """Tiles of 64², so that small fields have many, on several levels."""
    monkeypatch.setattr(pyramid, "TILE", 64)
    monkeypatch.setattr(pyramid, "SMALLEST", 50)


def page_of(folder: Path, output: Path, *words: str) -> tuple[Path, dict]:
    """The page of a run, drawn as by a user, and the data in it."""
    assert figures.main(["overview", str(folder), "--output", str(output), *words]) == 0
    text = (output / "overview.html").read_text(encoding="utf-8")
    data = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)[1]
    return output / "overview.html", json.loads(data)


@pytest.mark.parametrize("shape", [(130, 200), (64, 64), (257, 31), (5, 7)])
@pytest.mark.parametrize(("scale", "blank"), [("linear", False), ("linear", True), ("sqrt", True), ("log", True)])
def test_tiles_hold_every_point_of_every_level(tmp_path, small_tiles, shape, scale, blank):
    """Each value is that of its grid point to half a step of the scale (and rounding of it, 1e-12 of the range), zeros
    are zeros; every level has every 2^k-th point, whatever the blocks in which the field comes."""
    field = np.random.default_rng(1).normal(size=shape).cumsum(0)
    field = np.maximum(field, 0) if blank else field
    levels, size = pyramid.level_count(shape), pyramid.TILE
    blocks = (field[start : start + size] for start in range(0, shape[0], size))
    made = pyramid.write(pyramid.Pyramid("f", tmp_path), blocks, shape, scale, blank)
    assert max(made.small.shape) <= pyramid.SMALLEST or levels == 1
    np.testing.assert_array_equal(made.small, field[:: 2 ** (levels - 1), :: 2 ** (levels - 1)])
    seen = 0
    for key in made.sizes:
        level, i, j = map(int, key.split("/")[1:])
        wanted = field[:: 2**level, :: 2**level][i * size : (i + 1) * size, j * size : (j + 1) * size]
        codes, low, high = pyramid.decoded(made.path(key).read_bytes())
        codes = codes.reshape(wanted.shape).cumsum(0, dtype=np.uint8).cumsum(1, dtype=np.uint8)
        np.testing.assert_array_equal(codes == 0, wanted <= 0 if blank else np.zeros(wanted.shape, bool))
        shown = codes > 0
        scaled = pyramid.SCALES[scale](wanted[shown])
        found = low + (high - low) * (codes[shown].astype(float) - 1) / 254
        assert np.all(np.abs(found - scaled) <= (high - low) * (0.5 / 254 + 1e-12))
        seen += wanted.size
    assert seen == sum(field[:: 2**level, :: 2**level].size for level in range(levels))


@pytest.mark.parametrize("connectivity", [4, 8])
def test_patches_of_a_periodic_field(connectivity):
    """Points have one number if and only if they are connected, as a flood fill finds."""
    for seed in range(20):
        contact = np.random.default_rng(seed).random((9, 12)) < 0.45
        expected = flood_fill(contact, 1.0 * contact, connectivity)[0]
        found = patch_areas.labelled(contact, connectivity)
        pairs = set(zip(found.ravel().tolist(), expected.ravel().tolist(), strict=True))
        assert len(pairs) == len(set(found.ravel())) == len(set(expected.ravel())) and (0, 0) in pairs, f"seed {seed}"


def test_areas_from_labels_and_from_pressures_agree(runs):
    """And they are those of the run's own table of patches."""
    load = reading.loads([runs["all"]])[1]
    kept = np.concatenate(list(patch_areas.areas(load, 64)))
    found = np.concatenate(list(patch_areas.areas(reading.loads([runs["pressures"]])[1], 100)))
    np.testing.assert_array_equal(kept, found)
    labels, table = load.results.field("labels", 1), load.groups["patches"]
    np.testing.assert_allclose(kept[labels > 0], table["area"][labels[labels > 0] - 1], rtol=1e-12)


def test_a_small_run_is_whole_in_the_page(runs, tmp_path):
    """All loads, all fields, all points, nothing beside it and nothing from elsewhere; names are text."""
    path, data = page_of(runs["all"], tmp_path)
    assert [view["key"] for view in data["fields"]] == ["height", "pressure", "gap", "patch"]
    assert data["shown"] == [0, 1] and data["folder"] is None and not (tmp_path / overview_page.FOLDER).exists()
    assert len(data["tiles"]) == len(data["images"]) == 7 and len(data["charts"]) == 3 and len(data["rows"]) == 2
    text = path.read_text(encoding="utf-8")
    addresses = set(re.findall(r"https?:[^\"'\s]*", text))  # with the colon: base64 may have "http" by chance
    assert addresses <= {"http://www.w3.org/2000/svg"}
    assert "<i>all" not in text and "<b>GPa" not in text
    for kind in ("png", "pdf", "csv", "json"):
        assert (tmp_path / f"overview.{kind}").stat().st_size > 0


def test_many_loads_keep_the_page_small(runs, tmp_path, monkeypatch):
    """Of more loads than curves can be told apart, or fields fit, those evenly spread are shown, and that is said."""
    monkeypatch.setattr(overview_charts, "MOST_CURVES", 1)
    monkeypatch.setattr(overview_page, "MOST_LOADS", 1)
    _, data = page_of(runs["all"], tmp_path)
    assert {curve["load"] for chart in data["charts"][1:] for curve in chart["curves"]} == {0} == set(data["shown"])
    assert len(data["rows"]) == len(data["charts"][0]["curves"][0]["x"]) == 2
    assert any("1 of the 2 loads" in note for note in data["notes"])
    loads = list(range(100))
    found = overview_charts.some(loads, 7)
    assert len(found) == 7 and (found[0], found[-1]) == (0, 99)


def test_what_was_not_kept_is_said(runs, tmp_path):
    """A page of any run: with what there is, and a line for what there is not."""
    _, data = page_of(runs["nothing"], tmp_path / "1")
    assert not data["fields"] and len(data["notes"]) == 6 and len(data["rows"]) == 2
    _, data = page_of(runs["pressures"], tmp_path / "2", "--loads", "1")
    assert [view["key"] for view in data["fields"]] == ["pressure", "patch"] and data["shown"] == [1]
    _, data = page_of(runs["soft"], tmp_path / "3")
    assert [view["key"] for view in data["fields"]] == ["height", "pressure", "gap"]
    assert not any(view["blank"] for view in data["fields"])


@pytest.mark.breadth
def test_large_fields_lie_beside_the_page(runs, tmp_path, monkeypatch, small_tiles):
    """Beyond the budget other levels lie in the folder, none twice; --no-tiles has none; a new page, no old tile."""
    monkeypatch.setattr(overview_page, "BUDGET", 60e3)
    _, data = page_of(runs["all"], tmp_path)
    inside = sum(len(tile[2]) for tile in data["tiles"].values())
    assert 0.3 * 60e3 < inside < 60e3
    files = {path.stem for path in (tmp_path / data["folder"]).iterdir()}
    assert not files & {key.replace("/", "-") for key in data["tiles"]}
    shape = data["shape"]
    counts = [np.ceil(np.ceil(np.array(shape) / 2**level) / 64).prod() for level in range(data["levels"])]
    assert len(files) + len(data["tiles"]) == 7 * sum(counts)
    assert any("/0/" in key for key in data["tiles"])
    _, data = page_of(runs["pressures"], tmp_path)
    assert data["folder"] is None and not (tmp_path / overview_page.FOLDER).exists()  # all fits
    _, data = page_of(runs["all"], tmp_path, "--no-tiles")
    assert data["folder"] is None and not (tmp_path / overview_page.FOLDER).exists() and "--no-tiles" in data["tells"]


@pytest.fixture(scope="module")
def window(tmp_path_factory):
    if browser.executable() is None:
        pytest.skip("needs chromium: tools/setup.sh test")
    with browser.Browser(tmp_path_factory.mktemp("profile")) as found:
        yield found
    assert not found.complaints


SHOWN = "Object.fromEntries([...document.querySelectorAll('figure')].map(f => [f.querySelector('b').textContent, [f.querySelector('output').textContent, f.querySelector('output').dataset.level]]))"  # noqa: E501


def number(text: str) -> float:
    """The number at the beginning of a text of the page."""
    found = re.match(r"(−?[\d.]+)(?:·10(⁻?)([⁰¹²³⁴⁵⁶⁷⁸⁹]+))?", text)
    power = found[3].translate(str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹", "0123456789")) if found[3] else "0"
    return float(found[1].replace("−", "-")) * 10.0 ** int(("-" if found[2] else "") + power)


@pytest.mark.parametrize("beside", [False, True])
@pytest.mark.breadth
def test_the_browser_shows_the_numbers_of_the_files(runs, tmp_path, monkeypatch, small_tiles, window, beside):
    """At ten points, zoomed in: values to 1/254 of the range, contact where it is, tiles inside or beside the page."""
    if beside:
        monkeypatch.setattr(overview_page, "BUDGET", 60e3)
    path, data = page_of(runs["all"], tmp_path)
    assert (data["folder"] is not None) == beside
    load = reading.loads([runs["all"]])[1]
    fields = {"height": load.results.field("height"), "pressure": load.results.field("pressure", 1)}
    steps = {"height": np.ptp(fields["height"]) / 254, "pressure": fields["pressure"].max() / 254}
    points = np.random.default_rng(2).integers((12, 12), (228, 188), size=(9, 2)).tolist()
    points.append([int(index) for index in np.unravel_index(fields["pressure"].argmax(), fields["pressure"].shape)])
    for i, j in points:
        window.open(path, f"#load=1&x={i + 0.5}&y={j + 0.5}&zoom=24")
        shown = window.evaluate(SHOWN)
        assert {level for _, level in shown.values()} == {"0"}
        touched = fields["pressure"][i, j] > 0
        assert (shown["Pressure"][0] == "no contact") != touched and (shown["Gap"][0] == "contact") == touched
        assert number(shown["Surface: height"][0]) == pytest.approx(fields["height"][i, j], abs=steps["height"])
        if touched:
            assert number(shown["Pressure"][0]) == pytest.approx(fields["pressure"][i, j], abs=steps["pressure"])
            assert shown["Pressure"][0].endswith("<b>GPa") and shown["Contact patches: area"][0].endswith("µm²")
    assert not window.complaints


@pytest.mark.breadth
def test_the_browser_zooms_moves_and_changes_loads(runs, tmp_path, monkeypatch, small_tiles, window):
    """The wheel zooms about the pointer, dragging moves, the table chooses the load, all panels together."""
    monkeypatch.setattr(overview_page, "BUDGET", 60e3)
    path, _ = page_of(runs["all"], tmp_path)
    window.open(path)
    assert window.evaluate("document.querySelectorAll('canvas').length") == 4
    assert window.evaluate("document.documentElement.dataset.level") == "0"
    before = window.evaluate("[view.x, view.y, view.zoom]")
    box = window.evaluate("(b => [b.left, b.top])(document.querySelector('canvas').getBoundingClientRect())")
    x, y = box[0] + 150, box[1] + 60
    window.mouse("mouseMoved", x, y)
    under = window.evaluate(f"panels[0].toGrid(...[{x - box[0]}, {y - box[1]}])")
    for _ in range(12):
        window.mouse("mouseWheel", x, y, deltaX=0, deltaY=-120)
    window.until("document.documentElement.dataset.state === 'complete'")
    assert window.evaluate("view.zoom") > 20 * before[2]
    now = window.evaluate(f"panels[0].toGrid(...[{x - box[0]}, {y - box[1]}])")
    np.testing.assert_allclose(now, under, atol=1 / before[2])  # a pixel of the first view: its edges are whole pixels
    middle = window.evaluate("[view.x, view.y]")
    window.mouse("mousePressed", x, y, button="left", buttons=1, clickCount=1)
    window.mouse("mouseMoved", x + 30, y - 10, button="left", buttons=1)
    window.mouse("mouseReleased", x + 30, y - 10, button="left", clickCount=1)
    moved = np.subtract(window.evaluate("[view.x, view.y]"), middle) * window.evaluate("step()")
    np.testing.assert_allclose(moved, [-30, -10], atol=0.5)
    window.evaluate("document.querySelector('#table tbody tr').click()")
    window.until("document.documentElement.dataset.state === 'complete' && view.load === 0")
    assert window.evaluate("document.getElementById('load').value") == "0"
    window.evaluate("document.getElementById('whole').click()")
    window.until("view.whole && view.zoom < 10")
    assert window.evaluate("[view.x, view.y]") == [120, 100]
    window.evaluate("document.getElementById('seen').click()")
    window.until("panels.every(panel => panel.field.seen)")
    assert not window.complaints


@pytest.mark.breadth
def test_pixels_have_the_colours_of_their_values(runs, tmp_path, window):
    """Pressures in contact have the colour of p/top, others light grey; a step of 256 and one of 254 are allowed."""
    path, data = page_of(runs["all"], tmp_path)
    pressure = reading.loads([runs["all"]])[1].results.field("pressure", 1)
    top = data["fields"][1]["range"][1]
    hexadecimal = data["maps"]["inferno"]
    colours = np.frombuffer(bytes.fromhex(hexadecimal), np.uint8).reshape(256, 3).astype(int)
    i, j = (int(index) for index in np.unravel_index(pressure.argmax(), pressure.shape))
    window.open(path, f"#load=1&x={i + 0.5}&y={j + 0.5}&zoom=20")
    for a, b in ((0, 0), (2, 0), (0, 3), (-3, -2), (4, 4)):
        seen = window.evaluate(f"""(p => [...p.canvas.getContext('2d').getImageData(
            ...p.toScreen({i + a} + 0.5, {j + b} + 0.5).map(Math.round), 1, 1).data].slice(0, 3))(panels[1])""")
        value = pressure[(i + a) % 240, (j + b) % 200]
        if value <= 0:
            assert seen == [0xF5, 0xF4, 0xF2]
        else:
            place = round(255 * min(value / top, 1))
            near = colours[max(0, place - 2) : place + 3]
            assert np.abs(near - seen).max(1).min() <= 3, (value, seen)


def test_the_most_loaded_point_bears_most_in_its_tile(runs, tmp_path, small_tiles):
    """The button leads to a point in contact, the highest pressure of its tile of 64² points (to a step of its 254), in
    the tile where pressures over a twentieth of the cell are largest, on every 4th point."""
    _, data = page_of(runs["all"], tmp_path)
    pressure = reading.loads([runs["all"]])[1].results.field("pressure", 1)
    i, j = data["peak"]
    tile = pressure[i // 64 * 64 :, j // 64 * 64 :][:64, :64]
    assert pressure[i, j] > 0 and tile.max() - pressure[i, j] <= tile.max() / 254
    thin = pressure[::8, ::8]
    mean = ndimage.uniform_filter(thin, max(1, max(thin.shape) // 20), mode="wrap")
    a, b = np.unravel_index(mean.argmax(), mean.shape)
    assert (8 * a // 64, 8 * b // 64) == (i // 64, j // 64)


@pytest.mark.breadth
def test_a_page_without_its_folder_says_so(runs, tmp_path, monkeypatch, small_tiles, window):
    """It still opens, shows the coarse levels and the most loaded part point by point, and tells what is missing."""
    monkeypatch.setattr(overview_page, "BUDGET", 60e3)
    path, data = page_of(runs["all"], tmp_path)
    shutil.rmtree(tmp_path / data["folder"])
    x, y = data["peak"]
    window.open(path, f"#x={x}&y={y}&zoom=24")
    window.until("folderMissing || document.documentElement.dataset.level === '0'")
    assert window.evaluate(SHOWN)["Surface: height"][1] == "0"
    far = [(x + 120) % 240, (y + 100) % 200]
    window.open(path, f"#x={far[0]}&y={far[1]}&zoom=24")
    window.until("document.getElementById('resolution').textContent.includes('is not beside the page')")
    assert int(window.evaluate(SHOWN)["Surface: height"][1]) > 0
    assert window.complaints and all("ERR_FILE_NOT_FOUND" in complaint for complaint in window.complaints)
    window.complaints.clear()


@pytest.mark.parametrize("name", ["nothing", "pressures", "soft"])
@pytest.mark.breadth
def test_every_kind_of_run_opens(runs, tmp_path, window, name):
    """With fewer fields or none, no error; the table is there."""
    path, _ = page_of(runs[name], tmp_path)
    window.open(path)
    assert window.evaluate("document.querySelectorAll('#table tbody tr').length") == 2
    assert not window.complaints
