"""A child process has one thread per library, its own group, our imports, and no life without its parent."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from fathom.bench.execution.child import THREAD_COUNTS, start

ECHO = """
import os, sys

def main(connection, *arguments):
    print("noise")
    seen = {name: os.environ.get(name) for name in os.environ}
    connection.send((arguments, os.getpgid(0), seen, sys.path))
    while True:
        connection.send(connection.recv())
"""


@pytest.fixture
def echo(tmp_path: Path) -> str:
    (tmp_path / "echo.py").write_text(ECHO)
    return f"{tmp_path / 'echo.py'}:main"


def test_a_child_has_its_environment_and_answers(echo: str, capfd: pytest.CaptureFixture[str]) -> None:
    with start(echo, "a", "b", environment={"ANSWER": "42"}) as child:
        arguments, group, seen, path = child.connection.recv()
        child.connection.send("ping")
        assert child.connection.recv() == "ping"
        assert child.process.poll() is None
    assert arguments == ("a", "b")
    assert group == child.process.pid != os.getpgid(0)  # Ctrl-C does not reach it
    assert {seen[name] for name in THREAD_COUNTS} == {"1"}
    assert seen["ANSWER"] == "42"
    assert {entry or os.getcwd() for entry in sys.path} <= set(path)
    assert str(Path(echo).parent) not in path  # nor the folder of child.py: its modules would hide others
    assert child.process.returncode == -9
    captured = capfd.readouterr()
    assert captured.out == ""
    assert "noise" in captured.err


def test_a_child_imports_from_the_folders_it_is_given(tmp_path: Path) -> None:
    (tmp_path / "found_here.py").write_text("def main(connection):\n    connection.send(__file__)\n")
    with start("found_here:main", path=[str(tmp_path)]) as child:
        assert child.connection.recv() == str(tmp_path / "found_here.py")
    assert child.process.wait() is not None


def test_the_connection_closes_when_the_function_ends_or_cannot_be_found(tmp_path: Path) -> None:
    (tmp_path / "short.py").write_text("def main(connection):\n    pass\n")
    for target in (f"{tmp_path / 'short.py'}:main", "no_such_module:main"):
        with start(target) as child, pytest.raises(EOFError):
            child.connection.recv()


ORPHANED = """
import sys, time
from fathom.bench.execution.child import start

child = start(sys.argv[1])
print(child.process.pid, flush=True)
time.sleep(3600)
"""


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="the system does not list processes in /proc")
def test_a_child_ends_with_its_parent(tmp_path: Path) -> None:
    (tmp_path / "busy.py").write_text("def main(connection):\n    while True:\n        pass\n")
    command = [sys.executable, "-c", ORPHANED, f"{tmp_path / 'busy.py'}:main"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        parent.kill()
    give_up_s = time.monotonic() + 30
    while Path(f"/proc/{child}").exists() and time.monotonic() < give_up_s:
        time.sleep(0.05)
    assert not Path(f"/proc/{child}").exists()
