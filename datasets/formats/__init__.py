"""Readers of recordings: one file per format; each yields columns of numbers as they stand in the file."""
