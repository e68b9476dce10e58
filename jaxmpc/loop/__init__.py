"""Closed loops (thesis chapter 7): inputs, compiled and host loops, trajectories."""
