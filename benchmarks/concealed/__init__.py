"""Concealed effects: recordings whose missing physics is hidden by calibration and by noise, and who finds it."""
