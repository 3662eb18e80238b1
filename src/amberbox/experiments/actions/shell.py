"""A program with fixed arguments, without a shell; its process group ends with the run."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from amberbox.core.errors import AmberboxError, NotStartedError
from amberbox.core.files import wait_readable
from amberbox.core.options import option
from amberbox.experiments.actions import _placeholders

if TYPE_CHECKING:  # it loads numpy, which takes longer than the rest of an actor's start
    from amberbox.core.contracts import ActionContext

SAMPLE = """\
restart_driver:
  description: Restart the driver of a laser scanner
  kind: shell
  command: [systemctl, --user, restart, "{unit}"]
  simulated: [echo, "{unit}"]
  parameters:
    unit: {choices: [laser_front.service, laser_rear.service]}
  risk: state
  timeout: 20 s
"""

OUTPUT_BYTES = 16_384  # the end of the output that is kept
_GROUP = Path(__file__).with_name("_group.py")
_INTERPRETERS = re.compile(r"(?:ba|da|z|k|fi|c|tc)?sh|busybox|python[\d.]*|perl|ruby|node|lua|awk")
_CODE = ("-c", "-e", "--eval", "--command")
_LOOK_S = 0.05
_END_BEFORE_STOP_S = 0.2
_LATE_S = 1.0  # how long the group may take to be gone after SIGKILL


@dataclass(frozen=True)
class Config:
    """Which program is started."""

    command: Sequence[str] = option(
        doc='program and its arguments; "{name}" is the value of a parameter, always one argument'
    )
    safe_stop: Sequence[str] = option((), "program that brings the robot to a safe state")
    simulated: Sequence[str] = option((), "program that is started in its place without a robot")
    environment: Mapping[str, str] = option({}, "variables that are set for the programs")
    end: float = option(0.2, "time from SIGTERM to SIGKILL when the run must end", unit="s")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield what is wrong with the values."""
        for key in ("command", "safe_stop", "simulated"):
            yield from ((key, what) for what in _unfit(getattr(self, key)))
        if not self.command:
            yield "command", "names no program"
        most = _END_BEFORE_STOP_S if self.safe_stop else 30.0
        if not 0 <= self.end <= most:
            what = ": the program must be gone when the robot is stopped" * bool(self.safe_stop)
            yield "end", f"must be from 0 to {most:g} s{what}"
        for name, value in self.environment.items():
            if not name or "=" in name or "\0" in name + value:
                yield "environment", f"'{name}' is no variable of the environment"


def _unfit(command: Sequence[str]) -> Iterator[str]:
    """Yield why a list of arguments is not safe to start with values of parameters."""
    for before, word in zip(("", *command), command, strict=False):
        is_value = word.startswith("{") and word.endswith("}")
        if "\0" in word:
            yield "has a zero byte"
        if not before and (is_value or not word):
            yield "has to name its program: a parameter cannot choose it"
        if is_value and before in _CODE and _INTERPRETERS.fullmatch(Path(command[0]).name):
            yield f"'{word}' would be run as code by {command[0]}: put the code into a file"


def problems(config: Config, parameters: Collection[str]) -> Iterator[tuple[str, str]]:
    """Yield placeholders without a parameter, and parameters without an effect."""
    templates = {key: getattr(config, key) for key in ("command", "safe_stop", "simulated")}
    yield from _placeholders.problems(templates, parameters, "command")


def run(config: Config, context: ActionContext) -> Mapping[str, Any] | None:
    """Start the program, wait for its end, and return its exit status and output."""
    return _execute(config, config.command, context)


def safe_stop(config: Config, context: ActionContext) -> None:
    """Start the program that stops the robot, and wait for its end."""
    if _execute(config, config.safe_stop, context) is None:
        raise AmberboxError(f"{config.safe_stop[0]} did not end in time")


def simulated(config: Config, context: ActionContext) -> Mapping[str, Any] | None:
    """Start the program that needs no robot."""
    return _execute(config, config.simulated, context)


def _execute(
    config: Config, template: Sequence[str], context: ActionContext
) -> Mapping[str, Any] | None:
    """Run one program to its end; None if the run had to end before."""
    arguments = list(_arguments(template, context.parameters))
    environment = {**os.environ, **config.environment}
    if shutil.which(arguments[0], path=environment.get("PATH")) is None:
        hint = "give its path, or install it where this user can run it"
        raise NotStartedError(f"there is no program '{arguments[0]}'", hint)
    words = [sys.executable, "-I", "-S", str(_GROUP), str(config.end), *arguments]
    process = subprocess.Popen(
        words, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, start_new_session=True,
    )  # fmt: skip
    assert process.stdin is not None and process.stdout is not None, "they are pipes"
    output = _Output(process.stdout)
    try:
        while process.poll() is None:
            output.read(_LOOK_S)
            if context.stopped():
                return None
    finally:
        process.stdin.close()  # the group ends now, if it has not
        process.wait(config.end + _LATE_S)
        output.read(0.0)
        process.stdout.close()
    if process.returncode != 0:
        words = [f"{arguments[0]} ended with exit status {process.returncode}", output.last_line()]
        raise AmberboxError(": ".join(filter(None, words)))
    return {"exit_status": 0, "output": output.text(), "left_out_bytes": output.left_out}


def _arguments(template: Sequence[str], parameters: Mapping[str, Any]) -> Iterator[str]:
    """Yield the arguments; raises NotStartedError for a text that would be an option."""
    options_end = False
    for word in template:
        value = _placeholders.filled(word, parameters)
        if isinstance(value, str) and value != word and value.startswith("-") and not options_end:
            hint = "put '--' before the parameter if the program knows that as the end of options"
            raise NotStartedError(f"'{value}' would be an option of {template[0]}", hint)
        options_end = options_end or word == "--"
        yield str(value).lower() if isinstance(value, bool) else str(value)


class _Output:
    """The end of what a program writes; reading never waits longer than it is told."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._fd = stream.fileno()
        self._tail = b""
        self._open = True
        self.left_out = 0
        os.set_blocking(self._fd, False)

    def read(self, within_s: float) -> None:
        """Read what is there, or wait a moment for it."""
        wait_readable([self._fd] if self._open else [], within_s)
        for _ in range(64):  # at most 4 MB at once: then others have their turn
            try:
                block = os.read(self._fd, 1 << 16)
            except BlockingIOError:
                return
            self._open = bool(block)
            if not block:
                return
            whole = self._tail + block
            self._tail = whole[-OUTPUT_BYTES:]
            self.left_out += len(whole) - len(self._tail)

    def text(self) -> str:
        """Return the end of the output."""
        return self._tail.decode(errors="replace")

    def last_line(self) -> str:
        """Return the last line that is not empty."""
        lines = [line.strip() for line in self.text().splitlines()]
        return next((line[-300:] for line in reversed(lines) if line), "")
