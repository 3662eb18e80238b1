"""A mode that does not come back is interrupted, so that all others go on."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType

from amberbox.core.clock import NS
from amberbox.monitoring.plan import Plan

LIMIT_S = 2.0
_LOOKS = 5
_FUNCTIONS = ("evaluate", "explain")


class HangError(TimeoutError):
    """An evaluation took too long."""


def waited_for_processor_s() -> float:
    """Return for how long this thread has waited for a processor so far; 0 if nobody counts."""
    try:
        return int(Path("/proc/thread-self/schedstat").read_text().split()[1]) / NS
    except (OSError, ValueError, IndexError):
        return 0.0


class _Guard:
    """Looks now and then whether the same call is still under way."""

    def __init__(
        self,
        codes: frozenset[CodeType],
        clock_s: Callable[[], float] = time.monotonic,
        waited_s: Callable[[], float] = waited_for_processor_s,
    ) -> None:
        self._codes = codes
        self._clock_s, self._waited_s = clock_s, waited_s
        self._frame: FrameType | None = None
        self._looks = 0
        self._looked = (clock_s(), waited_s())

    def look(self, _number: int, frame: FrameType | None) -> None:
        """Interrupt a call that was there at so many looks.

        Looks are counted, not seconds: while the whole process is suspended there are none. A look
        does not count where the process has waited for a processor most of the time before it.
        """
        before_s, waited_s = self._looked
        self._looked = now_s, now_waited_s = self._clock_s(), self._waited_s()
        call = self._call_in(frame)
        if call is self._frame and now_waited_s - waited_s > (now_s - before_s) / 2:
            return
        self._looks = self._looks + 1 if call is not None and call is self._frame else 0
        self._frame = call
        if self._looks >= _LOOKS:
            self._frame, self._looks = None, 0
            raise HangError(f"no answer within {LIMIT_S:g} s")

    def _call_in(self, frame: FrameType | None) -> FrameType | None:
        while frame is not None and frame.f_code not in self._codes:
            frame = frame.f_back
        return frame


@contextmanager
def guarded(plan: Plan) -> Iterator[None]:
    """Raise ``HangError`` inside a function of a mode that takes longer than ``LIMIT_S``.

    It is interrupted where it stands; the engine takes it for a crash of that mode, or does without
    its explanation. Works in the main thread; in others nothing is guarded.
    """
    codes = frozenset(_codes(plan))
    if threading.current_thread() is not threading.main_thread() or not codes:
        yield
        return
    before = signal.signal(signal.SIGALRM, _Guard(codes).look)
    signal.setitimer(signal.ITIMER_REAL, LIMIT_S / _LOOKS, LIMIT_S / _LOOKS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def _codes(plan: Plan) -> Iterator[CodeType]:
    """Give the code of each mode's functions."""
    for _, mode in plan.modes():
        for name in _FUNCTIONS:
            code = getattr(getattr(mode.module, name, None), "__code__", None)
            if code is not None:
                yield code
