"""Fields of any size as pictures that a browser can zoom into: every 2^k-th point, in tiles of one byte per point.

Level k holds every 2^k-th point along both axes.  These are no means: each value is that of a grid point, so that one
scale of colours is right at every level, and so is the share of points in contact.  A byte is 0 where there is nothing
to show (no contact), else 1 to 255, in equal steps of the scale between the tile's own extremes: the finer the tile,
the finer the steps.  A tile is a line of JavaScript,

    pgfmd_tile("pressure.2/0/3/1", low, high, "…")          field.load/level/i/j, extremes on the scale, bytes

its bytes (along x, then y) as differences along y and then x, modulo 256, deflated (zlib), in base64.  No MPI.
"""

import base64
import json
import math
import os
import zlib
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

TILE = 1024  # points along a side of a tile; even, and large enough for 2**10 levels of halved strips
SMALLEST = 512  # points along the longer side of the last level, at most

SCALES: dict[str, Callable[[np.ndarray], np.ndarray]] = {"linear": np.asarray, "sqrt": np.sqrt, "log": np.log10}


def level_count(shape: tuple[int, int]) -> int:
    """Levels until the longer side has SMALLEST points or fewer."""
    return 1 + max(0, math.ceil(math.log2(max(shape) / SMALLEST)))


@dataclass
class Pyramid:
    """The tiles of one field, written into `folder`.

    sizes : key → bytes of its file;  small : the values of the last level
    """

    name: str
    folder: Path
    sizes: dict[str, int] = field(default_factory=dict)
    small: np.ndarray | None = None

    def path(self, key: str) -> Path:
        """The file of a tile."""
        return self.folder / f"{key.replace('/', '-')}.js"

    def at_level(self, level: int) -> list[str]:
        """The keys of a level."""
        return [key for key in self.sizes if key.startswith(f"{self.name}/{level}/")]


def write(pyramid: Pyramid, blocks: Iterable[np.ndarray], shape: tuple[int, int], scale: str, blank: bool) -> Pyramid:
    """Write all tiles of a field; returns the pyramid.

    blocks : its rows, TILE of them at a time, (≤ TILE, ny);  blank : values ≤ 0 are nothing to show
    """
    last, smallest = level_count(shape) - 1, []
    workers = min(4, len(os.sched_getaffinity(0)))
    with ThreadPoolExecutor(workers) as pool:
        for level, number, rows in strips(blocks, last):
            columns = range(0, rows.shape[1], TILE)
            names = [f"{pyramid.name}/{level}/{number}/{start // TILE}" for start in columns]
            parts = [rows[:, start : start + TILE] for start in columns]
            texts = pool.map(lambda name, part: encoded(name, part, scale, blank), names, parts)
            for name, text in zip(names, texts, strict=True):
                pyramid.sizes[name] = pyramid.path(name).write_bytes(text)
            if level == last:
                smallest.append(rows)
    pyramid.small = np.concatenate(smallest)
    return pyramid


def strips(blocks: Iterable[np.ndarray], last: int) -> Iterator[tuple[int, int, np.ndarray]]:
    """(level, number, rows) of every strip of TILE rows of every level, up to level `last`, as the blocks come."""
    waiting: list[list[np.ndarray]] = [[] for _ in range(last + 1)]
    numbers = [0] * (last + 1)

    def strip(level: int) -> tuple[int, int, np.ndarray]:
        rows, waiting[level] = np.concatenate(waiting[level]), []
        numbers[level] += 1
        return level, numbers[level] - 1, rows

    for rows in blocks:
        for level in range(last + 1):
            waiting[level].append(rows)
            if sum(map(len, waiting[level])) >= TILE:
                yield strip(level)
            rows = rows[::2, ::2].copy()  # a view would keep the whole block
    yield from (strip(level) for level in range(last + 1) if waiting[level])


def encoded(name: str, values: np.ndarray, scale: str, blank: bool) -> bytes:
    """The line of a tile."""
    codes, low, high = quantised(values, scale, blank)
    change = np.diff(np.diff(codes, axis=0, prepend=np.uint8(0)), axis=1, prepend=np.uint8(0))
    text = base64.b64encode(zlib.compress(np.ascontiguousarray(change), 4)).decode()
    return f'pgfmd_tile({json.dumps(name)},{low!r},{high!r},"{text}")\n'.encode()


def quantised(values: np.ndarray, scale: str, blank: bool) -> tuple[np.ndarray, float, float]:
    """Bytes (0: nothing, 1 … 255: from the lowest value to the highest, in equal steps of the scale), and both on the
    scale.
    """
    shown = np.isfinite(values) & (values > 0) if blank or scale == "log" else np.isfinite(values)
    if not np.any(shown):
        return np.zeros(values.shape, np.uint8), 0.0, 1.0
    scaled = SCALES[scale](np.where(shown, values if scale == "linear" else np.maximum(values, 0), 1.0))
    low, high = (float(f(scaled, where=shown, initial=start)) for f, start in ((np.min, np.inf), (np.max, -np.inf)))
    step = 254 / (high - low) if high > low else 0.0
    codes = np.where(shown, 1 + np.rint((scaled - low) * step), 0).astype(np.uint8)
    return codes, low, high


def decoded(line: bytes) -> tuple[np.ndarray, float, float]:
    """The line of a tile as the browser decodes it, without its shape: bytes (m,), low, high."""
    _, low, high, text = json.loads(line[len("pgfmd_tile") :].strip().replace(b"(", b"[").replace(b")", b"]"))
    return np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8), low, high


def highest(line: bytes, columns: int) -> tuple[int, int]:
    """Where the largest value of a tile of so many columns is."""
    codes = decoded(line)[0].reshape(-1, columns).cumsum(0, np.uint8).cumsum(1, np.uint8)
    i, j = np.unravel_index(np.argmax(codes), codes.shape)
    return int(i), int(j)
