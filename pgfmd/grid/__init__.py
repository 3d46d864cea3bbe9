"""A grid in slabs of rows: its transforms, the transfer between grids, rows of neighbouring ranks."""
