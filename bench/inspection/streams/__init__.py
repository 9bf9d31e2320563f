"""What is looked at in one stream alone."""
