"""Elastic solids: the compliance of a surface to each mode of pressure.  Their list is `kinds`."""
