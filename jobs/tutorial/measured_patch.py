"""A measured patch: from an instrument's file to area and gap."""

import SurfaceTopography

import pgfmd

scan = SurfaceTopography.read_topography("jobs/data/measured.sdf")
scan = scan.detrend("height")  # less the plane that fits best
for contact in pgfmd.solve(scan, [1e6, 5e6], contact_modulus=1.19e9):
    print(f"{contact.mean_pressure:.3g} Pa: area {contact.contact_area:.4f}, gap {contact.mean_gap:.4g} {scan.unit}")
