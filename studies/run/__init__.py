"""Runs studies: chunks, executors, progress."""
