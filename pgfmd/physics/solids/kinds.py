"""The solids that a job can ask for: one line each."""

from __future__ import annotations

from pgfmd.options.section import Kinds
from pgfmd.physics.solids.homogeneous import Homogeneous

SOLIDS = Kinds(
    "solid",
    (
        Homogeneous,
    ),
    default=Homogeneous,
)  # fmt: skip
