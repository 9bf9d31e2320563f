"""What a log says about itself: rates, norms, clocks, mountings; what looks wrong, and what to put into log.yaml."""
