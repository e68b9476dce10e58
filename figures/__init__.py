"""Figures from stored results; nothing here solves anything."""
