"""What the supervisor has to say: printed at once, written into the record by the keeper."""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from amberbox.blackbox import requests
from amberbox.blackbox.doctor.supervised import STATE_FILE
from amberbox.blackbox.keeper.remarks import KIND
from amberbox.blackbox.store import Store
from amberbox.core.files import replace_file
from amberbox.robot.supervisor.output import say

_MOST = 1000
_AGAIN_S = 5.0
_END_S = 2.0


class Notes:
    """Takes events and the state of things; writes them in a thread of its own.

    A disk that is slow or full holds up nothing but this; what it refuses is tried again.
    """

    def __init__(self, store: Store, out: Callable[[str], None] = say) -> None:
        self._store, self._out = store, out
        self._events: deque[Mapping[str, Any]] = deque(maxlen=_MOST)
        self._state: str | None = None
        self._wake, self._stop = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="notes", daemon=True)
        self._thread.start()

    def tell(self, kind: str, text: str, **details: Any) -> None:
        """Print an event and have it written into the record."""
        self._out(f"{time.strftime('%H:%M:%S')} {kind}: {text}")
        self._events.append({"kind": kind, "text": text, "source": "run", "details": details})
        self._wake.set()

    def state(self, document: Mapping[str, Any]) -> None:
        """Have the state written, if it is another one."""
        self._state = json.dumps(document)
        self._wake.set()

    def close(self) -> None:
        """Write what is left, in bounded time."""
        self._stop.set()
        self._wake.set()
        self._thread.join(_END_S)

    def _run(self) -> None:
        while not self._stop.is_set():
            self._wake.wait()
            self._wake.clear()
            while not self._written() and not self._stop.wait(_AGAIN_S):
                pass
        self._written()

    def _written(self) -> bool:
        """Write all there is; False if the disk does not take it."""
        try:
            while self._events:
                requests.submit(self._store, KIND, self._events[0])
                self._events.popleft()
            state, self._state = self._state, None
            if state is not None:
                replace_file(self._store.path / STATE_FILE, state)
        except OSError:
            return False
        return True
