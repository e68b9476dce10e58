"""Stores of results and what they say about themselves."""
