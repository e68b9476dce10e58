"""Figures of sweep studies."""
