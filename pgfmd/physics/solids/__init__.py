"""Elastic solids: how a surface yields to each mode of pressure.  One file each, one line each in `kinds`."""
