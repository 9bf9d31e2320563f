"""The start of a recorded log: attitude, position, velocity and biases from its first seconds."""
