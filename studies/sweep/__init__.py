"""Sweep studies: many tunings, wells and references from one definition, in one store."""
