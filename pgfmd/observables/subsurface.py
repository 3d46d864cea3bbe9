"""The elastic stress below the surface: von Mises' equivalent stress over depth, and where it is largest."""

import math
from dataclasses import dataclass

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.cell import Cell
from pgfmd.grid.grid_cost import Cost
from pgfmd.observables.contact import Contact
from pgfmd.observables.observable import Observable
from pgfmd.observables.schema import TABLE, Dataset, Groups
from pgfmd.options.rules import many, number
from pgfmd.options.section import key
from pgfmd.physics.laws.law import ContactLaw
from pgfmd.physics.solids.solid import Solid

DEPTHS, DEEPEST = 12, 4  # depths if none are given: from half a pixel to the longer side of the cell over DEEPEST


@dataclass(frozen=True, kw_only=True)
class Subsurface(Observable):
    """Stress in a half-space under the contact pressure, without friction, from the pressure's modes.

    A mode p̃(q) of the pressure gives at the depth z, with c = q/|q| (Johnson, Contact Mechanics, 1985, chapter 13)

        σ_zz = −p̃ (1 + qz) e^(−qz),                          σ_xz = i q_x z p̃ e^(−qz),
        σ_xx = −p̃ (c_x²(1 − qz) + 2ν c_y²) e^(−qz),           σ_xy = −p̃ c_x c_y (1 − qz − 2ν) e^(−qz),

    and the mean, whose lateral strain the periodic cell forbids, σ_xx = σ_yy = −ν/(1 − ν) p̄.
    """

    name = "subsurface"
    fields = ("von_mises",)
    needs_period = "from the modes of the cell"
    layout = {
        TABLE: {
            "von_mises_max": Dataset("{pressure}", "largest von Mises stress, interpolated between depths"),
            "von_mises_depth": Dataset("{length}", "its depth; both from a parabola through three depths"),
        },
        "subsurface": {
            "depth": Dataset("{length}", "depth below the surface", ("depth",)),
            "von_mises_max": Dataset("{pressure}", "largest von Mises stress at that depth", ("depth",)),
            "von_mises_rms": Dataset("{pressure}", "its rms value at that depth", ("depth",)),
            "row": Dataset("1", "row of the point where it is largest", ("depth",)),
            "column": Dataset("1", "column of that point", ("depth",)),
        },
    }

    depths: tuple[float, ...] = key(
        many(number(low=0)), (),
        f"below the surface; if none, {DEPTHS} from half a pixel to the longer side over {DEEPEST}", unit="length",
        example=[0.5, 1.0, 2.0],
    )  # fmt: skip

    def cost(self, cell: Cell, cutoff: float | None) -> Cost:
        """Five components at each depth, half a transform each, and factors; spectrum, sum of squares, slice."""
        return Cost(transforms=0.5 + 5.5 * (len(self.depths) or DEPTHS), memory=32.0)

    def check_contact(self, solid: Solid, law: ContactLaw) -> None:
        """Raises InputError without Poisson's ratio, and for what is no half-space."""
        if solid.poisson is None:
            raise InputError("output.subsurface: stresses depend on Poisson's ratio: give solid.poisson")
        if not math.isinf(getattr(solid, "thickness", 0.0)):
            raise InputError("output.subsurface: stresses in a half-space only, not in a slab or a layered solid")

    def measure(self, contact: Contact) -> Groups:
        """The profile over depth.  Collective."""
        grid, found = contact.grid, []
        depths = np.unique(self.depths) if self.depths else np.geomspace(
            min(grid.spacing) / 2, max(grid.lengths) / DEEPEST, DEPTHS
        )  # fmt: skip
        spectrum, peak = grid.forward(contact.pressure), -1.0
        for depth in depths:
            square = self._square(contact, spectrum, float(depth))
            largest = grid.reduction.max(square)
            place = int(np.argmax(square)) if square.max() == largest else square.size
            index = grid.comm.allgather(place + grid.rows.start * grid.shape[1] if place < square.size else grid.size)
            row, column = divmod(min(index), grid.shape[1])
            found.append((depth, math.sqrt(largest), math.sqrt(grid.reduction.sum(square) / grid.size), row, column))
            if largest > peak and "von_mises" in contact.surface.fields:
                contact.keep("von_mises", np.sqrt(square))
            peak = max(peak, largest)
        profile = dict(zip(self.layout["subsurface"], map(np.array, zip(*found, strict=True)), strict=True))
        at, value = _summit(profile["depth"], profile["von_mises_max"])
        return {TABLE: {"von_mises_max": np.array(value), "von_mises_depth": np.array(at)}, "subsurface": profile}

    @staticmethod
    def _square(contact: Contact, spectrum: np.ndarray, depth: float) -> np.ndarray:
        """¾(σ_xx − σ_yy)² + (σ_zz − ½(σ_xx + σ_yy))² + 3(σ_xy² + σ_xz² + σ_yz²), von Mises' stress squared, at a
        depth.  Collective.
        """
        grid, nu = contact.grid, float(contact.problem.solid.poisson or 0.0)
        qx, qy = grid.qx.copy(), grid.qy.copy()
        for q, count, length in zip((qx, qy), grid.shape, grid.lengths, strict=True):
            q[np.isclose(2 * abs(q), 2 * math.pi * count / length, atol=0)] = 0  # waves of two points: no shear
        total = np.zeros(grid.local_shape)

        def component(which: int, weight: float) -> None:
            def act(block: np.ndarray, first: int, stop: int) -> None:
                y = qy[first:stop]
                q = np.sqrt(grid.q_squared(first, stop))
                unit, qz = np.where(q > 0, q, 1.0), q * depth
                bent = 1 - qz - 2 * nu
                factor = (
                    lambda: -bent * ((grid.qx / unit) ** 2 - (grid.qy[first:stop] / unit) ** 2),
                    lambda: np.where(q > 0, nu - 0.5 - 1.5 * qz, -(1 - 2 * nu) / (1 - nu)),
                    lambda: -bent * (qx / unit) * (y / unit),
                    lambda: 1j * depth * qx,
                    lambda: 1j * depth * y,
                )[which]()
                np.multiply(spectrum[first:stop], factor * np.exp(-qz) / grid.size, out=block)

            def drain(first: int, stop: int, rows: np.ndarray) -> None:
                total[first:stop] += weight * rows**2

            grid.make_field(act, drain)

        for which, weight in enumerate((0.75, 1.0, 3.0, 3.0, 3.0)):
            component(which, weight)
        return total


def _summit(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Place and value of the largest y, of a parabola through three points; the point itself at an end, or where
    x hardly differs.
    """
    k = int(np.argmax(y))
    if not 0 < k < len(x) - 1 or not y[k] > 0 or not x[k - 1] < x[k] < x[k + 1]:
        return float(x[k]), float(y[k])
    width, height = x[k + 1] - x[k - 1], y[k]  # units in which squares of any lengths and pressures are numbers
    a, b, c = np.polyfit((x[k - 1 : k + 2] - x[k]) / width, y[k - 1 : k + 2] / height, 2)
    apex = (x[k] - b / (2 * a) * width, (c - b * b / (4 * a)) * height) if a < 0 else (x[k], y[k])
    return float(apex[0]), float(apex[1])
