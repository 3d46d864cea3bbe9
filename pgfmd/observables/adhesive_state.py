"""What is said of a contact under a wall that attracts: its energy, its branch, and how sure it is a minimum."""

from dataclasses import dataclass

import numpy as np

from pgfmd.errors import InputError
from pgfmd.observables.contact import Contact
from pgfmd.observables.observable import Observable
from pgfmd.observables.schema import Dataset, Groups
from pgfmd.options.text import show
from pgfmd.physics.laws.law import ContactLaw
from pgfmd.physics.solids.solid import Solid

COLUMNS = {
    "energy": Dataset("{pressure}*{length}", "elastic_energy and that of the attraction, per area of the cell"),
    "energy_drop": Dataset("{pressure}*{length}", "energy per area lost in jumps since the last load"),
    "jump_from": Dataset("as asked", "last target of the branch before it jumped to this one; NaN: it did not"),
    "jump_to": Dataset("as asked", "first target after the jump"),
    "pressure_before_jump": Dataset("{pressure}", "mean pressure there, before it jumped"),
    "pressure_after_jump": Dataset("{pressure}", "mean pressure after the jump"),
    "branch": Dataset("1", "reached from: 0 the undeformed solid, 1 the last load, 2 longer ranges (a probe)"),
    "tensile_pressure": Dataset("{pressure}", "mean over the cell of the pressure where it is negative"),
    "tensile_area": Dataset("1", "part of the cell that touches under tension"),
    "residual": Dataset("{pressure}", "rms force that is not balanced"),
    "least_curvature": Dataset("1", "estimate of the least curvature of the energy over that of the solid; ≤ 0: none"),
    "gap_bound": Dataset("{length}", "bound on the distance of each gap from the local minimum, as sure as `bound`"),
    "bound": Dataset("1", "certified error: 0 none, 1 estimated, 2 proved of the global minimum, 3 of the local one"),
    "stickiness": Dataset("1", "criterion of Pastewka and Robbins: rough surfaces stick where it is below about 1"),
    "newton_steps": Dataset("1", "steps of the solver along this load"),
    "trials_refused": Dataset("1", "shorter steps that these took, as the energy did not fall along longer ones"),
    "inner_applications": Dataset("1", "stiffness or compliance applied in single precision"),
}


@dataclass(frozen=True, kw_only=True)
class Adhesion(Observable):
    """Energy, branch, jumps and stability of a contact under a wall that attracts; measured there in every run."""

    name = "adhesion"
    layout = {"loads": COLUMNS}

    def check_contact(self, solid: Solid, law: ContactLaw) -> None:
        """Walls that attract only."""
        if law.convex:
            raise InputError(f"output.adhesion: wall.kind = {show(law.kind)} does not attract")

    def measure(self, contact: Contact) -> Groups:
        """As the solver counted."""
        details = contact.details
        return {"loads": {name: np.array(details[name]) for name in COLUMNS}}
