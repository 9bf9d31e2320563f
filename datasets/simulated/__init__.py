"""The simulator: from a scenario and a seed to a log with its truth.

`scenario` and `specs` are what a scenario file may state. `missions` and `recorded_path` make the path, `motion` its
exact derivatives, `sea` and `seabed` its surroundings. `imu` (grades in `imu_grades`), `janus` (the DVL) and `readings`
are the sensors, `faults` what goes wrong with them. Every cause of randomness has its own `random_streams`, so that
dropping one sensor or fault changes no other. `simulator` puts them together.
"""
