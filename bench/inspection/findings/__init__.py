"""The result of a check: measured facts, findings with their fix, and a panel for the page."""
