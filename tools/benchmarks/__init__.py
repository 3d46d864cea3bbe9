"""Parts of tools/benchmark.py: cases, methods, one timed run, pictures and tables."""
