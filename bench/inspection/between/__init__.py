"""What is looked at between streams: clocks, mountings, lever arms, references."""
