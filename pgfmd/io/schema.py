"""The result files in one table: every dataset's name, unit and description, for writer, readers and tests.

Units are written with {length} and {pressure}, which stand for the unit names that the job gives.
"""

from __future__ import annotations

FORMAT_VERSION = 1

OBSERVABLES_FILE, FIELDS_FILE, FIELDS_FOLDER = "observables.h5", "fields.h5", "fields"
CHECKPOINT_FILE = "checkpoint.h5"  # of an unfinished load; see `checkpoint`

# One row per load, in group `loads` of observables.h5, in this order.
LOADS = {
    "mean_pressure": ("{pressure}", "mean pressure p̄"),
    "contact_area": ("1", "relative contact area f_c: fraction of grid points with pressure > 0"),
    "contact_area_corrected": ("1", "f_c without the pixel staircase, doi:10.1016/j.triboint.2017.04.023"),
    "kappa": ("1", "f_c E' g_rms / p̄"),
    "mean_gap": ("{length}", "mean gap"),
    "elastic_energy": ("{pressure}*{length}", "elastic energy per area of the cell"),
    "certified_error": ("1", "upper bound D/(2 E_el) of the relative energy error"),
    "max_violation": ("1", "largest of |gap| in contact and penetration outside, over the rms height"),
    "iterations": ("1", "iterations of the solver"),
    "transforms": ("1", "work, in forward + backward transforms of the full grid in double precision"),
    "seconds": ("s", "wall time of the relaxation"),
}

FIELDS = {
    "height": ("{length}", "heights of the rigid surface, peaks positive"),
    "pressure": ("{pressure}", "contact pressure"),
    "gap": ("{length}", "gap between solid and surface"),
    "displacement": ("{length}", "displacement of the solid's surface"),
    "labels": ("1", "number of the contact patch, counted from 1; 0: no contact"),
}

_SPECTRA = {
    "stress": ("{pressure}^2", "stress spectrum |Σ σ exp(−iq·r)|², unnormalised transform"),
    "contact": ("1", "contact spectrum |Σ Θ(σ) exp(−iq·r)|², unnormalised transform"),
    "height": ("{length}^2", "height spectrum |h̃|², h̃ the Fourier coefficient (transform over N)"),
    "cross": ("{pressure}*{length}", "cross spectrum Re h̃* σ̃ of height and stress, Fourier coefficients"),
    "bearing": ("1", "spectrum of the bearing area, as contact_spectrum"),
}
_CORRELATIONS = {
    "stress": ("{pressure}^2", "stress autocorrelation ⟨σ(r) σ(r')⟩"),
    "contact": ("1", "contact autocorrelation ⟨Θ(σ(r)) Θ(σ(r'))⟩"),
    "height": ("{length}^2", "height autocorrelation ⟨h(r) h(r')⟩"),
    "bearing": ("1", "autocorrelation of the bearing area"),
}
_PATCHES = {
    "area": ("{length}^2", "area"),
    "load": ("{pressure}*{length}^2", "load"),
    "perimeter": ("{length}", "perimeter along pixel edges"),
    "mean_pressure": ("{pressure}", "mean pressure"),
    "peak_pressure": ("{pressure}", "peak pressure"),
    "extent_x": ("{length}", "extent in x, periodic"),
    "extent_y": ("{length}", "extent in y, periodic"),
    "percolates_x": ("1", "1 if connected to its own periodic image along x"),
    "percolates_y": ("1", "1 if connected to its own periodic image along y"),
}


def _histogram(unit: str, what: str) -> dict[str, tuple[str, str]]:
    return {
        "edges": (unit, f"bin edges of {what}"),
        "density": (f"1/({unit})", f"probability density of {what}, over all points; contact points for pressures"),
        "count": ("1", "points in each bin"),
    }


# Groups of datasets of one load, in load_0000, load_0001, … of observables.h5.  Written: those asked for.
GROUPS: dict[str, dict[str, tuple[str, str]]] = {
    "pressure_histogram": _histogram("{pressure}", "the pressure"),
    "pressure_histogram_log": _histogram("{pressure}", "the pressure, bins even in its logarithm"),
    "gap_histogram": _histogram("{length}", "the gap"),
    "pressure_moments": {"order": ("1", "n of ⟨σⁿ⟩_c / σ_c^n"), "value": ("1", "moments over contact, σ_c = p̄/f_c")},
    "persson_fit": {
        "width": ("{pressure}", "s of the one-parameter form N(σ; p̄, s) − N(σ; −p̄, s) that fits best"),
        "residual": ("1", "rms deviation of the fit over the rms density"),
    },
    "bearing": {"threshold": ("{length}", "height above which the rigid surface has the same relative area f_c")},
    "lowpass_area": {
        "q": ("1/({length})", "cut-off wave number"),
        "area": ("1", "relative contact area of the surface low-passed at q, same load"),
    },
    "history": {
        "transforms": ("1", "work spent"),
        "seconds": ("s", "wall time"),
        "certified_error": ("1", "bound of the relative energy error at that point"),
    },
    "patches": _PATCHES,
    "bearing_patches": _PATCHES,
}
for _name, (_unit, _what) in _SPECTRA.items():
    GROUPS[f"{_name}_spectrum"] = {
        "q": ("1/({length})", "mean wave number of the bin, radians per length"),
        "value": (_unit, f"mean {_what}"),
        "count": ("1", "modes in the bin, Hermitian weights included"),
        "edges": ("1/({length})", "bin edges"),
    }
for _name, (_unit, _what) in _CORRELATIONS.items():
    for _suffix, _how in (("", "averaged over direction"), ("_x", "along x"), ("_y", "along y")):
        GROUPS[f"{_name}_acf{_suffix}"] = {
            "r": ("{length}", "distance"),
            "value": (_unit, f"{_what}, {_how}"),
            "count": ("1", "points in the bin"),
            "edges": ("{length}", "bin edges"),
        }

# What a unit name is in SI, for openPMD's unitSI; names not listed here are taken as arbitrary units of size 1.
SI = {
    "m": 1.0,
    "mm": 1e-3,
    "µm": 1e-6,
    "um": 1e-6,
    "nm": 1e-9,
    "Å": 1e-10,
    "Pa": 1.0,
    "kPa": 1e3,
    "MPa": 1e6,
    "GPa": 1e9,
}


def load_name(index: int) -> str:
    """Name of a load's group: load_0000, load_0001, …"""
    return f"load_{index:04d}"
