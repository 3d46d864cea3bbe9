"""Contact laws: what a point of the wall answers to the gap above it.  One file each, one line each in `table`."""
