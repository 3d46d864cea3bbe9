"""Parts of tools/bench/benchmark.py: cases, methods, one timed run, pictures and tables."""
