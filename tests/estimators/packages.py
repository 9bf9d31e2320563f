"""Other people's packages, for tests: written to a folder as pip leaves them, and what may be in them."""

from __future__ import annotations

from pathlib import Path
from textwrap import indent

IDLER = '''
import os, signal, sys, threading, time, warnings
from dataclasses import dataclass
import numpy as np
from fathom.datasets import Belief
from fathom.estimators import FACTORS

@dataclass(frozen=True)
class Idler:
    """Stays where it is; in its steps it does what `kind` says."""

    kind: str = "none"
    factors: frozenset[str] = FACTORS

    def begin(self, prior, rig):
        return Pass(self.kind, prior)

class Pass:
    def __init__(self, kind, prior):
        self.kind, self.prior, self.t_ns, self.counts, self.steps = kind, prior, prior.t_ns, {}, 0

    def step(self, epoch):
        self.t_ns, self.steps = epoch.t_ns, self.steps + 1
STEP
    def belief(self):
        return Belief(self.t_ns, self.prior.state, self.prior.P)

    def finish(self):
        return None
'''


def idler(step: str) -> str:
    """Return the source of an estimator `Idler` that ends its steps with these statements, of self.kind and .steps."""
    return IDLER.replace("STEP", indent(step, 8 * " "))


def distribution(folder: Path, name: str, points: str, **modules: str) -> None:
    """Write a package: modules, and the metadata beside them."""
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(points)
    for module, text in modules.items():
        (folder / f"{module}.py").write_text(text)
