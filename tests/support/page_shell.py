"""Runs a page of the documentation as a person would: its files, and its commands in one shell.

A question is asked again until the answer of the page is there.
"""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from amberbox.testing.clock import wait_until
from tools.markdown import fences

MARK = "AMBERBOX_TEST_SHELL"  # in the environment of all that a shell starts, also in new sessions


class Shell:
    """A shell that runs the commands of the page in a folder."""

    def __init__(
        self, folder: Path, environment: Mapping[str, str], functions: Mapping[str, str]
    ) -> None:
        self.folder = folder
        self.count = 0
        self.process = subprocess.Popen(
            ["/bin/bash", "--noprofile", "--norc"], cwd=folder, text=True,
            env={**environment, MARK: str(folder)},
            stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            start_new_session=True,
        )  # fmt: skip
        for name, command in functions.items():
            self._write(f"{name}() {{ {command}; }}\n")

    def run(self, command: str) -> tuple[int, str]:
        """Run a command line; return its exit status and what it printed."""
        self.count += 1
        output = self.folder / f"output-{self.count}"
        status = self.folder / f"status-{self.count}"
        self._write(f"{{ {command}\n}} > {output} 2>&1\necho $? > {status}.part\n")
        self._write(f"mv {status}.part {status}\n")
        wait_until(status.exists, command)
        return int(status.read_text()), output.read_text(errors="replace")

    def _write(self, text: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(text)
        self.process.stdin.flush()


@contextmanager
def shell(
    folder: Path, environment: Mapping[str, str], functions: Mapping[str, str]
) -> Iterator[Shell]:
    """Run a shell that knows these functions; it ends with all that it has started."""
    running = Shell(folder, environment, functions)
    try:
        yield running
    finally:
        os.killpg(running.process.pid, signal.SIGKILL)
        running.process.wait()
        wait_until(lambda: not _end_started(folder), "the end of all that the shell has started")


def _end_started(folder: Path) -> bool:
    """Kill what a shell has started; return whether any of it still runs."""
    mark = f"{MARK}={folder}".encode()
    is_running = False
    for place in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has ended, or is of another user
            if mark in (place / "environ").read_bytes().split(b"\0"):
                is_running = True
                os.kill(int(place.name), signal.SIGKILL)
    return is_running


def commands(text: str) -> list[tuple[str, list[str]]]:
    """Return each command of a console block with the lines that the page shows of its output."""
    found: list[tuple[str, list[str]]] = []
    for line in text.splitlines():
        if line.startswith("$ "):
            found.append((line[2:], []))
        else:
            found[-1][1].append(" ".join(line.split()))
    return found


def ask(at: Shell, command: str, shown: Sequence[str], questions: tuple[str, ...]) -> None:
    """Run a command; one that begins like a question until it is answered as on the page."""
    printed = ""

    def is_answered() -> bool:
        nonlocal printed
        status, printed = at.run(command)
        if not command.startswith(questions):
            assert status == 0, f"{command}\n{printed}"
        one_line = " ".join(printed.split())
        return all(line in one_line for line in shown)

    if command.startswith(questions):
        try:
            wait_until(is_answered, command)
        except TimeoutError as error:
            raise AssertionError(f"{command}\n{printed}") from error
    else:
        assert is_answered(), f"{command}\n{printed}"


def run_page(text: str, at: Shell, questions: tuple[str, ...]) -> list[str]:
    """Write the files of a page, and run its commands; return the commands."""
    ran = []
    for fence in fences(text):
        kind, _, name = fence.info.partition(" ")
        if kind == "console":
            for command, shown in commands(fence.text):
                ask(at, command, shown, questions)
                ran.append(command)
            continue
        assert name, f"line {fence.line}: the block names no file"
        path = at.folder / name.removeprefix(">> ")
        path.parent.mkdir(parents=True, exist_ok=True)
        before = path.read_text(encoding="utf-8") if name.startswith(">> ") else ""
        path.write_text(before + fence.text, encoding="utf-8")
    return ran
