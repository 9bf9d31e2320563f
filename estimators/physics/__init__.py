"""The physics, once: rotations, the IMU block, measurement residuals and Jacobians, innovations."""
