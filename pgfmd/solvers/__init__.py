"""Contact solvers: the hard wall (active set), the exponential wall (Newton), Green's function molecular dynamics."""
