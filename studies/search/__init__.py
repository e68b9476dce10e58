"""Searches for tunings."""
