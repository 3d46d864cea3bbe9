"""Contact solvers: the hard wall (active set), the exponential wall (Newton), and Green's function molecular
dynamics.
"""
