"""Theory to draw beside a simulation: NumPy and SciPy only, plain numbers in, arrays out, any consistent units.

- `surface`: the ideal self-affine spectrum in the continuum, spectral moments
- `persson`: pressure distribution, contact area, stress spectrum, energy and mean gap
- `asperity`: Greenwood–Williamson and Bush–Gibson–Thomas
- `bearing`: contact by cutting a Gaussian surface at a height
- `exponential`: linear response of an exponential wall
- `hertz`: one parabolic asperity, free and on a periodic cell
- `adhesion`: one adhesive paraboloid (JKR, DMT, Maugis), and whether a rough surface adheres
- `exact`: exact solutions of periodic contact (Westergaard, strip punch); limits and a table for the 2-D sinusoid
- `lattice_edge`: the edge of a contact between the points of a grid
- `reference_set`: numbers of self-affine contacts with their errors

A spectrum has the form of the result files: wave numbers q (m,), ascending; `power` (m,), the mean |h̃|² of a mode at q
(h̃ the Fourier coefficient: a sum over all modes is a mean over the surface); `count` (m,), the number of modes at q.
"""

import importlib
from types import ModuleType
from typing import Any, TypeAlias

Reals: TypeAlias = Any
"""A float or an array; several arguments broadcast against each other."""

__all__ = ["adhesion", "asperity", "bearing", "exact", "exponential", "hertz", "lattice_edge", "persson"]
__all__ += ["reference_set", "surface"]


def __getattr__(name: str) -> ModuleType:
    """A module, imported when first used: SciPy's optimisers, which a run does not need, take long."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return importlib.import_module(f"{__name__}.{name}")
