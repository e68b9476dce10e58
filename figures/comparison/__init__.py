"""Figures of a comparison of controllers on any process."""
