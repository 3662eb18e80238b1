"""The contract of a source: what a plugin in ``blackbox/sources`` offers and may use.

A source is a module whose file name is its name in ``black_box.yaml``. It defines

- ``Config``: a frozen dataclass, built from the YAML block (see ``core.config``); one that names
  files may have ``in_folder(folder)``, which returns it with paths seen from the robot folder,
  ``wrong_files()``, which then yields key and sentence for errors in these files, as ``check``
  does, and ``notes()``, the same for what is odd but no error;
- ``Source``: a class that takes ``(config, name)`` and offers ``topics`` and ``run``;
- ``SAMPLE``: a block of YAML as one would write it, shown by ``amberbox plugins`` and checked;
- ``PASSIVE``: one line on why it does not disturb the bus, shown by ``amberbox doctor``; it may
  name parts of the configuration, as in ``{config.caller_id}``;
- optionally ``needs_process(config)``: True when it loads a native library; the recorder then runs
  it in a process of its own, so that a crash there costs its gap and nothing else. There the
  library is imported in ``run``: the recorder also imports the module, and makes a ``Source``;
- optionally ``read_graph(config, wait_s)``: the ``core.robot_graph.RobotGraph`` of what runs now,
  collected for at most that long; ``doctor --listen`` and ``new --from`` show and use it;
- optionally ``beside_recorder(config)``: the same for a second instance beside the recorder's, such
  as under another name; ``doctor --listen`` runs it (one in a process of its own keeps its block);
- optionally ``keys_of(address)``: the keys of a block that listens at an address, as given in
  ``new --from NAME=ADDRESS``; of the usual place where the address is empty;
- optionally ``service_of(config, node)``: the kind and the input with which the mode ``service``
  tells whether a node of the graph runs; with an empty name, whether what knows all nodes does;
  None where that cannot be asked;
- optionally ``known_topics(config)``: the topics that it will announce, with their schemas, as far
  as that is certain without a device; ``check`` judges names of variables by them.

A source that has to send, as for discovery, says so in ``PASSIVE``, and may count what it sent in
events of kind ``sent``; ``doctor --listen`` shows them.

A source only listens. It always reads, stamps on receipt, and never waits for the disk: when the
recorder's queue is full the message is dropped there and counted.

A source that takes times of receipt from the kernel or the wire passes messages on later than they
were received (``core.clock.StampConverter`` makes log time of the kernel's stamps). Its ``Source``
then states in ``late_s`` how much later that may be, at most ``MOST_LATE_S``, and it calls
``sink.complete`` again and again, also while nothing arrives. The messages of a topic are passed on
in the order of these times.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from amberbox.core.options import option
from amberbox.core.types import Topic

MOST_LATE_S = 60.0  # a longer wait would keep the monitors waiting, too
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
class TransformOptions:
    """Keep a message of tf only when the transform of a frame in it has changed enough."""

    translation: float = option(0.0, "distance by which a frame must move", unit="m")
    rotation: float = option(0.0, "angle by which a frame must turn", unit="rad")
    heartbeat_s: float = option(5.0, "keep each frame at least this often", unit="s")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each invalid value, and the reason."""
        for key in ("translation", "rotation", "heartbeat_s"):
            if not 0 <= getattr(self, key) < float("inf"):
                yield key, "must be 0 or more"


@dataclass(frozen=True)
class ImageOptions:
    """Record images of ROS smaller: scaled, and compressed."""

    scale: float = option(1.0, "width and height of the recorded image, as a part of its own")
    format: Literal["jpeg", "png"] = option("jpeg", "how it is compressed; 16 bit is always png")
    quality: int = option(80, "quality of jpeg: 1 to 100")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each invalid value, and the reason."""
        if not 0 < self.scale <= 1:
            yield "scale", "must be above 0 and at most 1"
        if not 1 <= self.quality <= 100:
            yield "quality", "must be between 1 and 100"


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
    image: ImageOptions | None = option(None, "scale and compress images before they are recorded")
    transforms: TransformOptions | None = option(None, "keep messages of tf only on a change")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each invalid value, and the reason."""
        if self.max_frequency is not None and self.max_frequency <= 0:
            yield "max_frequency", "must be above 0"
        if self.transforms is not None and self.change is not None:
            yield "transforms", "does not go together with 'change'; leave out one"


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

    def complete(self, until_ns: int) -> None:
        """Report that all messages received before ``until_ns`` (log time) have been passed on.

        For sources with ``late_s`` only, again and again, also while nothing is received.
        """

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
        """Return the options of the topics configured; empty means every topic, unfiltered.

        A name with ``*`` is a pattern (``core.topic_selection``): its options are those of the
        topics that it matches and that are not listed by name.
        """

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Listen until ``stop`` is set, or return when the input has ended.

        A device that is missing is retried in here, with back-off and an event; an exception
        ends the run and is recorded, then the recorder starts it again with back-off.
        """
