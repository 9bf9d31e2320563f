"""Experiments: their files, plans, variants and comparisons."""
