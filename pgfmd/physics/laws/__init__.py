"""Contact laws: the relation between pressure and gap at a point.  Their list is `table`."""
