"""Hypotheses: the base with terms that might have been left out, screened and refitted."""
