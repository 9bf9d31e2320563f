"""Gross faults: descriptions so wrong that whole streams contradict each other, found on a coarse grid in milliseconds.

`gross_check` is part of `fathom inspect`, and is all of the check that runs before an experiment. A right log passes
cheap tests. Where one fails, single faults are tried one by one, and the one that restores agreement is reported.
"""
