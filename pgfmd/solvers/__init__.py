"""Contact solvers: hard walls (active set), others that repel (Newton), walls that attract, damped dynamics."""
