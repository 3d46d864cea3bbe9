"""The bearing area: where the rigid surface alone rises above a height, chosen to give the solid's contact area."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pgfmd.grid.cell import Cell
from pgfmd.grid.cost import Cost
from pgfmd.observables.acf import acf_layout
from pgfmd.observables.contact_patches import SHAPES, ContactPatches
from pgfmd.observables.observable import Observable, spectrum_layout
from pgfmd.observables.schema import Dataset, Groups

if TYPE_CHECKING:
    from pgfmd.observables.measured_contact import MeasuredContact


@dataclass(frozen=True, kw_only=True)
class Bearing(Observable):
    """The bearing area: the highest points of the surface, as many as are in contact, and the height above which they
    lie.  Its spectrum, autocorrelations and patches are measured if the job asks for the observables "spectra", "acf"
    and "patches".
    """

    name = "bearing"
    where = "output.bearing"
    layout = {
        "bearing": {"threshold": Dataset("{length}", "height above which the surface has the relative area f_c")},
        "bearing_spectrum": spectrum_layout("1", "|Θ̃|² of the bearing area (1 above the threshold, 0 below)"),
        **acf_layout("bearing", "1", "autocorrelation of the bearing area"),
        "bearing_patches": SHAPES,
    }

    def cost(self, cell: Cell, cutoff: float | None) -> Cost:
        """A transform, if spectra or autocorrelations are asked for, and a mask with its runs."""
        return Cost(transforms=1.0, memory=2.0)

    def measure(self, contact: MeasuredContact) -> Groups:
        """Four passes over the heights for the threshold.  Collective."""
        from pgfmd.observables.patches.labelling import label_patches
        from pgfmd.observables.statistics.correlations import indicator
        from pgfmd.observables.statistics.threshold import threshold_for_count

        surface, heights, groups = contact.surface, contact.surface.heights, dict[str, Mapping[str, np.ndarray]]()
        threshold = threshold_for_count(contact.grid, heights, contact.area.pixels)
        if {"spectra", "acf"} & contact.asked.keys():
            found = surface.correlate(indicator(heights, threshold))
            if "spectra" in contact.asked:
                groups["bearing_spectrum"] = surface.modes.means(found.power, "q")
            groups |= surface.acf_groups("bearing", found)
        patches = contact.asked.get("patches")
        if isinstance(patches, ContactPatches):
            labels = label_patches(contact.grid.comm, heights > threshold, contact.grid.starts, patches.connectivity)
            groups["bearing_patches"] = contact.patches(labels, None)
        return {"bearing": {"threshold": np.array(threshold)}, **groups}
