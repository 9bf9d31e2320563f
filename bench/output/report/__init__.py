"""The report of an experiment: one page that needs nothing but a browser."""
