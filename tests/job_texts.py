"""Jobs of tests as TOML: what they share in one place, so that a test says only what matters to it."""

from typing import Any

from pgfmd.application.job import tables_as_toml

SOLID = "[solid]\ncontact_modulus = 1\n"
EVERY_OBSERVABLE = (
    "histogram spectra acf gap_spectrum patches bearing lowpass discretisation stiffness percolation leakage subsurface"
).split()


def rough_job(n: int | list[int], surface: dict[str, Any] | None = None, **sections: dict[str, Any]) -> str:
    """A job on a self-affine surface of n points.

    surface: keys of [surface] that differ from those below;  sections: the other sections, and more keys of [grid]"""
    grid = {"n": n} | sections.pop("grid", {})
    rough = {"kind": "self-affine", "hurst": 0.8, "lambda_s": 6.0, "rms_slope": 0.1}
    solid = sections.pop("solid", {"lame_lambda": 1.0, "lame_mu": 1.0})
    return tables_as_toml({"grid": grid, "surface": rough | (surface or {}), "solid": solid, **sections})
