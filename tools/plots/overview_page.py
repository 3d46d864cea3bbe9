"""The overview as one page for a browser: fields to zoom into, curves, the table of loads.  No MPI.

overview.html needs no network.  It holds small fields whole.  Of larger ones it holds every 2^k-th point, and all
points around the most loaded part; their other tiles are in a folder beside it.  The page itself: page/page.html,
page.css and page.js; tiles: `pyramid`.
"""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib
import numpy as np
import pyramid
from overview_charts import charts, some, table
from patch_areas import PATCHES, areas
from pyramid import Pyramid
from reading import Load
from scipy import ndimage

from pgfmd.errors import InputError
from pgfmd.options.text import counted, printable

PAGE = Path(__file__).with_name("page")
FOLDER = "overview_tiles"
BUDGET = 13e6  # bytes of tiles in the page
MOST_LOADS = 6  # whose fields are shown, unless they are chosen


@dataclass(frozen=True)
class View:
    """How a field is shown: title, unit, colours, scale, whether each load has one, and what zero means (None: just a
    value).
    """

    key: str
    title: str
    unit: str
    colours: str
    scale: str = "linear"
    each: bool = True
    blank: str | None = None
    images: dict[str, Pyramid] = field(default_factory=dict)

    def range(self, point: float) -> tuple[float, float]:
        """The ends of the scale of colours, for all loads; point: the area of one."""
        shown = [image.small[np.isfinite(image.small)] for image in self.images.values()]
        shown = [values[values > 0] if self.blank else values for values in shown]
        shown = [values for values in shown if values.size] or [np.array([0.0, 1.0])]
        if self.key == "patch":
            return point, max(float(values.max()) for values in shown)
        if self.key == "height" or not self.blank:
            return min(float(values.min()) for values in shown), max(float(values.max()) for values in shown)
        return 0.0, max(float(np.quantile(values, 0.998)) for values in shown)


def write_page(loads: Sequence[Load], output: Path, chosen: Sequence[int] | None = None, tiles: bool = True) -> Path:
    """Write overview.html into a folder; its path.

    loads : of one run;  chosen : numbers of the loads whose fields are shown (default: MOST_LOADS of them, evenly
    spread);  tiles : also write the folder of tiles, if not all fit into the page
    """
    first, folder = loads[0], output / FOLDER
    output.mkdir(parents=True, exist_ok=True)
    folder.mkdir(exist_ok=True)
    for old in folder.glob("*-*-*-*.js"):
        old.unlink()
    shown = _spread([load for load in loads if load.fields - {"height"}], chosen)
    notes: list[str] = []
    views = [view for view in _views(first, shown, folder, notes) if view.images]
    embedded, peak = _embedded(views, shown, first.results.shape[1])
    outside = [image.path(key) for view in views for image in view.images.values() for key in image.sizes]
    outside = [path for path in outside if path.exists()]
    if not tiles or not outside:
        for path in outside:
            path.unlink()
        if not any(folder.iterdir()):
            folder.rmdir()
    where = _where(embedded, bool(outside), tiles)
    point = math.prod(first.spacings)
    data = {
        "title": first.folder, "subtitle": _subtitle(first), "shape": first.results.shape, "open": first.open,
        "lengths": first.results.lengths, "length_unit": first.unit("length"), "tile": pyramid.TILE,
        "levels": pyramid.level_count(first.results.shape), "folder": FOLDER if outside and tiles else None,
        "maps": {view.colours: _colours(view.colours) for view in views}, "peak": peak,
        "fields": [{"key": view.key, "title": view.title, "unit": view.unit, "map": view.colours, "scale": view.scale,
                    "each": view.each, "blank": view.blank, "range": view.range(point)} for view in views],
        "images": [name for view in views for name in view.images], "tiles": embedded,
        "shown": [load.index for load in shown], "loads": [[load.index, _name(load)] for load in loads],
        **where, **table(loads), "charts": charts(loads, notes), "notes": notes, "facts": _facts(first),
        "job": printable_lines(first.results.provenance["effective_toml"]),
    }  # fmt: skip
    page = _part("page.html")
    text = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    for name, part in (("STYLE", _part("page.css")), ("SCRIPT", _part("page.js")), ("DATA", text)):
        page = page.replace(f"/*{name}*/", part, 1)
    path = output / "overview.html"
    path.write_text(page, encoding="utf-8")
    return path


def _part(name: str) -> str:
    return (PAGE / name).read_text(encoding="utf-8")


def _spread(loads: list[Load], chosen: Sequence[int] | None) -> list[Load]:
    """The chosen ones, or MOST_LOADS of them, the first and the last included."""
    if chosen is not None:
        for index in chosen:
            if index not in [load.index for load in loads]:
                raise InputError(f"--loads {index}: the run kept no fields of such a load, counted from 0")
        return [load for load in loads if load.index in chosen]
    return some(loads, MOST_LOADS)


def _views(first: Load, shown: list[Load], folder: Path, notes: list[str]) -> Iterator[View]:
    """What there is to show, with its tiles written; notes: what is not shown, and why."""
    length, pressure = first.unit("length"), first.unit("pressure")
    touching = first.releases  # there, no point is free of pressure
    square = "points" if length == "grid spacings" else f"{length}²" if length else ""
    contact = "no contact" if touching else None
    views = (
        View("height", "Surface: height", length, "gray", each=False),
        View("pressure", "Pressure", pressure, "inferno", blank=contact),
        View("gap", "Gap", length, "viridis", "sqrt" if touching else "linear", blank="contact" if touching else None),
        *[View("plastic_depth", "Plastic depth", length, "inferno", blank="not yielded")] * (first.law == "hardness"),
        View("patch", "Contact patches: area", square, "cividis", "log", blank="no contact"),
    )
    shape = first.results.shape
    for view in views:
        missing = []
        for load in [first] if not view.each else shown:
            name = f"{view.key}.{load.index}" if view.each else view.key
            blocks = _blocks(load, view.key)
            if blocks is None:
                missing.append(load)
            else:
                view.images[name] = pyramid.write(Pyramid(name, folder), blocks, shape, view.scale, bool(view.blank))
        if missing or (view.each and not shown):
            reason = f"needs {PATCHES}" if view.key == "patch" else f"the run kept no field {view.key}"
            notes.append(f"{view.title} is not shown: {reason}")
        yield view


def _blocks(load: Load, key: str) -> Iterator[np.ndarray] | None:
    """A field in strips of TILE rows; None if there is none."""
    if key == "patch":
        return areas(load, pyramid.TILE)
    if key not in load.fields:
        return None
    strips = load.results.blocks(key, None if key == "height" else load.index, 8 * pyramid.TILE * load.results.shape[1])
    return (values for _, values in strips)


def _embedded(views: list[View], shown: list[Load], columns: int) -> tuple[dict[str, list], list[int]]:
    """The tiles that go into the page (their files are removed), key → [low, high, bytes in base64]; and `_peak`."""
    images = [image for view in views for image in view.images.values()]
    peak, sizes = _peak(views, shown, columns), {key: size for image in images for key, size in image.sizes.items()}
    inside: list[str] = []
    if sum(sizes.values()) <= BUDGET:
        inside = list(sizes)
    else:
        for level in reversed(range(max(int(key.split("/")[1]) for key in sizes) + 1)):
            more = [key for image in images for key in image.at_level(level)]
            if inside and sum(sizes[key] for key in [*inside, *more]) > BUDGET / 2:
                break
            inside += more
        for image in reversed(images):  # the last load first
            key = f"{image.name}/0/{peak[0] // pyramid.TILE}/{peak[1] // pyramid.TILE}"
            if key not in inside and sum(sizes[key] for key in [*inside, key]) <= BUDGET:
                inside.append(key)
    found: dict[str, list] = {}
    for image in images:
        for key in image.sizes.keys() & set(inside):
            line = image.path(key).read_text()
            found[key] = json.loads(f"[{line[line.index('(') + 1 : line.rindex(')')]}]")[1:]
            image.path(key).unlink()
    return found, peak


def _peak(views: list[View], shown: list[Load], columns: int) -> list[int]:
    """The point [i, j] that bears most under the last load, in the tile where the mean pressure over 1/20 of the cell's
    side is largest; without pressures, the summit of the tile where every 2^k-th point is highest.
    """
    images = {name: image for view in views for name, image in view.images.items()}
    last = f"pressure.{shown[-1].index}" if shown else ""
    image = images.get(last) or images.get("height")
    if image is None:
        return [0, 0]
    small = image.small
    width = max(1, max(small.shape) // 20) if image.name == last else 1
    place = np.unravel_index(np.argmax(ndimage.uniform_filter(small, width, mode="wrap")), small.shape)
    step = 2 ** (max(int(key.split("/")[1]) for key in image.sizes))
    x, y = (int(index) * step // pyramid.TILE for index in place)
    line = image.path(f"{image.name}/0/{x}/{y}").read_bytes()
    i, j = pyramid.highest(line, min(pyramid.TILE, columns - y * pyramid.TILE))
    return [x * pyramid.TILE + i, y * pyramid.TILE + j]


def _where(embedded: dict[str, list], outside: bool, tiles: bool) -> dict[str, str]:
    """Two texts of the page, about which points it shows: as it was written, and alone, without the folder of tiles."""
    if not outside:
        return {"tells": "Every point of every field is in this page.", "alone": ""}
    coarse = min((int(key.split("/")[1]) for key in embedded if "/0/" not in key), default=0)
    every = f"every {2**coarse}{'nd' if coarse % 4 == 1 else 'th'} point"
    part = f"in the page is {every}, and every point around the most loaded part"
    again = f"pgfmd plot overview without --no-tiles writes all into a folder {FOLDER}"
    return {
        "tells": f"Every point of every field is here, the finest in the folder {FOLDER} beside the page."
        if tiles else f"Of these fields, {part}; {again}.",
        "alone": f"The folder {FOLDER} is not beside the page: {part}.",
    }  # fmt: skip


def _colours(name: str) -> str:
    """256 colours, six hexadecimal digits each, without ends that look like the background or black."""
    ends = {"gray": (0.12, 0.98), "inferno": (0.12, 0.97), "viridis": (0.0, 0.97), "cividis": (0.0, 1.0)}
    colours = matplotlib.colormaps[name](np.linspace(*ends[name], 256))[:, :3]
    return np.rint(255 * colours).astype(np.uint8).tobytes().hex()


def _subtitle(load: Load) -> str:
    (nx, ny), (lx, ly), unit = load.results.shape, load.results.lengths, load.unit("length")
    surface, wall = load.job["surface"], load.law
    size = f"{lx:g} × {ly:g} {unit}".strip()
    rough = ", ".join(f"{symbol} = {surface[key]:g}" for key, symbol in
                      (("hurst", "H"), ("lambda_s", "λₛ/a"), ("rms_slope", "rms slope"), ("seed", "seed"))
                      if isinstance(surface.get(key), int | float))  # fmt: skip
    kind = printable(str(surface.get("kind", "")), 40)
    rough, modulus = f" ({rough})" if rough else "", f"{load.modulus:g} {load.unit('pressure')}".strip()
    place = f"patch {size} with an open border" if load.open else f"cell {size}"
    return f"{nx} × {ny} points, {place}; {kind} surface{rough}; {wall} wall; E′ = {modulus}"


def _name(load: Load) -> str:
    """A load in the list to choose from."""
    unit = load.unit("pressure")
    area = f", area {load.area:.3g}" if math.isfinite(load.area) else ""
    return f"{load.index}: p̄ = {load.mean_pressure:.3g}{f' {unit}' if unit else ''}{area}"


def _facts(load: Load) -> list[list[str]]:
    about = load.results.provenance
    facts = {
        "folder": str(load.results.directory), "status": load.results.status, "command": about["command"],
        "version": f"pgfmd {about['softwareVersion']}, commit {about['commit']}",
        "started": f"{about['date']}, {counted(about['ranks'], 'rank')} × {counted(about['threads'], 'thread')}",
        "libraries": ", ".join(str(about["libraries"]).split("\n")),
    }  # fmt: skip
    return [[name, printable(str(text), 1000)] for name, text in facts.items()]


def printable_lines(text: str) -> str:
    """A text of several lines without control characters."""
    return "\n".join(printable(line, 1000) for line in text.splitlines())
