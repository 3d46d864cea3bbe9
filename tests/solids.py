"""Solids of the tests, in short."""

from __future__ import annotations

import math

from pgfmd.physics.solids.homogeneous import Homogeneous


def elastic(
    contact_modulus: float, thickness: float = math.inf, base: str = "bonded", poisson: float = 0.25
) -> Homogeneous:
    """A half-space, or a slab, of that contact modulus."""
    return Homogeneous(contact_modulus=contact_modulus, thickness=thickness, base=base, poisson=poisson)
