"""Whole moves, decided exactly (thesis 6.1): lower bounds, lists, search, HiGHS."""
