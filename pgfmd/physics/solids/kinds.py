"""The solids that a job can ask for: one import and one name each."""

from __future__ import annotations

from pgfmd.options.section import Kinds
from pgfmd.physics.solids.graded import Graded
from pgfmd.physics.solids.homogeneous import Homogeneous
from pgfmd.physics.solids.layered import Layered

SOLIDS = Kinds("solid", (Homogeneous, Layered, Graded), default=Homogeneous)
