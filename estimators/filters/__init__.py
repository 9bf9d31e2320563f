"""Kalman filters: eskf, eskf-filterpy, iekf, ukf, and the rts smoother on top of one of them."""
