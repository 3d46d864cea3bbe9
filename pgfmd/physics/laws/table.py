"""The contact laws that a job can ask for: one line each."""

from __future__ import annotations

from pgfmd.options.section import Kinds
from pgfmd.physics.laws.exponential import ExponentialWall
from pgfmd.physics.laws.hard import HardWall

LAWS = Kinds(
    "wall",
    (
        HardWall,
        ExponentialWall,
    ),
    default=HardWall,
)
