"""How fast we are: budgets, benchmarks, comparison with another revision, and counts that no machine changes."""
