"""Definitions of studies: comparisons and sweeps as typed, strictly read data."""
