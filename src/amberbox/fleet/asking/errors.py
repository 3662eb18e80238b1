"""Why a question was not answered, where it is not the question's own fault."""

from __future__ import annotations

from amberbox.core.errors import AmberboxError


class BusyError(AmberboxError):
    """Too many questions wait already."""


class LimitError(AmberboxError):
    """The answer would have taken more time, memory or room than it may."""


class BrokenError(AmberboxError):
    """A worker failed in a way that it should not: a mistake in the server, never an answer."""


class CancelledError(AmberboxError):
    """Whoever asked does not want to know any more."""


TRY_AGAIN = "the server may be busy: try again; if that is no help, ask for less at a time"


def too_long(limit_s: float) -> LimitError:
    """Say that an answer took too long."""
    return LimitError(f"the answer took longer than {limit_s:g} s", TRY_AGAIN)


def too_big(memory_bytes: int) -> LimitError:
    """Say that an answer needs too much memory."""
    size = f"{memory_bytes / (1 << 20):.0f} MB"
    return LimitError(f"the answer needs more memory than {size}", "ask for less at a time")
