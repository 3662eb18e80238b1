"""CycloneDDS as the source ``ros2`` uses it: discovery, readers of raw CDR, sequence numbers.

The Python package reads only types that it knows in full, drops messages that do not fit them, and
says nothing of what best-effort readers miss. So readers are made with the C library in it: of a
type with one byte and without type information, which the library matches by name and does not
look into. How far a writer got is read from the library's own monitor.
"""

from __future__ import annotations

import contextlib
import ctypes
import http.client
import importlib.metadata
import json
import os
import socket
import stat
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

from amberbox.core.errors import AmberboxError

VERSIONS = ("11.0.",)  # with the functions of C and the answer of the monitor used here
MOST_PARTICIPANTS = 100  # of one host, found without multicast
MOST_WAITING = 5000  # messages of a topic in the library until they are taken
MOST_LATCHED = 1000  # of one writer
ANNOUNCED_S = 3  # a robot that was cut off answers the announcement, and is found again at once
_BATCH = 256  # samples taken at once
_SMALL_BYTES = 65536
_ONE_BYTE, _ANY = 0x01010000, 0x7F
_ALIVE = 16
_MONITOR_ANSWER_MB = 64


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A writer or reader on the network. ``handle`` is what samples name their writer by."""

    handle: int
    guid: str  # as the monitor writes it
    gid: bytes  # the same as ROS 2 writes it
    participant: str
    is_writer: bool
    topic: str
    type_name: str
    reliable: bool  # repeats what was lost, for those who ask
    latched: bool  # offers what it sent before
    keyed: bool
    user_data: bytes
    only_xcdr2: bool
    type_id: Any = None


@dataclass(frozen=True, slots=True)
class ReaderQos:
    """How a reader reads: ``latched`` also what was sent before, then it is ``reliable``.

    ``depth`` is how many messages the library keeps until they are taken; None is plenty.
    """

    latched: bool = False
    reliable: bool = False
    depth: int | None = None


@dataclass(frozen=True, slots=True)
class Participated:
    """A process on the network, by its participant; its names may be empty.

    When nothing was heard of it for its lease, it is taken for gone.
    """

    handle: int
    guid: str
    gid: bytes
    process: str
    host: str
    lease_ns: int


@dataclass(frozen=True, slots=True)
class Gone:
    """What left, or is of a participant that was not heard of for its lease."""

    handle: int


@dataclass(frozen=True, slots=True)
class Sample:
    """One message; ``data`` is None for what has no value, as the end of an instance."""

    writer: int
    source_ns: int
    data: bytes | None


def require_cyclonedds() -> None:
    """Raise AmberboxError if the installed package is not one that this module knows."""
    try:
        version = importlib.metadata.version("cyclonedds")
    except importlib.metadata.PackageNotFoundError:
        raise AmberboxError(
            "the package cyclonedds is not installed here",
            "pip install 'amberbox[ros2-dds]', or use 'via: zenoh' or 'via: bridge'",
        ) from None
    if not version.startswith(VERSIONS):
        raise AmberboxError(
            f"the package cyclonedds {version} is not one that this version works with",
            "pip install 'amberbox[ros2-dds]', which chooses one",
        )


def configuration(
    interface: str, peers: Sequence[str], multicast: bool, longest_message: int
) -> str:
    """Return the XML configuration of CycloneDDS.

    ``interface`` is a name or an address, empty for the library's choice. Without multicast only
    ``peers`` are asked, and those on this host.
    """
    which = 'autodetermine="true"'
    if interface:
        key = "address" if _is_address(interface) else "name"
        which = f"{key}={quoteattr(interface)}"
    asked = [*peers] if multicast else ["localhost", *peers]
    addresses = "".join(f"<Peer Address={quoteattr(peer)}/>" for peer in asked)
    index = "auto" if asked else "default"
    return f"""<CycloneDDS><Domain Id="any">
      <General>
        <Interfaces><NetworkInterface {which} multicast="{_word(multicast)}"/></Interfaces>
        <AllowMulticast>{_word(multicast)}</AllowMulticast>
      </General>
      <Discovery>
        <ParticipantIndex>{index}</ParticipantIndex>
        <MaxAutoParticipantIndex>{MOST_PARTICIPANTS}</MaxAutoParticipantIndex>
        <SPDPInterval>{ANNOUNCED_S}s</SPDPInterval>
        <Peers>{addresses}</Peers>
      </Discovery>
      <Internal>
        <SocketReceiveBufferSize max="64MB"/>
        <MaxSampleSize>{longest_message} B</MaxSampleSize>
        <MonitorPort>0</MonitorPort>
      </Internal>
      <Tracing><Verbosity>warning</Verbosity><OutputFile>stderr</OutputFile></Tracing>
    </Domain></CycloneDDS>"""


def _word(value: bool) -> str:
    return "true" if value else "false"


def _is_address(text: str) -> bool:
    try:
        socket.inet_pton(socket.AF_INET6 if ":" in text else socket.AF_INET, text)
    except OSError:
        return False
    return True


class _SampleInfo(ctypes.Structure):
    _fields_ = (
        ("sample_state", ctypes.c_uint),
        ("view_state", ctypes.c_uint),
        ("instance_state", ctypes.c_uint),
        ("valid_data", ctypes.c_bool),
        ("source_timestamp", ctypes.c_int64),
        ("instance_handle", ctypes.c_uint64),
        ("publication_handle", ctypes.c_uint64),
        ("disposed_generation_count", ctypes.c_uint32),
        ("no_writers_generation_count", ctypes.c_uint32),
        ("sample_rank", ctypes.c_uint32),
        ("generation_rank", ctypes.c_uint32),
        ("absolute_generation_rank", ctypes.c_uint32),
    )


class _KeyDescriptor(ctypes.Structure):
    _fields_ = (("name", ctypes.c_char_p), ("offset", ctypes.c_uint32), ("index", ctypes.c_uint32))


class _TopicDescriptor(ctypes.Structure):
    _fields_ = (
        ("size", ctypes.c_uint32),
        ("align", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("key_count", ctypes.c_uint32),
        ("type_name", ctypes.c_char_p),
        ("keys", ctypes.POINTER(_KeyDescriptor)),
        ("op_count", ctypes.c_uint32),
        ("ops", ctypes.POINTER(ctypes.c_uint32)),
        ("meta", ctypes.c_char_p),
        ("type_information", ctypes.c_void_p),
        ("type_information_size", ctypes.c_uint32),
        ("type_mapping", ctypes.c_void_p),
        ("type_mapping_size", ctypes.c_uint32),
        ("data_representation", ctypes.c_uint32),
        ("member_table", ctypes.c_uint32),
    )


def _descriptor(type_name: str, keyed: bool) -> _TopicDescriptor:
    """Return the description of a type that begins with one byte, the rest being unknown.

    Writers of a type with a key match no reader without one: then the byte is the key. It only
    sorts the messages of a reader that keeps them all.
    """
    ops = [_ONE_BYTE, 0, 0]
    keys = None
    if keyed:
        ops = [_ONE_BYTE | 1, 0, 0, 0x07000001, 0]
        keys = (_KeyDescriptor * 1)(_KeyDescriptor(b"k", 3, 0))
    return _TopicDescriptor(
        size=1,
        align=1,
        key_count=int(keyed),
        type_name=type_name.encode(),
        keys=keys,
        op_count=len(ops),
        ops=(ctypes.c_uint32 * len(ops))(*ops),
        meta=b"",
    )


class RawReader:
    """A reader of one topic and type that gives each message as the bytes that were sent."""

    def __init__(self, library: Any, topic: int, reader: int) -> None:
        self.handle = reader
        self._library = library
        self._topic = topic
        self._is_closed = False
        self._samples = (ctypes.c_void_p * _BATCH)()
        self._infos = (_SampleInfo * _BATCH)()
        self._buffer = ctypes.create_string_buffer(_SMALL_BYTES)
        # room for a long message that is not filled with zeros first
        make = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.c_char_p, ctypes.c_ssize_t)
        self._new_bytes: Any = make(("PyBytes_FromStringAndSize", ctypes.pythonapi))

    def take(self) -> list[Sample]:
        """Return what has arrived, at most 256 messages; never waits.

        Nothing of a closed reader: a wait may have returned it just before it was closed.
        """
        if self._is_closed:
            return []
        library, infos = self._library, self._infos
        count = library.dds_takecdr(self.handle, self._samples, _BATCH, infos, _ANY)
        if count < 0:
            raise AmberboxError(f"CycloneDDS: taking messages failed ({count})")
        taken = []
        for place in range(count):
            serialized, info = self._samples[place], infos[place]
            data = self._bytes(serialized) if info.valid_data else None
            library.ddsi_serdata_unref(serialized)
            taken.append(Sample(info.publication_handle, info.source_timestamp, data))
        return taken

    def _bytes(self, serialized: int | None) -> bytes:
        size = self._library.ddsi_serdata_size(serialized)
        if size <= _SMALL_BYTES:
            self._library.ddsi_serdata_to_ser(serialized, 0, size, self._buffer)
            data = ctypes.string_at(self._buffer, size)
        else:
            data = self._new_bytes(None, size)
            self._library.ddsi_serdata_to_ser(serialized, 0, size, data)
        padding = data[3] & 3  # of the datagram, by the options of the encapsulation
        return data[:-padding] if padding and size > 4 + padding else data

    def close(self) -> None:
        """Delete the reader and its topic."""
        self._is_closed = True
        self._library.dds_delete(self.handle)
        self._library.dds_delete(self._topic)


class Participant:
    """A participant of a domain: it is seen by others, and writes nothing but discovery."""

    def __init__(self, domain: int, xml: str) -> None:
        """Raises AmberboxError if the domain cannot be opened, as for a wrong interface."""
        require_cyclonedds()
        from cyclonedds import builtin
        from cyclonedds.core import (
            DDSException,
            InstanceState,
            ReadCondition,
            SampleState,
            ViewState,
        )
        from cyclonedds.domain import Domain, DomainParticipant

        listening = _listening_sockets()
        try:
            self._domain = Domain(domain, xml)
            self.participant = DomainParticipant(domain)
        except DDSException as error:
            raise AmberboxError(
                f"CycloneDDS cannot open domain {domain}: {error}",
                "compare 'interface' and 'peers' with the network: ip address",
            ) from None
        self._monitor = _guarded_monitor(listening)
        self._library = _library()
        self._messages = self._wait_set()
        self._news = self._wait_set()
        self._builtin = {
            kind: builtin.BuiltinDataReader(self.participant, topic)
            for kind, topic in (
                ("participant", builtin.BuiltinTopicDcpsParticipant),
                ("writer", builtin.BuiltinTopicDcpsPublication),
                ("reader", builtin.BuiltinTopicDcpsSubscription),
            )
        }
        mask = ViewState.Any | SampleState.NotRead | InstanceState.Any
        self._conditions = [ReadCondition(one, mask) for one in self._builtin.values()]
        for condition in self._conditions:
            self._library.dds_waitset_attach(self._news, condition._ref, 0)
        self._open: dict[int, RawReader] = {}
        self._own = _monitor_name(self.participant.guid.bytes)

    def __enter__(self) -> Participant:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the domain; others are told."""
        self._library.dds_delete(self.participant._ref)
        self._library.dds_delete(self._domain._ref)

    def wait_for_news(self, timeout_s: float) -> bool:
        """Wait until ``discovered`` has something; return whether it has."""
        count = self._library.dds_waitset_wait(self._news, None, 0, round(timeout_s * 1e9))
        return bool(count > 0)

    def wait_for_messages(self, timeout_s: float) -> list[RawReader]:
        """Wait until a watched reader has something; return those that have."""
        tags = (ctypes.c_void_p * (len(self._open) + 1))()
        nanoseconds = round(timeout_s * 1e9)
        count = self._library.dds_waitset_wait(self._messages, tags, len(tags), nanoseconds)
        found = (self._open.get(tag or 0) for tag in tags[: max(0, min(count, len(tags)))])
        return [reader for reader in found if reader is not None]

    def discovered(self) -> Iterator[Endpoint | Participated | Gone]:
        """Yield what came and went since the last call.

        An endpoint with names that are no text is left out.
        """
        for kind, builtin_reader in self._builtin.items():
            while True:
                try:
                    samples = builtin_reader.take(1)  # what cannot be read costs all of one call
                except Exception:  # the package raises what it meets in foreign data
                    continue
                if not samples:
                    break
                found = self._found(kind, samples[0])
                if found is not None:
                    yield found

    def _found(self, kind: str, sample: Any) -> Endpoint | Participated | Gone | None:
        from cyclonedds.core import Policy

        info, qos = sample.sample_info, sample.qos
        if info.instance_state != _ALIVE:
            return Gone(info.instance_handle)
        if qos is None:
            return None
        if kind == "participant":
            properties = {one.key: one.value for one in qos if isinstance(one, Policy.Property)}
            liveliness = qos[Policy.Liveliness]
            return Participated(
                handle=info.instance_handle,
                guid=_monitor_name(sample.key.bytes),
                gid=sample.key.bytes,
                process=properties.get("__ProcessName", ""),
                host=properties.get("__Hostname", ""),
                lease_ns=liveliness.lease_duration if liveliness else 0,
            )
        participant = _monitor_name(sample.participant_key.bytes)
        if participant == self._own or sample.topic_name is None:
            return None
        user_data, representation = qos[Policy.Userdata], qos[Policy.DataRepresentation]
        return Endpoint(
            handle=info.instance_handle,
            guid=_monitor_name(sample.key.bytes),
            gid=sample.key.bytes,
            participant=participant,
            is_writer=kind == "writer",
            topic=sample.topic_name,
            type_name=sample.type_name or "",
            reliable=isinstance(qos[Policy.Reliability], Policy.Reliability.Reliable),
            latched=qos[Policy.Durability] not in (None, Policy.Durability.Volatile),
            keyed=sample.key.bytes[15] & 0x0F in (0x02, 0x07),
            user_data=bytes(user_data.data) if user_data else b"",
            only_xcdr2=bool(representation) and not representation.use_cdrv0_representation,
            type_id=sample.type_id,
        )

    def open_reader(self, topic: str, type_name: str, keyed: bool, wanted: ReaderQos) -> RawReader:
        """Create a reader.

        A best-effort reader costs its writers no more than the datagrams and never slows them.
        Raises AmberboxError if the library refuses.
        """
        from cyclonedds.qos import _CQos

        conversion: Any = _CQos
        qos = _reader_qos(wanted)
        descriptor = _descriptor(type_name, keyed)
        library, participant = self._library, self.participant._ref
        made = library.dds_create_topic(participant, descriptor, topic.encode(), None, None)
        if made < 0:
            raise AmberboxError(f"CycloneDDS refuses the topic {topic} of {type_name} ({made})")
        native_qos = conversion.qos_to_cqos(qos)
        try:
            reader = library.dds_create_reader(participant, made, native_qos, None)
        finally:
            conversion.cqos_destroy(native_qos)
        if reader < 0:
            library.dds_delete(made)
            raise AmberboxError(f"CycloneDDS refuses a reader of {topic} ({reader})")
        return RawReader(library, made, reader)

    def watch(self, reader: RawReader) -> None:
        """Let ``wait`` return a reader when it has something."""
        condition = self._library.dds_create_readcondition(reader.handle, _ANY)
        self._open[reader.handle] = reader
        self._library.dds_waitset_attach(self._messages, condition, reader.handle)

    def close_reader(self, reader: RawReader) -> None:
        """Delete a reader; what it holds is lost."""
        self._open.pop(reader.handle, None)
        reader.close()

    def type_object(self, endpoint: Endpoint, timeout_s: float) -> tuple[Any, Mapping[str, Any]]:
        """Return the type of an endpoint with those in it, asked of its participant if necessary.

        Raises AmberboxError if it does not answer, or with what is no type.
        """
        from cyclonedds.core import DDSException
        from cyclonedds.dynamic import get_types_for_typeid

        try:
            return get_types_for_typeid(self.participant, endpoint.type_id, round(timeout_s * 1e9))
        except DDSException as error:
            raise AmberboxError(f"its participant does not describe the type: {error}") from None
        except Exception as error:  # a type of any content: the package checks none of it
            raise AmberboxError(f"its participant describes no type: {error!r}") from None

    def last_sequences(self) -> Mapping[str, int]:
        """Return the sequence number up to which each writer is known to have written, by guid.

        Raises AmberboxError if the monitor does not answer.
        """
        connection = http.client.HTTPConnection("127.0.0.1", self._monitor, timeout=10)
        try:
            connection.request("GET", "/")
            answer = connection.getresponse().read(_MONITOR_ANSWER_MB << 20)
            found = json.loads(answer)
            return {
                writer["guid"]: int(writer["last_seq"])
                for participant in found["proxy_participants"]
                for writer in participant["proxy_writers"]
            }
        except (OSError, http.client.HTTPException, ValueError, KeyError, TypeError) as error:
            raise AmberboxError(f"the monitor of CycloneDDS does not answer: {error!r}") from None
        finally:
            connection.close()

    def _wait_set(self) -> int:
        return int(self._library.dds_create_waitset(self.participant._ref))


def _reader_qos(wanted: ReaderQos) -> Any:
    from cyclonedds.core import Policy, Qos

    reliable = wanted.reliable or wanted.latched
    depth = wanted.depth or (MOST_LATCHED if wanted.latched else MOST_WAITING)
    qos = Qos(
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Reliability.Reliable(0) if reliable else Policy.Reliability.BestEffort,
    )
    if wanted.latched:
        qos += Qos(Policy.Durability.TransientLocal)
    if reliable or wanted.depth:
        # a reliable reader that is full would keep its writers waiting: the oldest goes
        return qos + Qos(Policy.History.KeepLast(depth))
    return qos + Qos(Policy.History.KeepAll, Policy.ResourceLimits(depth, -1, -1))


def _monitor_name(guid: bytes) -> str:
    return ":".join(f"{word:x}" for word in struct.unpack(">4I", guid))


def _library() -> Any:
    """Return the C library of the package, with prototypes of the functions used."""
    from cyclonedds.internal import DDS

    # not the object of the package: it has set prototypes of its own
    library = ctypes.CDLL(DDS._dll_handle._name)
    entity, pointer, size = ctypes.c_int32, ctypes.c_void_p, ctypes.c_size_t
    number = ctypes.c_uint32
    descriptor = ctypes.POINTER(_TopicDescriptor)
    prototypes: Mapping[str, tuple[Any, ...]] = {
        "dds_create_topic": (entity, entity, descriptor, ctypes.c_char_p, pointer, pointer),
        "dds_create_reader": (entity, entity, entity, pointer, pointer),
        "dds_create_waitset": (entity, entity),
        "dds_create_readcondition": (entity, entity, number),
        "dds_waitset_attach": (entity, entity, entity, pointer),
        "dds_waitset_wait": (entity, entity, pointer, size, ctypes.c_int64),
        "dds_takecdr": (entity, entity, pointer, number, pointer, number),
        "dds_delete": (entity, entity),
        "ddsi_serdata_size": (number, pointer),
        "ddsi_serdata_to_ser": (None, pointer, size, size, ctypes.c_char_p),
        "ddsi_serdata_unref": (None, pointer),
    }
    for name, (result, *arguments) in prototypes.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


_SO_ATTACH_FILTER = 26
# classic BPF: keep packets whose source (IPv4) is 127.0.0.0/8, drop all others
_FROM_THIS_HOST = (
    (0x20, 0, 0, 0xFFF00000 + 12),
    (0x54, 0, 0, 0xFF000000),
    (0x15, 0, 1, 0x7F000000),
    (0x06, 0, 0, 0xFFFFFFFF),
    (0x06, 0, 0, 0),
)


def _listening_sockets() -> dict[int, int]:
    """Return the TCP sockets of this process that listen: file descriptor and port."""
    found = {}
    for place in list(Path("/proc/self/fd").iterdir()):
        descriptor = int(place.name)
        with contextlib.suppress(OSError):
            if stat.S_ISSOCK(os.fstat(descriptor).st_mode):
                with socket.socket(fileno=os.dup(descriptor)) as one:
                    if one.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN):
                        found[descriptor] = int(one.getsockname()[1])
    return found


def _guarded_monitor(before: Mapping[int, int]) -> int:
    """Return the port of the library's monitor, closed to other hosts.

    It listens at all addresses, and knows no other way: packets of others never reach it.
    Raises AmberboxError if there is none.
    """
    new = {fd: port for fd, port in _listening_sockets().items() if fd not in before}
    if len(new) != 1:
        raise AmberboxError("CycloneDDS has not opened its monitor, or it cannot be found")
    ((fd, port),) = new.items()
    code = b"".join(struct.pack("HBBI", *line) for line in _FROM_THIS_HOST)
    buffer = ctypes.create_string_buffer(code)
    program = struct.pack("HP", len(_FROM_THIS_HOST), ctypes.addressof(buffer))
    with socket.socket(fileno=os.dup(fd)) as monitor:
        monitor.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, program)
    return port
