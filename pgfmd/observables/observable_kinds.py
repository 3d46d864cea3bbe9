"""The observables that a job may ask for, in the order in which they are measured.  A new one gets a line here."""

from pgfmd.observables.adhesive_state import Adhesion
from pgfmd.observables.bearing_area import Bearing
from pgfmd.observables.contact_patches import ContactPatches
from pgfmd.observables.discretisation import Discretisation
from pgfmd.observables.gap_slope import GapSlope
from pgfmd.observables.histogram import Histogram
from pgfmd.observables.leakage import Leakage
from pgfmd.observables.lowpass import Lowpass
from pgfmd.observables.observable import OBSERVABLES, layout_of
from pgfmd.observables.partial_slip import PartialSlip
from pgfmd.observables.percolation import ClosingLoad, Percolation
from pgfmd.observables.pressure_skewness import PressureSkewness
from pgfmd.observables.schema import GroupLayout
from pgfmd.observables.spectra import Acf, GapSpectrum, Spectra
from pgfmd.observables.stiffness import Stiffness
from pgfmd.observables.subsurface import Subsurface

KINDS = (
    Histogram,
    PressureSkewness,
    Spectra,
    Acf,
    GapSpectrum,
    GapSlope,
    ContactPatches,
    Bearing,
    Lowpass,
    Discretisation,
    Stiffness,
    Percolation,
    ClosingLoad,
    Leakage,
    Subsurface,
    PartialSlip,
    Adhesion,
)
OBSERVABLES.update({kind.name: kind for kind in KINDS})

LAYOUT: GroupLayout = layout_of(OBSERVABLES.values())
"""Every group that a load may have in observables.h5, and all columns that observables add to the table of loads."""
