"""How observables are measured: sums over distributed fields, compiled loops, averages over direction."""
