"""Runs: one estimator driven through one log, worker processes, sweeps, Dask, reproduction."""
