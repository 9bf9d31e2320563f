"""How fast fathom is: budgets, comparison with another revision, profiles, costs, and counts of work."""
