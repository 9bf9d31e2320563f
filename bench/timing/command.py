"""What `fathom timing` prints: budgets, a comparison with another revision, counts."""

from __future__ import annotations
