"""Verdicts: how probable each hypothesis is, and what speaks against telling its name."""
