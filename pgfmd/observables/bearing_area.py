"""The bearing area: where the rigid surface alone rises above a height, chosen to give the solid's contact area."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pgfmd.grid.grid_cost import Cost
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.contact import Contact
from pgfmd.observables.contact_patches import SHAPES, ContactPatches
from pgfmd.observables.observable import Observable, spectrum_layout
from pgfmd.observables.patch_table import label_patches
from pgfmd.observables.rough_surface import indicator
from pgfmd.observables.schema import Dataset, Groups
from pgfmd.observables.spectra import acf_layout
from pgfmd.parallel.compiled import compiled
from pgfmd.parallel.mpi import MPI


@dataclass(frozen=True, kw_only=True)
class Bearing(Observable):
    """The bearing area: the highest points of the surface, as many as are in contact, and the height above which they
    lie.  Its spectrum, autocorrelations and patches are measured if the job asks for "spectra", "acf" and "patches".
    """

    name = "bearing"
    usual_cost = Cost(transforms=1.0, memory=2.0)  # if spectra are asked for; a mask with its runs
    needs_double = True  # heights are sorted by the bits of their numbers
    layout = {
        "bearing": {"threshold": Dataset("{length}", "height above which the surface has the relative area f_c")},
        "bearing_spectrum": spectrum_layout("1", "|Θ̃|² of the bearing area (1 above the threshold, 0 below)"),
        **acf_layout("bearing", "1", "autocorrelation of the bearing area"),
        "bearing_patches": SHAPES,
    }

    def measure(self, contact: Contact) -> Groups:
        """Four passes over the heights for the threshold.  Collective."""
        surface, heights, groups = contact.surface, contact.surface.heights, dict[str, Mapping[str, np.ndarray]]()
        threshold = threshold_for_count(contact.grid, heights, contact.area.pixels)
        if {"spectra", "acf"} & contact.surface.asked.keys():
            found = surface.correlate(indicator(heights, threshold))
            if "spectra" in contact.surface.asked:
                groups["bearing_spectrum"] = surface.modes.means(found.power, "q")
            groups |= surface.acf_groups("bearing", found)
        patches = contact.surface.asked.get("patches")
        if isinstance(patches, ContactPatches):
            grid = contact.grid
            above = heights > threshold
            labels = label_patches(grid.comm, above, grid.starts, patches.connectivity, grid.domain.wraps)
            groups["bearing_patches"] = contact.patches(labels, None)
        return {"bearing": {"threshold": np.array(threshold)}, **groups}


@compiled(fastmath={"contract", "nsz"})
def count_digits(field: np.ndarray, prefix: np.uint64, shift: int, first: int, stop: int, counts: np.ndarray) -> None:
    """counts[(key >> shift) & 0xFFFF] += 1 for the keys with key >> shift >> 16 == prefix, of rows first … stop−1.

    field: float64 numbers, viewed as int64.  The keys of numbers are unsigned integers in their order.
    """
    for i in range(first, stop):
        for j in range(field.shape[1]):
            bits = field[i, j]
            key = np.uint64(bits) ^ np.uint64(0x8000000000000000) if bits >= 0 else ~np.uint64(bits)
            high = key >> np.uint64(shift)
            if shift == 48 or (high >> np.uint64(16)) == prefix:
                counts[high & np.uint64(0xFFFF)] += 1


DIGIT = 16  # bits of t that one pass over the field fixes


def threshold_for_count(grid: SlabGrid, heights: np.ndarray, count: int) -> float:
    """The height t above which exactly `count` points of the distributed field (nx_local, ny) lie: h > t.  Collective.

    t is the largest height that is not among them; if all heights are, t lies just below the lowest.  Where heights are
    equal, no such t may exist; then fewer points lie above.  Radix selection: four passes each fix 16 bits of t by
    counting; nothing is sorted, and no message has the size of the field.  Raises ValueError if 0 ≤ count ≤ N fails.
    """
    if not 0 <= count <= grid.size:
        raise ValueError(f"{count} of {grid.size} points")
    if count == grid.size:
        return float(np.nextafter(grid.reduction.min(heights), -np.inf))
    place = grid.size - count - 1  # of the threshold among the heights in rising order, from 0
    prefix = 0
    bits = heights.view(np.int64)
    for shift in range(64 - DIGIT, -1, -DIGIT):
        below = _count_up_to(grid, bits, prefix, shift)
        digit = int(np.searchsorted(below, place, side="right"))
        place -= int(below[digit - 1]) if digit else 0
        del below  # half a megabyte, before the next is made
        prefix = prefix << DIGIT | digit
    found = prefix ^ (1 << 63) if prefix >> 63 else ~prefix & (1 << 64) - 1
    return float(np.array(found, np.uint64).view(np.float64))


def _count_up_to(grid: SlabGrid, bits: np.ndarray, prefix: int, shift: int) -> np.ndarray:
    """Heights whose keys (`count_digits`) begin with `prefix`, then at most each digit: (2^16,).  Collective."""
    parts = []

    def part(first: int, stop: int) -> None:
        counts = np.zeros(1 << DIGIT, np.int64)
        count_digits(bits, np.uint64(prefix), shift, first, stop, counts)
        parts.append(counts)

    grid.threads.split(part, len(bits))
    total = parts.pop()  # every rank of a grid has rows
    while parts:
        total += parts.pop()
    grid.comm.Allreduce(MPI.IN_PLACE, total)
    return np.cumsum(total, out=total)
