"""Figures of the thesis and of comparisons."""
