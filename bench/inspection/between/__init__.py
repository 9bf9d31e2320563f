"""Checks of two sensors that see the same motion: clocks, mountings, scales, lever arms, references."""
