"""The simulator: scenarios, missions, sensors and faults, and the random streams that they draw from."""
