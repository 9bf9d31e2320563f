"""The result of a check: measured facts with their uncertainty, findings with their fix, and a panel for the page."""
