"""The event bus: publishes changes in memory to listeners in the server's event loop."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias, get_args

Kind: TypeAlias = Literal[
    "rows", "live", "connected", "gone", "journal", "committed", "robot", "alarm", "job", "fetch",
    "account", "diagnosis", "explained", "has", "holdings", "command", "answered",
    "lease", "run",
]  # fmt: skip
"""What a change is about.

``rows``: new rows of a robot, durable (data: store_id, rows: Sequence[Row]). ``live``: latest
values (data: values). ``connected`` (data: hello, admission) and ``gone``: a robot's link.
``journal``: one arrived, whatever became of it (data: store_id, journal, state). ``committed``:
columns of journals are in the archive (data: robots). ``robot``: one was added, changed, given
another folder. ``alarm`` (data: id), ``job`` (data: id, owner), ``fetch`` (data: id),
``account`` (data: name; its sessions may have ended), ``diagnosis`` (data: id).
``explained``: a diagnosis was put into words (data: answer, as ``POST .../diagnose`` gives it).
``has``: a robot told which journals hold a window (data: store_id, id, files).
``holdings``: a robot asked which of its journals are here, to send again those that are not.
``command``: some were made for a robot or changed by people (data: ids), or, without a robot, a
person's key was revoked. ``answered``: a robot answered commands (data: ids). ``lease``: a robot
has another holder, or another motion waits for its confirmation (data: ids of such motions).
``run``: a run of an experiment has begun, changed or ended (data: id).
"""

KINDS = frozenset(get_args(Kind))
Listener: TypeAlias = "Callable[[ServerChange], None]"


@dataclass(frozen=True, slots=True)
class ServerChange:
    """One change; ``robot`` is empty where it concerns none."""

    kind: Kind
    robot: str = ""
    data: Mapping[str, Any] = field(default_factory=dict)


class EventBus:
    """Publishes changes to the listeners of their kind.

    ``publish`` may be called in any thread. Listeners are called in the event loop of ``attach``
    and must not block; an exception in one affects neither other listeners nor the publisher.
    """

    def __init__(self) -> None:
        self._listeners: dict[Kind, list[Listener]] = {}
        self._loop: asyncio.AbstractEventLoop | None = None

    def attach(self, loop: asyncio.AbstractEventLoop) -> None:
        """Set the event loop in which listeners are called."""
        self._loop = loop

    def on(self, kind: Kind, listener: Listener) -> Callable[[], None]:
        """Register a listener for a kind of change; return a function that removes it."""
        listeners = self._listeners.setdefault(kind, [])
        listeners.append(listener)
        return lambda: listeners.remove(listener) if listener in listeners else None

    def publish(self, change: ServerChange) -> None:
        """Publish a change from any thread; without an event loop (tools, tests) deliver it at
        once.
        """
        if self._loop is None or self._is_in_loop():
            self._deliver(change)
        elif not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._deliver, change)

    def _is_in_loop(self) -> bool:
        try:
            return asyncio.get_running_loop() is self._loop
        except RuntimeError:
            return False

    def _deliver(self, change: ServerChange) -> None:
        for listener in tuple(self._listeners.get(change.kind, ())):
            try:
                listener(change)
            except Exception:  # a listener's error must not reach the others
                logging.getLogger(__name__).exception("a listener failed over %s", change.kind)
