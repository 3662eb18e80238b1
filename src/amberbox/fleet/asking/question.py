"""A question to a worker: what is to be called, what it may take, and who hears the answer."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any, TypeAlias

Sink: TypeAlias = Callable[[bytes], None]
"""Takes the parts of an answer, one after the other, in a thread of its own."""

_OP = re.compile(r"amberbox\.fleet\.(?:[a-z_]+\.)+worker[a-z_]*:[a-z][a-z_]*")


def checked_op(op: str) -> tuple[str, str]:
    """Return module and function. Raises ValueError for what no worker does."""
    if not _OP.fullmatch(op):
        raise ValueError(f"{op!r} is nothing that a worker does")
    module, _, name = op.partition(":")
    return module, name


@dataclass(slots=True, eq=False)
class Question:
    """``op`` is ``module:function``; ``arguments`` are what msgpack can carry.

    ``limit_s`` counts from when a worker begins with it. ``asker`` shares the queue fairly.
    """

    op: str
    arguments: Mapping[str, Any]
    sink: Sink
    limit_s: float
    memory_bytes: int
    asker: str = ""
    done: Future[None] = field(default_factory=Future)
    _gone: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        checked_op(self.op)

    @property
    def is_cancelled(self) -> bool:
        """Tell whether nobody wants the answer any more."""
        return self._gone.is_set()

    def cancel(self) -> None:
        """Say that nobody wants the answer any more; a worker at it is stopped."""
        self._gone.set()
