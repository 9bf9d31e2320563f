"""From a log.yaml to a Log: the description, the conversion to our frames and units, and opening by name."""
