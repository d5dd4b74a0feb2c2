"""Ignition of methane in air: a one-step mechanism calibrated against GRI-Mech 3.0."""
