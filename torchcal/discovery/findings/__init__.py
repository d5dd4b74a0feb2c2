"""Findings: what a diagnosis tells, as records, tables, words and experiments."""
