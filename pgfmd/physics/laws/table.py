"""The contact laws that a job can ask for: one import and one name each."""

from __future__ import annotations

from pgfmd.options.section import Kinds
from pgfmd.physics.laws.adhesive_laws import AdhesiveWall, Dugdale, Potential
from pgfmd.physics.laws.exponential_law import ExponentialWall
from pgfmd.physics.laws.formula import FormulaWall
from pgfmd.physics.laws.hard import Hardness, HardWall

LAWS = Kinds(
    "wall", (HardWall, ExponentialWall, Hardness, FormulaWall, AdhesiveWall, Dugdale, Potential), default=HardWall
)
