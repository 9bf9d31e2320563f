"""Search noise factors on training runs, and look once at what was held out."""
