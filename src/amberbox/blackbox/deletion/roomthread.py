"""Making room in a thread of its own, so that nothing else the keeper does can hold it up."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable

PERIOD_S = 0.1
"""Between two looks at the room that is left."""
_SWITCH_S = 0.0005
"""How long other threads may keep the interpreter from this one: they have lower priority."""


class RoomThread:
    """Looks at the room that is left ten times a second.

    Start it before the process lowers its priority, which on Linux is that of a thread.
    """

    def __init__(self, look: Callable[[], None]) -> None:
        self._look = look
        self._error: Exception | None = None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="room", daemon=True)
        sys.setswitchinterval(_SWITCH_S)
        self._thread.start()

    def _run(self) -> None:
        try:
            while not self._over.wait(PERIOD_S):
                self._look()
        except Exception as error:  # whatever it is: the keeper is not to go on without
            self._error = error

    def check(self) -> None:
        """Raise what has ended the thread, if anything has."""
        if self._error is not None:
            raise self._error

    def stop(self) -> None:
        """End it, once it has done what it is at."""
        self._over.set()
        self._thread.join()
