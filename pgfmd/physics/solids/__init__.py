"""Elastic solids: the compliance of a surface to each mode of pressure.  One file each, one line each in `kinds`."""
