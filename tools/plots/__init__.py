"""Figures of result folders (`pgfmd plot`), installed as pgfmd_plots."""
