"""The exceptions of this package that a caller might catch."""

from __future__ import annotations

from ..datasets.errors import FathomError


class ExperimentError(FathomError):
    """An experiment file cannot be used; says which file, which key, and what to write instead."""


class StoppedError(ExperimentError):
    """Runs were made, and then their results could not be kept or written; the finished ones are in the store."""
