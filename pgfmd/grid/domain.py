"""The domain: where the loaded points lie, and on which torus the transforms run.

All that differs between a periodic cell and a patch with open boundaries is asked here.  Only the points of the grid
may bear pressure.  The torus may have more: there pressure is 0, and no field is stored.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Shape = tuple[int, int]
Rectangle = tuple[tuple[int, int], tuple[int, int]]
"""The points (first, stop) along x and along y."""


@dataclass(frozen=True)
class Domain:
    """The periodic cell: the torus is the cell, fields wrap, and every second point is one of the coarser grid.

    name: in [grid] boundary;  wraps: whether the neighbours of a border are the points at the opposite one.  If not,
    fields end there: sets, patches and contact lines do not reach beyond, and the field ε of the certificate is 0.
    """

    name: str = "periodic"
    wraps: bool = True

    def torus(self, shape: Shape, spacing: tuple[float, float]) -> Shape:
        """Modes of the transforms along x and y, for points of that spacing."""
        return shape

    def indices(self, places: np.ndarray, count: int) -> np.ndarray:
        """The points that continue a field of `count` points at `places`, which may lie beyond its border."""
        return places % count

    def coarse_spacing(self, fine: int, coarse: int) -> float:
        """Spacing of a grid of `coarse` points over that of a finer one of the same domain."""
        return fine / coarse

    def first_point(self, spacing: float) -> float:
        """Place of point 0 of a coarser grid of that spacing, in points of the finer one."""
        return 0.0


@dataclass(frozen=True)
class Open(Domain):
    """A patch of a half-space or slab; no pressure acts outside.  The torus has at least twice the points each way, so
    that no point responds to an image of another (Hockney and Eastwood, Computer Simulation Using Particles, 1988,
    section 6-5-4).  A point of the coarser grid lies in the middle of 2 × 2, and fields are mirrored at the border.
    """

    name: str = "open"
    wraps: bool = False

    def torus(self, shape: Shape, spacing: tuple[float, float]) -> Shape:
        from scipy.fft import next_fast_len  # slow to import

        # Oblong pixels and few points need more, so that the short-ranged part of the kernel ends within the torus.
        least = REACH * max(spacing)
        nx, ny = (2 * next_fast_len(max(n, int(np.ceil(least / a)))) for n, a in zip(shape, spacing, strict=True))
        return nx, ny

    def indices(self, places: np.ndarray, count: int) -> np.ndarray:
        folded = places % (2 * count)
        return np.minimum(folded, 2 * count - 1 - folded)

    def coarse_spacing(self, fine: int, coarse: int) -> float:
        return 2.0

    def first_point(self, spacing: float) -> float:
        return (spacing - 1) / 2


@dataclass(frozen=True)
class Cropped(Open):
    """An open patch whose pressure lies within a rectangle, `box`; the torus holds its distances to all points."""

    box: Rectangle = ((0, 0), (0, 0))

    def torus(self, shape: Shape, spacing: tuple[float, float]) -> Shape:
        nx, ny = (min(few(max(stop, n - first)), n) for n, (first, stop) in zip(shape, self.box, strict=True))
        return super().torus((nx, ny), spacing)


def few(count: int) -> int:
    """The least of a few lengths that is at least `count`: planning transforms of a new one takes a second."""
    return min(factor << (-(-count // factor) - 1).bit_length() for factor in (8, 9, 10, 12, 14, 15))


SPLIT = 0.3  # α times the larger spacing, see `physics.solids.open_kernel`
REACH = 4 / SPLIT  # larger spacings from which erfc(α r) is below 2e-8
PERIODIC, OPEN = Domain(), Open()
DOMAINS = {domain.name: domain for domain in (PERIODIC, OPEN)}
