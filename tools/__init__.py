"""Figures (`pgfmd plot`), the paper, benchmarks: installed as pgfmd_tools, see README.md."""
