"""Contact laws: the relation between pressure and gap at a point.  One file each, one line each in `table`."""
