"""How long trajectories and their derivatives take, beside SciPy's solvers."""
