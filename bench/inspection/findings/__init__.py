"""What a check hands over: facts, findings with their remedy, and a panel for the page."""
