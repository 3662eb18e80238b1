"""What ROS 2 says of itself over DDS: which node has which endpoints, and hashes of types."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

TOPIC = "ros_discovery_info"
TYPE = "rmw_dds_common/msg/ParticipantEntitiesInfo"
MOST_NODES = 10_000  # of one process
_GID_BYTES = (16, 24)  # since Iron, until Humble
_NODE = re.compile(r"(/[A-Za-z_]\w*)+", re.ASCII)
_TYPE_HASH = re.compile(rb"(?:^|;)typehash=(RIHS01_[0-9a-f]{64});")


@dataclass(frozen=True, slots=True)
class NodeEndpoints:
    """A node, and the ids of its writers and readers as in discovery."""

    node: str
    readers: tuple[bytes, ...]
    writers: tuple[bytes, ...]


def type_hash_of(user_data: bytes) -> str:
    """Return the hash of its type that an endpoint announces; empty before Iron."""
    found = _TYPE_HASH.search(user_data)
    return found[1].decode() if found else ""


def nodes_of(message: bytes) -> tuple[bytes, list[NodeEndpoints]]:
    """Return the id of a participant and its nodes, from a message of ``ros_discovery_info``.

    Raises ValueError for bytes that are no such message.
    """
    for gid_bytes in _GID_BYTES:
        try:
            return _Reader(message, gid_bytes).participant()
        except (ValueError, struct.error):
            continue
    raise ValueError("these bytes do not describe the nodes of a participant")


class _Reader:
    """Reads CDR from its beginning to its end."""

    def __init__(self, message: bytes, gid_bytes: int) -> None:
        if len(message) < 4 or message[0] != 0 or message[1] > 1:
            raise ValueError("no plain CDR")
        self._body = memoryview(message)[4:]
        self._order = "<" if message[1] else ">"
        self._gid_bytes = gid_bytes
        self._place = 0

    def participant(self) -> tuple[bytes, list[NodeEndpoints]]:
        gid = self._gid()
        nodes = []
        for _ in range(self._count(16)):
            namespace, name = self._string(), self._string()
            readers, writers = self._gids(), self._gids()
            node = namespace.rstrip("/") + "/" + name
            if not _NODE.fullmatch(node):
                raise ValueError("no name of a node")
            nodes.append(NodeEndpoints(node, readers, writers))
        if len(self._body) - self._place > 3 or len(nodes) > MOST_NODES:
            raise ValueError("it does not end there")
        return gid, nodes

    def _gids(self) -> tuple[bytes, ...]:
        return tuple(self._gid() for _ in range(self._count(self._gid_bytes)))

    def _gid(self) -> bytes:
        return self._bytes(self._gid_bytes)[:16]

    def _string(self) -> str:
        return self._bytes(self._count(1)).rstrip(b"\0").decode()

    def _count(self, least_bytes: int) -> int:
        """Read a length; more than the rest can hold is an error."""
        self._place += -self._place % 4
        (count,) = struct.unpack(f"{self._order}I", self._bytes(4))
        if count * least_bytes > len(self._body) - self._place:
            raise ValueError("longer than the message")
        return int(count)

    def _bytes(self, count: int) -> bytes:
        found = bytes(self._body[self._place : self._place + count])
        if len(found) < count:
            raise ValueError("the message ends")
        self._place += count
        return found
