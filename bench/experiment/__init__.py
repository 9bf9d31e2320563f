"""What is asked: an experiment file, its variants, and which results are compared."""
