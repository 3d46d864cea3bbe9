"""Ranks and threads: reductions, errors raised on all ranks together, slabs of rows, the threads of a rank."""
