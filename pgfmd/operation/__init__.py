"""What surrounds a run: stop signals, progress, the machine, and what it will cost."""
