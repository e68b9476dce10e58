"""Compiled programs at the edge: their cache, threads, interrupts, packing."""
