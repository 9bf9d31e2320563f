"""From a log.yaml and files to a `Log`.

`description` holds the models of log.yaml, `conversion` turns rows into our frames and units, `opening` finds a log by
name or folder, and `folder` writes a log as a described folder. `geodesy` and `device_clock` are their arithmetic.
"""
