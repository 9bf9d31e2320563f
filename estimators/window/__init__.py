"""The fixed-lag Gauss-Newton smoother on block-tridiagonal normal equations, compiled."""
