"""What surrounds a run: ensembles, stop signals, progress, the machine, and what it will cost."""
