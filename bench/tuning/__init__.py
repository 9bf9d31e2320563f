"""Search noise factors on training runs, and check the best once on held-out runs."""
