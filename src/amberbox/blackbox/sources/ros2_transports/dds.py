"""DDS: the way to a ROS 2 robot without anything installed there; by CycloneDDS."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field

from amberbox.blackbox.sources.ros2_transports import discovery_info, names
from amberbox.blackbox.sources.ros2_transports.cyclone import (
    Endpoint,
    Gone,
    Participant,
    RawReader,
    ReaderQos,
    Sample,
    configuration,
)
from amberbox.blackbox.sources.ros2_transports.dds_graph import Discovered
from amberbox.blackbox.sources.ros2_transports.options import Ros2Options
from amberbox.blackbox.sources.ros2_transports.recorded_topics import OfferedTopic, RecordedTopics
from amberbox.blackbox.sources.ros2_transports.wire_types import WireTypes
from amberbox.core.errors import AmberboxError
from amberbox.core.robot_graph import RobotGraph
from amberbox.core.source import Sink
from amberbox.core.types import Schema

BEAT_S = 0.2
CHECK_S = 1.0  # how often sequence numbers are compared with what arrived
QUICK_COMPARISONS = 25  # of a new publisher, until the difference at the beginning is certain
NAME_S = 1.0  # how long the name of a publisher's node is waited for
HISTORY_S = 2.0  # how long after its discovery a latched publisher delivers what it sent before
STALL_NS = 1_000_000_000  # the box did not run for that long: times of receipt are estimated
MOST_PUBLISHERS = 20_000
LEAST_LIMIT = 64_000_000  # bytes of a message that the library takes at least
_MOST_HELD = 2_000  # messages of a publisher that arrived before it was introduced
# its writers keep the last 1000 messages for whoever comes: they would be recorded again each time
_NOT_LATCHED = frozenset({"/rosout"})


class Transport:
    """A participant of the robot's domain that reads the topics chosen."""

    def __init__(self, options: Ros2Options) -> None:
        self._options = options

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Listen until ``stop`` is set; publishers come and go."""
        longest = sink.longest_message()
        if self._options.max_message_mb is not None:
            longest = round(self._options.max_message_mb * 1_000_000)
        with self._participant(longest) as participant:
            _Listener(self._options, participant, sink, longest).run(stop)

    def read_graph(self, wait_s: float) -> RobotGraph:
        """Return nodes, topics and services; ends early when nothing new is announced any more."""
        with self._participant(64_000_000) as participant:
            return _collect(participant, wait_s)

    def follow_nodes(self, tell: Callable[[Collection[str]], None], stop: threading.Event) -> None:
        """Tell which nodes the processes of the domain say they have."""
        with self._participant(64_000_000) as participant:
            info = _open_discovery_info(participant)
            found = Discovered()
            while not stop.is_set():
                _look(participant, info, found, BEAT_S)
                tell(found.nodes())

    def _participant(self, longest_message: int) -> Participant:
        options = self._options
        # what is longer, but not absurd, is received, to be counted at once and by its topic
        most = max(LEAST_LIMIT, 4 * longest_message)
        xml = configuration(options.interface, options.peers, options.multicast, most)
        return Participant(options.chosen_domain(), xml)


def _open_discovery_info(participant: Participant) -> RawReader:
    """Read which node has which writers and readers, as each ROS 2 process tells."""
    return participant.open_reader(
        discovery_info.TOPIC, names.dds_type(discovery_info.TYPE), False, ReaderQos(latched=True)
    )


QUIET_S = 1.5  # after the last announcement nothing more is expected


def _collect(participant: Participant, wait_s: float) -> RobotGraph:
    info = _open_discovery_info(participant)
    participant.watch(info)
    found = Discovered()
    end = time.monotonic() + wait_s
    quiet_until = end
    while (now := time.monotonic()) < min(end, quiet_until):
        if _look(participant, info, found, min(0.1, end - now)):
            quiet_until = time.monotonic() + QUIET_S
    return found.graph()


def _look(participant: Participant, info: RawReader, found: Discovered, timeout_s: float) -> bool:
    """Take note of what discovery and processes say; return whether there was anything."""
    news = participant.wait_for_news(timeout_s)
    for one in participant.discovered() if news else ():
        found.add(one)
    told = [sample.data for sample in info.take() if sample.data is not None]
    for data in told:
        found.tell_nodes(data)
    return news or bool(told)


@dataclass(eq=False)
class _Publisher:
    """A writer of a recorded topic."""

    endpoint: Endpoint
    topic: str
    type_name: str
    since: float  # monotonic, s
    qos: ReaderQos  # with which it is read
    reader: RawReader | None = None
    offer: OfferedTopic | None = None
    peer: str = ""  # set once its link is up
    taken: int = 0
    last_ns: int = 0  # log time of its last message
    delay_ns: float | None = None  # mean of receipt minus its own time stamp
    held: list[tuple[bytes, int]] = field(default_factory=list)
    numbers: Numbers = field(default_factory=lambda: Numbers())


@dataclass
class Numbers:
    """How many messages of a publisher are missing, by its sequence numbers.

    A number and a count cannot be read at the same moment, so the count is read before and after.
    Both bounds hold for any moment: what they leave uncertain is reported when it is certain.
    """

    least: int | None = None  # of the difference between number and count, now
    most: int | None = None  # of the same, at the beginning
    reported: int = 0
    checked_ns: int = 0
    comparisons: int = 0
    is_exact: bool = False  # the difference at the beginning is known to the message

    def missing(self, number: int, taken_before: int, taken_after: int) -> int:
        """Return how many more are missing than were reported."""
        least, most = number - taken_after, number - taken_before
        if self.least is None or self.most is None or most < self.least:
            # the first, or more came than was numbered: what a latched publisher had sent before
            self.least, self.most, self.reported = least, most, 0
            self.comparisons, self.is_exact = 1, least == most
            return 0
        self.least, self.most = max(self.least, least), min(self.most, most)
        self.comparisons += 1
        self.is_exact = self.is_exact or self.least == self.most
        new = max(0, self.least - self.most - self.reported)
        self.reported += new
        return new


def _offer(publisher: _Publisher, schema: Schema | None) -> OfferedTopic:
    type_hash = discovery_info.type_hash_of(publisher.endpoint.user_data)
    return OfferedTopic(
        publisher.topic, publisher.type_name, type_hash, publisher.qos.latched, "cdr", schema
    )


class _Listener:
    """Follows who publishes, takes messages in a thread of its own, and counts what is missing."""

    def __init__(
        self, options: Ros2Options, participant: Participant, sink: Sink, longest_message: int
    ) -> None:
        self._options = options
        self._participant = participant
        self._longest = longest_message
        self._sink = sink
        self._recorded = RecordedTopics(options, sink)
        self._types = WireTypes(participant, self._recorded)
        self._found = Discovered()
        self._publishers: dict[int, _Publisher] = {}
        self._new: list[_Publisher] = []
        self._readers: dict[tuple[str, str, bool, ReaderQos], RawReader] = {}
        self._info = _open_discovery_info(participant)
        participant.watch(self._info)
        self._lock = threading.RLock()  # what is above, and the order of messages
        self._stalled = (0, 0)  # log times between which the box did not run
        self._completed_ns = 0
        self._last_ns: dict[int, int] = {}  # of each stream
        self._failure: Exception | None = None
        self._ended = threading.Event()

    def run(self, stop: threading.Event) -> None:
        taker = threading.Thread(target=self._take_messages, name="dds-messages", daemon=True)
        taker.start()
        check_at = time.monotonic()
        try:
            while not stop.is_set() and not self._ended.is_set():
                if self._participant.wait_for_news(BEAT_S):
                    self._discover()
                self._introduce_publishers()
                self._open_links()
                self._recorded.report_missing()
                if time.monotonic() >= check_at:
                    # what is missing before the first counts of a publisher cannot be known
                    pause_s = CHECK_S if self._count_missing() else BEAT_S
                    check_at = time.monotonic() + pause_s
        finally:
            self._ended.set()
            taker.join()
        if self._failure is not None:
            raise self._failure

    def _discover(self) -> None:
        with self._lock:
            for one in self._participant.discovered():
                if isinstance(one, Gone):
                    self._lose(one)
                self._found.add(one)
                if isinstance(one, Endpoint) and one.is_writer:
                    self._note_writer(one)

    def _note_writer(self, endpoint: Endpoint) -> None:
        carried = names.endpoint_of_dds(endpoint.topic)
        type_name = names.type_of_dds(endpoint.type_name)
        if carried is None or carried.kind != "topic" or not type_name:
            return
        if endpoint.handle in self._publishers or not self._recorded.chooses(
            carried.name, type_name
        ):
            return
        if len(self._publishers) >= MOST_PUBLISHERS:
            text = f"more than {MOST_PUBLISHERS} publishers; further ones are not recorded"
            self._recorded.report_once(("publishers",), "ros2_too_many_publishers", text)
            return
        if endpoint.only_xcdr2:
            text = f"{carried.name}: a publisher offers only XCDR2, which ROS 2 does not use"
            key = ("xcdr2", carried.name)
            self._recorded.report_once(key, "ros2_not_readable", text, topic=carried.name)
            return
        qos = self._reader_qos(endpoint, carried.name)
        publisher = _Publisher(endpoint, carried.name, type_name, time.monotonic(), qos)
        self._publishers[endpoint.handle] = publisher
        self._new.append(publisher)
        self._open_reader(publisher)

    def _reader_qos(self, endpoint: Endpoint, topic: str) -> ReaderQos:
        """Return how to read a publisher: as is wanted, as far as it offers that."""
        wanted = self._options.wanted_qos(topic)
        asks_reliable = wanted.reliability == "reliable"
        asks_latched = wanted.durability == "transient_local"
        if asks_reliable and not endpoint.reliable:
            self._recorded.report_not_offered(topic, "reliable")
        if asks_latched and not endpoint.latched:
            self._recorded.report_not_offered(topic, "transient_local")
        may_latch = not wanted.durability and topic not in _NOT_LATCHED
        is_latched = asks_latched or (may_latch and wanted.reliability != "best_effort")
        return ReaderQos(
            latched=endpoint.latched and is_latched,
            reliable=endpoint.reliable and asks_reliable,
            depth=wanted.depth,
        )

    def _open_reader(self, publisher: _Publisher) -> None:
        """Let the library receive at once; what it keeps is taken when the type is known."""
        endpoint = publisher.endpoint
        key = (endpoint.topic, endpoint.type_name, endpoint.keyed, publisher.qos)
        if key not in self._readers:
            try:
                self._readers[key] = self._participant.open_reader(*key)
            except AmberboxError as error:
                report = self._recorded.report_once
                report(("reader", *key[:2]), "ros2_not_readable", str(error))
                return
            self._participant.watch(self._readers[key])
        publisher.reader = self._readers[key]

    def _introduce_publishers(self) -> None:
        """Find the definitions of new publishers, and record what they have sent meanwhile."""
        while True:
            with self._lock:
                publisher = self._new[0] if self._new else None
            if publisher is None:
                return
            endpoint = publisher.endpoint
            type_hash = discovery_info.type_hash_of(endpoint.user_data)
            schema = self._types.schema(endpoint, publisher.type_name, type_hash)
            self._recorded.expect(_offer(publisher, schema))
            self._introduce(publisher, schema)

    def _introduce(self, publisher: _Publisher, schema: Schema | None) -> None:
        with self._lock:
            if publisher.offer is not None:
                return
            publisher.offer = _offer(publisher, schema)
            for data, received_ns in publisher.held:
                self._record(publisher, data, received_ns)
            publisher.held.clear()
            self._new.remove(publisher)

    def _open_links(self) -> None:
        now = time.monotonic()
        with self._lock:
            for publisher in self._publishers.values():
                is_due = now - publisher.since > NAME_S
                if is_due or self._found.node_of(publisher.endpoint):
                    self._open_link(publisher)

    def _open_link(self, publisher: _Publisher) -> None:
        if not publisher.peer and publisher.reader is not None:
            endpoint = publisher.endpoint
            publisher.peer = self._found.node_of(endpoint) or self._found.process_of(endpoint)
            self._sink.link_up(publisher.topic, publisher.peer)

    def _lose(self, gone: Gone) -> None:
        publisher = self._publishers.get(gone.handle)
        if publisher is None:
            return
        if publisher.reader is not None:
            self._take([publisher.reader])
        # it may have left before it could be asked for its type, or its node was known
        self._introduce(publisher, None)
        self._open_link(publisher)
        if publisher.peer:
            # it has been heard of within its lease, by messages or otherwise
            now_ns = self._sink.now_ns()
            same = publisher.endpoint.participant
            heard_ns = max(
                publisher.last_ns,
                now_ns - self._found.lease_ns(same),
                *(p.last_ns for p in self._publishers.values() if p.endpoint.participant == same),
            )
            reason = "its publisher left, or was not heard of any more"
            self._sink.link_down(publisher.topic, publisher.peer, reason, min(heard_ns, now_ns))
        self._publishers.pop(gone.handle, None)
        reader = publisher.reader
        if reader is not None and all(p.reader is not reader for p in self._publishers.values()):
            self._readers = {key: one for key, one in self._readers.items() if one is not reader}
            self._participant.close_reader(reader)

    def _take_messages(self) -> None:
        try:
            beat_ns = self._sink.now_ns()
            while not self._ended.is_set():
                readers = self._participant.wait_for_messages(BEAT_S)
                now_ns = self._sink.now_ns()
                if now_ns - beat_ns > STALL_NS:
                    self._stalled = (beat_ns, now_ns)
                with self._lock:
                    self._take(readers)
                    self._complete(now_ns)
                beat_ns = self._sink.now_ns()
        except Exception as error:
            self._failure = error
        finally:
            self._ended.set()

    def _complete(self, now_ns: int) -> None:
        """State that what arrived until now is passed on, except after a stall and what is held."""
        begin_ns, end_ns = self._stalled
        until_ns = begin_ns if now_ns - end_ns < STALL_NS else now_ns
        held = (publisher.held[0][1] for publisher in self._new if publisher.held)
        self._completed_ns = max(self._completed_ns, min(until_ns, *held, now_ns))
        self._sink.complete(self._completed_ns)

    def _take(self, readers: Iterable[RawReader]) -> None:
        """Take what readers have, and record it; the lock is held."""
        for reader in readers:
            samples = reader.take()
            now_ns = self._sink.now_ns()
            if reader is self._info:
                for data in (sample.data for sample in samples):
                    if data is not None:
                        self._found.tell_nodes(data)
                continue
            for sample in samples:
                publisher = self._publishers.get(sample.writer)
                if publisher is None:
                    self._discover()
                    publisher = self._publishers.get(sample.writer)
                # a best-effort reader also gets what a latched publisher sends to the other reader
                if publisher is not None and publisher.reader is reader:
                    publisher.taken += 1
                    if sample.data is not None:
                        self._receive(publisher, sample, sample.data, now_ns)

    def _receive(
        self, publisher: _Publisher, sample: Sample, data: bytes, received_ns: int
    ) -> None:
        received_ns = self._time_of_receipt(publisher, sample.source_ns, received_ns)
        since_ns, publisher.last_ns = publisher.last_ns or received_ns, received_ns
        if len(data) > self._longest:
            reason = f"longer than {self._longest / 1e6:g} MB"
            peer = publisher.peer or self._found.process_of(publisher.endpoint)
            self._sink.lost(publisher.topic, peer, since_ns, received_ns, 1, reason)
            return
        if publisher.offer is not None:
            self._record(publisher, data, received_ns)
        elif len(publisher.held) < _MOST_HELD:
            publisher.held.append((data, received_ns))
        else:
            publisher.taken -= 1  # counted with what is missing

    def _time_of_receipt(self, publisher: _Publisher, source_ns: int, now_ns: int) -> int:
        """Return when a message arrived; after a stall of the box by its publisher's time stamp."""
        delay_ns = now_ns - source_ns
        begin_ns, end_ns = self._stalled
        if end_ns and now_ns - end_ns < STALL_NS and publisher.delay_ns is not None:
            estimated = source_ns + round(publisher.delay_ns)
            if begin_ns < estimated < now_ns:
                return max(estimated, publisher.last_ns)
        elif publisher.delay_ns is None:
            publisher.delay_ns = delay_ns
        else:
            publisher.delay_ns += (delay_ns - publisher.delay_ns) / 16
        return now_ns

    def _record(self, publisher: _Publisher, data: bytes, received_ns: int) -> None:
        offer = publisher.offer
        if offer is None:
            return
        if offer.latched:
            is_history = time.monotonic() - publisher.since < HISTORY_S
            peer = publisher.peer or self._found.process_of(publisher.endpoint)
            if is_history and self._recorded.is_repeat(offer.name, peer, data):
                return
        stream = self._recorded.stream(offer, data)
        if stream >= 0:
            # several publishers of a topic: estimated times and held messages keep its order
            self._last_ns[stream] = max(received_ns, self._last_ns.get(stream, 0))
            self._sink.message(stream, data, self._last_ns[stream])
            if offer.latched:
                self._recorded.latched(offer.name, data)

    def _count_missing(self) -> bool:
        """Compare how far publishers got with what arrived.

        Return False while comparing soon again makes the count of a publisher more certain.
        """
        with self._lock:
            if not self._publishers:
                return True
            readers = list(self._readers.values())
            self._take(readers)
            before = {handle: p.taken for handle, p in self._publishers.items()}
        try:
            numbers = self._participant.last_sequences()
        except AmberboxError as error:
            text = f"{error}; messages that are lost before the box are not counted"
            self._recorded.report_once(("monitor",), "ros2_not_counted", text)
            return True
        with self._lock:
            self._take(readers)
            now_ns = self._sink.now_ns()
            for handle, taken_before in before.items():
                publisher = self._publishers.get(handle)
                number = numbers.get(publisher.endpoint.guid) if publisher else None
                if publisher is None or not number or publisher.reader is None:
                    continue  # it has written nothing since it was found
                count = publisher.numbers.missing(number, taken_before, publisher.taken)
                if count:
                    reason = "lost before the box: holes in the sequence numbers"
                    since_ns = publisher.numbers.checked_ns
                    peer = publisher.peer or self._found.process_of(publisher.endpoint)
                    self._sink.lost(publisher.topic, peer, since_ns, now_ns, count, reason)
                publisher.numbers.checked_ns = now_ns
            return all(
                p.numbers.is_exact or p.numbers.comparisons >= QUICK_COMPARISONS or not p.taken
                for p in self._publishers.values()
            )
