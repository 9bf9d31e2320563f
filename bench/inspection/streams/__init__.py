"""Checks of one stream by itself: rates, values, outliers, gravity, rest, noise."""
