"""Heights of the rigid surface, one file per kind."""
