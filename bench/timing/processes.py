"""The processes of a comparison: each times one revision, see `worker`."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..execution.child import THREAD_COUNTS
from .revision import TimingError, Tree


@dataclass(frozen=True)
class Side:
    """A tree with the folder that leads to its packages; processes of it can be started."""

    tree: Tree
    packages: Path
    inputs: Path

    def start(self) -> Worker:
        """Start a process."""
        here = Path(__file__).parent
        command = [str(self.tree.python), "-P", str(here / "worker.py")]
        command += [str(self.packages), str(here / "benchmarks.py"), str(self.inputs)]
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        environment |= dict.fromkeys(THREAD_COUNTS, "1") | {"PYTHONHASHSEED": "0"}
        return Worker(self.tree.name, command, environment)


class Worker:
    """A process that times benchmarks, see `worker`."""

    def __init__(self, name: str, command: Sequence[str], environment: Mapping[str, str]) -> None:
        self._name = name
        self._process = subprocess.Popen(
            command,
            env=dict(environment),
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is ours to handle
        )

    def send(self, **command: Any) -> None:
        """Hand over a command; the answer is there to be received."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(command) + "\n")
            self._process.stdin.flush()
        except OSError:
            return  # `receive` says so

    def receive(self) -> dict[str, Any]:
        """Return the answer to the last command.

        Raises:
            TimingError: the process has died.
        """
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise TimingError(
                f"{self._name}: its process died (exit code {self._process.wait()}); its last words are above"
            )
        return json.loads(line)

    def ask(self, **command: Any) -> dict[str, Any]:
        """Send a command and return the answer."""
        self.send(**command)
        return self.receive()

    def close(self) -> None:
        """End the process, whatever it is doing."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            try:
                pipe.close()
            except BrokenPipeError:
                continue


@contextmanager
def started(*sides: Side) -> Iterator[list[Worker]]:
    """Start a process of each side; they are gone afterwards."""
    workers: list[Worker] = []
    try:
        workers += [side.start() for side in sides]
        yield workers
    finally:
        for worker in workers:
            worker.close()
