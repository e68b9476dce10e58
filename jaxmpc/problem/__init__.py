"""The controller's problem: structure, tuning, blocking (6.2) and the condensed form (5.8)-(5.13), (6.6)."""
