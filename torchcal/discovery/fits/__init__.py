"""Fits: a model and a recording as a least-squares problem, and its solution."""
