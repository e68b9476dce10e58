"""Steady states: the map and the real-time optimiser (6.19)."""
