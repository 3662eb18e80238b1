"""A segment as its frames show it: frames out and back, process images, health.

A frame passes every slave and returns. Slaves set bit 0x02 of its source address on the way back;
where they do not (simulators), a frame that equals one that has left and not returned is the
return.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from amberbox.blackbox.columns.frame_layout import MESSAGE_ENCODING
from amberbox.blackbox.ethercat.frame import (
    AL_STATUS,
    AL_STATUS_CODE,
    BROADCAST,
    BY_POSITION,
    COMMANDS,
    LOGICAL,
    READS,
    BusRow,
    Datagram,
    MalformedFrameError,
    NotEtherCatError,
    al_status_schema,
    bus_schema,
    datagram_schema,
    pack_al_status,
    pack_datagram,
    read_frame,
)
from amberbox.blackbox.ethercat.images import Cut, Datagrams, InterfaceOptions
from amberbox.core.clock import NS
from amberbox.core.types import Topic

LOST_NS = NS // 10
"""A frame that has not returned after this time is lost."""
_ROW_NS = NS
_SWEEP_NS = NS // 50
_SAMPLES = 10  # equal counters in a row from which the expected one is learnt
_MOST_PENDING, _MOST_CYCLES, _MOST_SLAVES, _MOST_MASTERS = 256, 64, 4096, 16
_RETURNED_BIT = 0x02
_LOCAL = 4
"""Mark of a master that runs on the computer that listens; below it, of both source addresses."""

Identity = tuple[tuple[int, int, int], ...]


def topic(name: str, prefix: str = "") -> Topic:
    """Return ``bus``, ``al_status`` or ``datagrams``, which every segment has."""
    schemas = {"bus": bus_schema, "al_status": al_status_schema, "datagrams": datagram_schema}
    return Topic(prefix + name, MESSAGE_ENCODING, schemas[name]())


class Put(Protocol):
    """Takes a message."""

    def __call__(self, topic: Topic, data: bytes, time_ns: int, /) -> None: ...


class Tell(Protocol):
    """Takes an event."""

    def __call__(self, kind: str, text: str, /) -> None: ...


class _Sent(NamedTuple):
    """A frame that has left the master."""

    time_ns: int
    datagrams: Sequence[Datagram]
    cycle: _Cycle | None


@dataclass
class _Cycle:
    """What repeats: frames with the same datagrams of process data."""

    name: str
    address: int
    expected: int
    learns: bool
    incomplete: bool = False
    sent_ns: int = 0
    period_ns: int = 0
    _same: int = 0
    _candidate: int = -1
    _streak: int = 0

    def judge(self, counter: int, debounce: int) -> bool:
        """Take the working counter of a cycle; return whether ``incomplete`` has changed."""
        if self.learns and counter > self.expected:
            self._same = self._same + 1 if counter == self._candidate else 1
            self._candidate = counter
            if self._same >= _SAMPLES:
                self.expected = counter
        # more than was learnt is a segment that starts; more than is configured is wrong
        bad = counter < self.expected or (not self.learns and counter > self.expected)
        self._streak = self._streak + 1 if bad != self.incomplete else 0
        if self._streak < debounce:
            return False
        self.incomplete, self._streak = bad, 0
        return True


@dataclass
class BusCounts:
    """Frames since the segment was first seen."""

    sent: int = 0
    returned: int = 0
    lost: int = 0
    malformed: int = 0
    other: int = 0


@dataclass
class EtherCatBus:
    """Turns the frames of one segment into messages; times are ns of any one clock.

    ``learnt`` are expected working counters of earlier runs, by the name of their cycle.
    """

    options: InterfaceOptions
    put: Put
    tell: Tell
    prefix: str = ""
    learnt: dict[str, int] = field(default_factory=dict)
    counts: BusCounts = field(default_factory=BusCounts)

    def __post_init__(self) -> None:
        self._images = self.options.images()
        self._datagrams: Datagrams = self.options.datagrams
        self._bus, self._al, self._raw = (
            topic(name, self.prefix) for name in ("bus", "al_status", "datagrams")
        )
        self._cuts: dict[tuple[int, int, int], Sequence[Cut]] = {}
        self._cycles: dict[Identity, _Cycle] = {}
        self._partial: dict[str, bytearray] = {}
        self._pending: dict[tuple[int, ...], _Sent] = {}
        self._ways: dict[bytes, int] = {}
        self._states: dict[tuple[int, int], tuple[int, bytes]] = {}
        self._row: dict[str, int] = {}
        self._row_ns = self._swept_ns = self._excused_ns = 0

    @property
    def topics(self) -> Sequence[Topic]:
        """Return the topics that are always there."""
        raw = () if self._datagrams == "none" else (self._raw,)
        return [*self._images.topics, self._bus, self._al, *raw]

    def frame(self, data: bytes, time_ns: int, sent: bool | None = None) -> None:
        """Take an Ethernet frame; ``sent`` states whether this computer sent or received it."""
        try:
            datagrams = read_frame(data)
        except NotEtherCatError:
            self.counts.other += 1
            self._count("other")
            return
        except MalformedFrameError:
            self.counts.malformed += 1
            self._count("malformed")
            return
        if time_ns - self._swept_ns >= _SWEEP_NS or time_ns < self._swept_ns:
            self.tick(time_ns)
        self._count("frames")
        first = datagrams[0]
        shape = (first.command, first.number, len(first.data), len(datagrams))
        key = (*shape, data[7], data[11])
        if self._is_returned(data, datagrams, sent, key):
            self.counts.returned += 1
            self._returned(datagrams, self._pending.pop(key, None), time_ns)
        else:
            self.counts.sent += 1
            self._sent(datagrams, key, time_ns)

    def dropped(self, count: int, until_ns: int) -> None:
        """Count frames that the kernel dropped before this time: returned ones may be among them,
        so no frame that left before is called lost.
        """
        self._count("dropped", count)
        self._excused_ns = until_ns

    def tick(self, time_ns: int) -> None:
        """Look for lost frames; put a row of ``bus`` if there was none for a second.

        All frames before this time must have been taken.
        """
        self._swept_ns = time_ns
        while self._pending:
            key, oldest = next(iter(self._pending.items()))
            if time_ns - oldest.time_ns < LOST_NS and len(self._pending) <= _MOST_PENDING:
                break
            del self._pending[key]
            self._lose(oldest, time_ns)
        if not 0 <= time_ns - self._row_ns < _ROW_NS:
            if self._row_ns or self._row:
                self._put_row(BusRow(), time_ns)
            self._row_ns = time_ns

    def _count(self, name: str, number: int = 1) -> None:
        self._row[name] = self._row.get(name, 0) + number

    def _is_returned(
        self,
        data: bytes,
        datagrams: Sequence[Datagram],
        sent: bool | None,
        key: tuple[int, ...],
    ) -> bool:
        """Tell by the source address, else by the direction of a master that runs here, else by
        what has left before.
        """
        bit = bool(data[6] & _RETURNED_BIT)
        master = bytes((data[6] & ~_RETURNED_BIT,)) + data[7:12]
        seen = self._ways.get(master, 0) | 1 << bit | (_LOCAL if sent else 0)
        if len(self._ways) < _MOST_MASTERS or master in self._ways:
            self._ways[master] = seen
        if seen & 3 == 3:
            return bit
        if seen & _LOCAL and sent is not None:
            return not sent
        return key in self._pending or any(one.working_counter for one in datagrams)

    def _sent(self, datagrams: Sequence[Datagram], key: tuple[int, ...], time_ns: int) -> None:
        cycle = self._cycle(datagrams)
        if cycle is not None:
            cycle.period_ns = time_ns - cycle.sent_ns if cycle.sent_ns else 0
            cycle.sent_ns = time_ns
        before = self._pending.pop(key, None)
        if before is not None:
            self._lose(before, time_ns)
        self._pending[key] = _Sent(time_ns, datagrams, cycle)
        for one in datagrams:
            for cut in self._cuts_of(one) if one.command in LOGICAL else ():
                if not cut.from_slaves:
                    self._put_image(cut, one.data, time_ns)
            if self._datagrams == "all":
                self.put(self._raw, pack_datagram(one, False), time_ns)

    def _returned(self, datagrams: Sequence[Datagram], sent: _Sent | None, time_ns: int) -> None:
        cycle = self._cycle(datagrams)
        for place, one in enumerate(datagrams):
            cuts = self._cuts_of(one) if one.command in LOGICAL else ()
            for cut in cuts:
                if (cut.from_slaves and one.working_counter) or (
                    not cut.from_slaves and sent is None and not _overlap(cuts)
                ):
                    self._put_image(cut, one.data, time_ns)
            if self._datagrams == "all" or (self._datagrams == "unknown" and not cuts):
                self.put(self._raw, pack_datagram(one, True), time_ns)
            if one.register <= AL_STATUS and one.command in READS and one.working_counter:
                origin = sent.datagrams[place] if sent is not None else None
                self._al_status(one, origin, time_ns)
        if cycle is None:
            return
        counter = sum(one.working_counter for one in datagrams if one.command in LOGICAL)
        round_trip = float("nan") if sent is None else (time_ns - sent.time_ns) / NS
        self._cycle_row(cycle, min(counter, 0xFFFF), round_trip, time_ns)

    def _lose(self, sent: _Sent, time_ns: int) -> None:
        """Count a frame that did not return; in its cycle no slave took part."""
        if sent.time_ns <= self._excused_ns:
            return
        self.counts.lost += 1
        self._count("lost")
        if sent.cycle is not None:
            self._cycle_row(sent.cycle, 0, float("nan"), time_ns)

    def _cycle_row(self, cycle: _Cycle, counter: int, round_trip: float, time_ns: int) -> None:
        before = cycle.expected
        if cycle.judge(counter, self.options.debounce_cycles):
            state = "missing" if cycle.incomplete else "back"
            self.tell(
                f"ethercat_slaves_{state}",
                f"{cycle.name}: working counter {counter}, expected {cycle.expected}",
            )
        if cycle.expected != before:
            self.learnt[cycle.name] = cycle.expected
        period = cycle.period_ns / NS if cycle.period_ns > 0 else float("nan")
        self._put_row(
            BusRow(
                1, cycle.incomplete, counter, min(cycle.expected, 0xFFFF), cycle.address,
                cycle_time=period, round_trip=round_trip,
            ),
            time_ns,
        )  # fmt: skip

    def _put_row(self, row: BusRow, time_ns: int) -> None:
        counts: Mapping[str, int] = self._row
        self._row = {}
        self._row_ns = time_ns
        self.put(self._bus, row._replace(**counts).pack(), time_ns)  # type: ignore[arg-type]  # all are numbers

    def _cycle(self, datagrams: Sequence[Datagram]) -> _Cycle | None:
        """Return the cycle of a frame; None if it has no process data."""
        identity = tuple(
            [(d.command, d.address, len(d.data)) for d in datagrams if d.command in LOGICAL]
        )
        if not identity:
            return None
        found = self._cycles.get(identity)
        if found is None:
            if len(self._cycles) >= _MOST_CYCLES:
                self._cycles.clear()
                self._cuts.clear()
            found = self._cycles[identity] = self._new_cycle(identity)
        return found

    def _new_cycle(self, identity: Identity) -> _Cycle:
        name = ", ".join(
            f"{COMMANDS[command]} at {address:#x} of {size} bytes"
            for command, address, size in identity[:8]
        )
        fits = any(self._images.cuts(*one) for one in identity)
        if self._images.topics and not fits:
            self.tell("ethercat_unknown_image", f"{name}: fits no message of the configuration")
        else:
            self.tell("ethercat_process_data", f"process data: {name}")
        expected = self.options.expected_working_counter
        return _Cycle(name, identity[0][1], expected or self.learnt.get(name, 0), expected is None)

    def _cuts_of(self, one: Datagram) -> Sequence[Cut]:
        key = (one.command, one.address, len(one.data))
        found = self._cuts.get(key)
        if found is None:
            found = self._cuts[key] = self._images.cuts(*key)
        return found

    def _put_image(self, cut: Cut, data: bytes, time_ns: int) -> None:
        """Put an image, once all of it has come; longer ones come in several datagrams in order."""
        part = data[cut.begin : cut.end]
        if len(part) == cut.size:
            self.put(cut.topic, part, time_ns)
            return
        partial = self._partial.setdefault(cut.topic.name, bytearray())
        if cut.at == 0:
            partial.clear()
        if len(partial) != cut.at:
            partial.clear()
            return
        partial += part
        if len(partial) == cut.size:
            self.put(cut.topic, bytes(partial), time_ns)
            partial.clear()

    def _al_status(self, one: Datagram, origin: Datagram | None, time_ns: int) -> None:
        """Put the state of a slave when the master reads another one, or again after a second."""
        place = AL_STATUS - one.register
        if len(one.data) < place + 2:
            return
        status = int.from_bytes(one.data[place : place + 2], "little")
        code = one.data[place + AL_STATUS_CODE - AL_STATUS :][:2]
        addressed, slave = 2, one.slave
        if one.command in BROADCAST:
            addressed, slave = 0, 0
        elif one.command in BY_POSITION:
            if origin is None:  # each slave has added 1 to the address on the way
                return
            addressed, slave = 1, -origin.slave & 0xFFFF
        row = pack_al_status(
            addressed, slave, status, int.from_bytes(code, "little") if len(code) == 2 else None
        )
        last_ns, last = self._states.get((addressed, slave), (0, b""))
        if last == row and 0 <= time_ns - last_ns < _ROW_NS:
            return
        if len(self._states) < _MOST_SLAVES or (addressed, slave) in self._states:
            self._states[addressed, slave] = (time_ns, row)
        self.put(self._al, row, time_ns)


def _overlap(cuts: Sequence[Cut]) -> bool:
    """Return whether slaves overwrite in a datagram what the master has written."""
    written = [cut for cut in cuts if not cut.from_slaves]
    read = [cut for cut in cuts if cut.from_slaves]
    return any(w.begin < r.end and r.begin < w.end for w in written for r in read)
