"""The contract of a source: what a plugin in ``blackbox/sources`` offers and may use.

A source is a module whose file name is its name in ``black_box.yaml``. It defines

- ``Config``: a frozen dataclass, built from the YAML block (see ``core.config``); one that names
  files may have ``in_folder(folder)``, which returns it with paths seen from the robot folder,
  and ``notes()``, which yields key and sentence for what is odd but no error, as ``check`` does;
- ``Source``: a class that takes ``(config, name)`` and offers ``topics`` and ``run``;
- ``SAMPLE``: a block of YAML as one would write it, shown by ``amberbox plugins`` and checked;
- ``PASSIVE``: one line on why it does not disturb the bus, shown by ``amberbox doctor``; it may
  name parts of the configuration, as in ``{config.caller_id}``;
- optionally ``known_topics(config)``: the topics that it will announce, with their schemas, as far
  as that is certain without a device; ``check`` judges names of variables by them.

A source only listens. It always reads, stamps on receipt, and never waits for the disk: when the
recorder's queue is full the message is dropped there and counted.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from amberbox.core.options import option
from amberbox.core.types import Topic

Keep = Literal["all", "bulk", "ring", "incident", "none"]
# supply of the box: external, its own battery, or the rest of it
Power = Literal["mains", "battery", "low"]


@dataclass(frozen=True)
class ChangeOptions:
    """Keep a message only when something in it has changed enough."""

    absolute: float = option(0.0, "smallest change of a variable that counts")
    relative: float = option(0.0, "the same as a fraction of the last kept value")
    variables: Sequence[str] = option((), "variables to look at; all when absent")
    bands: Mapping[str, float] = option({}, "absolute dead band per variable")
    heartbeat_s: float = option(5.0, "keep a message at least this often", unit="s")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each invalid value, and the reason."""
        numbers = {"absolute": self.absolute, "relative": self.relative}
        numbers |= {"heartbeat_s": self.heartbeat_s}
        numbers |= {f"bands.{name}": width for name, width in self.bands.items()}
        for key, value in numbers.items():
            if not 0 <= value < float("inf"):
                yield key, "must be 0 or more"


@dataclass(frozen=True)
class TopicOptions:
    """What every source offers per topic; sources add their own by subclassing."""

    name: str = option(doc="topic as on the bus")
    type: str = option("", "message type; only checked where the bus tells it")
    variable_names: Sequence[str] = option((), "variables to show; all when absent")
    max_frequency: float | None = option(
        None, "keep at most this many per second, after a first burst of 11", unit="Hz"
    )
    change: ChangeOptions | None = option(None, "keep only what changed")
    keep: Keep = option("all", "keeping class")
    stamp: str | None = option(None, "path of the own time stamp; '' for none")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each invalid value, and the reason."""
        if self.max_frequency is not None and self.max_frequency <= 0:
            yield "max_frequency", "must be above 0"


class Sink(Protocol):
    """The receiver of a source's messages and events. All calls may come from any thread."""

    def now_ns(self) -> int:
        """Return the time of receipt of a message that arrives now (log time, ns)."""

    def topic(self, topic: Topic) -> int:
        """Register a topic and return its stream number; the same topic gives the same one."""

    def message(self, stream: int, data: bytes, received_ns: int) -> None:
        """Put one raw message. Never blocks a live source: a full queue drops it, counted."""

    def longest_message(self) -> int:
        """Return how many bytes a message may have to find room; a longer one is always lost."""

    def link_up(self, topic: str, peer: str, since_ns: int | None = None) -> None:
        """Report that messages of ``peer`` on ``topic`` arrive from now on.

        Closes the gap that is open for it. For a peer never seen before, ``since_ns`` is the last
        moment at which it is known not to have published.
        """

    def link_down(self, topic: str, peer: str, reason: str, since_ns: int | None = None) -> None:
        """Report that no message of ``peer`` on ``topic`` can arrive from now on; opens a gap.

        ``since_ns`` is given when the loss is noticed late: the gap begins there.
        """

    def lost(
        self, topic: str, peer: str, from_ns: int, to_ns: int, count: int, reason: str
    ) -> None:
        """Report that messages of ``peer`` were lost before the box, between two that arrived."""

    def event(self, kind: str, text: str, **details: Any) -> None:
        """Record an event; ``kind`` is a short identifier, ``text`` one line for a person."""

    def power(self, state: Power, text: str) -> None:
        """Report how the box is powered now; ``text`` is one line for a person.

        On ``battery`` the recorder makes everything durable at once and from then on more often,
        and marks an incident; on ``low`` it ends the run cleanly while it still can.
        """

    def last_latched(self, topic: str) -> bytes | None:
        """Return the last latched message of a topic in the store, also of an earlier run."""

    def state(self) -> dict[str, Any]:
        """Return the state saved last by ``save_state``, also in an earlier run; empty at first."""

    def save_state(self, state: Mapping[str, Any]) -> None:
        """Store a few values (JSON) of this source across restarts of the box."""


class Source(Protocol):
    """One configured source, ready to receive."""

    lossless: bool
    """True for files: ``message`` then waits for room instead of dropping."""

    def topics(self) -> Sequence[TopicOptions]:
        """Return the options of the topics configured; empty means every topic, unfiltered."""

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Listen until ``stop`` is set, or return when the input has ended.

        A device that is missing is retried in here, with back-off and an event; an exception
        ends the run and is recorded, then the recorder starts it again with back-off.
        """
