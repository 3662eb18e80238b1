"""Takes messages before it is known where they go, stamped as they came.

The first message of a type waits until its decoder is built, which takes up to a second on a
small computer. The socket does not wait, and neither does the time of receipt.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

Deliver = Callable[[bytes, int], None]

MOST_BYTES = 64 << 20


class HeldDelivery:
    """Holds messages back until ``release`` says where they go."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._held: list[tuple[bytes, int]] = []
        self._bytes = 0
        self._released = threading.Event()
        self._deliver: Deliver | None = None

    def __call__(self, data: bytes, received_ns: int) -> None:
        if self._deliver is None and self._hold(data, received_ns):
            return
        assert self._deliver is not None
        self._deliver(data, received_ns)

    def _hold(self, data: bytes, received_ns: int) -> bool:
        """Hold a message back; wait when too much is held, False if that is over."""
        with self._lock:
            if self._deliver is not None:
                return False
            if self._bytes + len(data) <= MOST_BYTES:
                self._bytes += len(data)
                self._held.append((data, received_ns))
                return True
        self._released.wait()
        return False

    def release(self, deliver: Deliver) -> None:
        """Deliver what is held, in order, and from now on everything at once."""
        with self._lock:
            try:
                for data, received_ns in self._held:
                    deliver(data, received_ns)
            finally:
                self._held.clear()
                self._deliver = deliver
                self._released.set()

    def wait(self, timeout_s: float) -> None:
        """Wait until nothing is held back any more."""
        self._released.wait(timeout_s)
