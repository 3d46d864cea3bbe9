"""The hard wall: a primal–dual active set under nested iteration."""
