"""The person at a terminal, for a run at the robot: steps with number keys, remarks, an abort."""

from __future__ import annotations

import os
import termios
import textwrap
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from amberbox.core.errors import AmberboxError
from amberbox.core.files import wait_readable
from amberbox.core.safe_text import escape_hidden
from amberbox.experiments.experiment import FieldOptions
from amberbox.experiments.local import Answer, Confirmation, Order, Remark, Said
from amberbox.experiments.run import PersonTask, RobotTask, RunEvent

HELP = (
    "/deviation TEXT  what is not as expected in this step     /note TEXT  any remark\n"
    "/pause  /resume  timers stand still meanwhile             /abort [WHY]  end the run\n"
    "An abort stops the robot as its action says. It is no emergency stop."
)
_LINE_BYTES = 1 << 16
_QUESTIONS: Mapping[str, str] = {
    "pass_fail": "1 pass   2 fail   3 skip",
    "confirm": "1 done",
    "number": "a number",
    "text": "a text",
}
_CONFIRM = {"": FieldOptions(kind="confirm")}


NOBODY = Order("abort", "nobody is at the terminal any more")


def ask_for_free_way(task: RobotTask) -> str:
    """Return the question before a motion."""
    return f"the robot will move ({order_text(task)}). Is its way free?"


def order_text(task: RobotTask) -> str:
    """Return what the robot is to do."""
    given = ", ".join(f"{name} {value}" for name, value in task.parameters.items())
    return f"{task.action}: {given}" if given else task.action


class Terminal:
    """Shows one step at a time on lines of text, and reads answers from a file descriptor.

    ``name_of`` returns what people call an element. ``question`` is asked before the robot begins a
    step. ``at_end`` is what the end of the input says while something waits.
    """

    def __init__(
        self, name_of: Callable[[str], str], fileno: int, show: Callable[[str], None],
        question: Callable[[RobotTask], str] = ask_for_free_way, at_end: Said | None = NOBODY,
    ) -> None:  # fmt: skip
        self._name_of, self._fileno, self._show = name_of, fileno, show
        self._ask_for, self._at_end = question, at_end
        self._task: PersonTask | RobotTask | None = None
        self._values: dict[str, Any] = {}
        self._left: list[tuple[str, FieldOptions]] = []
        self._data = b""
        self._is_open = True
        self._is_terminal = os.isatty(fileno)

    def show(self, tasks: Sequence[PersonTask], motions: Sequence[RobotTask]) -> None:
        """Show what waits; a motion that needs a free way comes first."""
        waiting: list[PersonTask | RobotTask] = [*motions, *tasks]
        if self._task is not None and self._task.id in {task.id for task in waiting}:
            return
        self._task = waiting[0] if waiting else None
        if isinstance(self._task, RobotTask):
            self._forget_typed()
            self._show(f"\n== {self._task.step.name}: {self._ask_for(self._task)}")
            self._show("   1 yes   2 no")
        elif self._task is not None:
            self._begin(self._task)

    def _forget_typed(self) -> None:
        """Drop what was typed before a question was shown: it cannot say that a way is free."""
        if self._is_terminal:
            termios.tcflush(self._fileno, termios.TCIFLUSH)
            self._data = b""

    def _begin(self, task: PersonTask) -> None:
        form = task.form
        self._values, self._left = {}, list((form.fields or _CONFIRM).items())
        lines = [f"\n== {task.step.name} ({task.role})"]
        for label, text in (
            ("", form.text), ("expected: ", form.expected), ("a deviation: ", form.deviation)
        ):  # fmt: skip
            if text and text != task.step.name:
                lines += textwrap.wrap(label + text, 96, initial_indent="   ",
                                       subsequent_indent="   ")  # fmt: skip
        self._show("\n".join(lines))
        self._question()

    def _question(self) -> None:
        name, field = self._left[0]
        unit = f" [{field.unit}]" if field.unit else ""
        label = f"{field.label or name}{unit}: " if name else ""
        choices = "   ".join(f"{n} {text}" for n, text in enumerate(field.choices, 1))
        left_out = "" if field.required else "   (Enter: none)"
        self._show(f"   {label}{_QUESTIONS.get(field.kind, choices)}{left_out}")

    def said(self, seconds: float) -> Said | None:
        """Return what was typed, if it completes something; the end of the input is an abort."""
        line = self._read(seconds)
        if line is not None and self._task is None and not line.startswith("/"):
            if not self._is_terminal:  # a script's answer to a question that is still to come
                self._data = line.encode() + b"\n" + self._data
                time.sleep(seconds)
            return None
        if line is None:
            if self._is_open:
                return None
            if self._task is not None and self._at_end is not None:
                return self._at_end
            time.sleep(seconds)
            return None
        if line.startswith("/"):
            return self._ordered(line[1:])
        if isinstance(self._task, RobotTask):
            return self._confirmed(self._task.id, line)
        assert self._task is not None, "else the line was kept or dropped"
        return self._answered(self._task.id, line)

    def _ordered(self, line: str) -> Said | None:
        word, _, text = line.partition(" ")
        task = self._task.id if isinstance(self._task, PersonTask) else ""
        if word in ("deviation", "note") and text.strip():
            return Remark(text, task if word == "deviation" else "")
        if word in ("abort", "pause", "resume"):
            return Order(word, text)
        self._show(HELP)
        return None

    def _confirmed(self, task: str, line: str) -> Said | None:
        if line not in ("1", "2"):
            self._show("   1 yes   2 no   (/help)")
            return None
        self._task = None
        return Confirmation(task, line == "1")

    def _answered(self, task: str, line: str) -> Said | None:
        name, field = self._left[0]
        try:
            value = _value(field, line)
        except ValueError:
            self._question()
            return None
        if name:
            self._values[name] = value
        del self._left[0]
        if self._left:
            self._question()
            return None
        self._task = None
        return Answer(task, self._values)

    def tell(self, event: RunEvent) -> None:
        """Print what the robot does, and what happens by itself."""
        about = self._name_of(event.element)
        words = {
            "started": f"{about}: the robot begins",
            "report": f"{about}: {event.text}",
            "ended": f"{about}: {event.values.get('state', '').replace('_', ' ')}",
            "timer": f"{about}: its time has come",
            "interrupted": f"{about}: interrupted",
            "paused": "paused; /resume goes on",
            "resumed": "going on",
        }.get(event.kind)
        if words is not None:
            more = f": {event.text}" if event.text and event.kind in ("ended", "paused") else ""
            self._show(escape_hidden(f"-- {words}{more}"))

    def refuse(self, error: AmberboxError) -> None:
        """Print why an answer is refused; its step is shown again."""
        self._show(f"   {error}")
        self._task = None

    def _read(self, seconds: float) -> str | None:
        if b"\n" not in self._data and self._is_open:
            if not wait_readable([self._fileno], seconds):
                return None
            read = os.read(self._fileno, _LINE_BYTES)
            self._is_open = bool(read)
            self._data = (self._data + read)[-_LINE_BYTES:]
        line, end, rest = self._data.partition(b"\n")
        if not end:
            return None
        self._data = rest
        return escape_hidden(line.decode(errors="replace")).strip()


def _value(field: FieldOptions, line: str) -> Any:
    """Return what a line says; raises ValueError for a line that says nothing."""
    if not line and not field.required:
        return None
    if field.kind == "pass_fail":
        return {1: True, 2: False, 3: None}[_key(line, 3)]
    if field.kind == "confirm":
        return _key(line, 1) == 1
    if field.kind == "number":
        return float(line.replace(",", "."))
    if field.kind == "choice":
        return field.choices[_key(line, len(field.choices)) - 1]
    if not line:
        raise ValueError
    return line


def _key(line: str, most: int) -> int:
    number = int(line)
    if not 1 <= number <= most:
        raise ValueError
    return number
