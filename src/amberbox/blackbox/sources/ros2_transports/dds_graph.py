"""What DDS discovery has told so far: processes, nodes, topics and services."""

from __future__ import annotations

from collections import defaultdict

from amberbox.blackbox.sources.ros2_transports import discovery_info, names
from amberbox.blackbox.sources.ros2_transports.cyclone import Endpoint, Gone, Participated
from amberbox.core.robot_graph import GraphService, GraphTopic, RobotGraph

MOST_ENTITIES = 50_000
_USUAL_LEASE_NS = 20_000_000_000  # of a participant that is not known
_LONGEST_LEASE_NS = 600_000_000_000
_LONGEST_NAME = 100


class Discovered:
    """Endpoints by their handles, and the nodes they belong to."""

    def __init__(self) -> None:
        self._endpoints: dict[int, Endpoint] = {}
        self._participants: dict[int, Participated] = {}
        self._by_guid: dict[str, Participated] = {}
        self._nodes: dict[bytes, list[discovery_info.NodeEndpoints]] = {}
        self._node_of: dict[bytes, str] = {}

    def add(self, one: Endpoint | Participated | Gone) -> None:
        """Take note of what came or went."""
        if isinstance(one, Gone):
            self._endpoints.pop(one.handle, None)
            participant = self._participants.pop(one.handle, None)
            if participant is not None:
                self._by_guid.pop(participant.guid, None)
                self.forget_nodes(participant.gid)
        elif len(self._endpoints) + len(self._participants) >= MOST_ENTITIES:
            return
        elif isinstance(one, Endpoint):
            self._endpoints[one.handle] = one
        else:
            self._participants[one.handle] = one
            self._by_guid[one.guid] = one

    def tell_nodes(self, message: bytes) -> None:
        """Take note of a message of ``ros_discovery_info``; others are ignored."""
        try:
            participant, nodes = discovery_info.nodes_of(message)
        except ValueError:
            return
        self.forget_nodes(participant)
        if len(self._nodes) < MOST_ENTITIES:
            self._nodes[participant] = nodes
            for node in nodes:
                for gid in (*node.readers, *node.writers):
                    self._node_of[gid] = node.node

    def forget_nodes(self, participant: bytes) -> None:
        """Forget the nodes of a participant that left or has others now."""
        for node in self._nodes.pop(participant, ()):
            for gid in (*node.readers, *node.writers):
                self._node_of.pop(gid, None)

    def node_of(self, endpoint: Endpoint) -> str:
        """Return the node of an endpoint; empty while it is unknown."""
        return self._node_of.get(endpoint.gid, "")

    def process_of(self, endpoint: Endpoint) -> str:
        """Return what there is to name an endpoint of no known node by."""
        found = self._by_guid.get(endpoint.participant)
        if found is None or not found.process.isprintable() or not found.host.isprintable():
            return f"participant {endpoint.participant}"
        named = f"{found.process}@{found.host}"[:_LONGEST_NAME]
        return named if found.process and found.host else f"participant {endpoint.participant}"

    def lease_ns(self, participant: str) -> int:
        """Return after which time without a sign of life a participant is taken for gone, ns."""
        found = self._by_guid.get(participant)
        return min(found.lease_ns if found else _USUAL_LEASE_NS, _LONGEST_LEASE_NS)

    def nodes(self) -> set[str]:
        """Return the nodes that processes tell of and that are there now."""
        return {node.node for told in self._nodes.values() for node in told}

    def graph(self) -> RobotGraph:
        """Return what is there now; endpoints of no known node go by their process."""
        publishers: dict[str, set[str]] = defaultdict(set)
        subscribers: dict[str, set[str]] = defaultdict(set)
        types: dict[str, str] = {}
        services = set()
        for endpoint in self._endpoints.values():
            carried = names.endpoint_of_dds(endpoint.topic)
            type_name = names.type_of_dds(endpoint.type_name)
            if carried is None or not type_name:
                continue
            node = self.node_of(endpoint)
            if carried.kind == "topic":
                types.setdefault(carried.name, type_name)
                ends = publishers if endpoint.is_writer else subscribers
                ends[carried.name].add(node or self.process_of(endpoint))
            elif carried.kind == "request" and not endpoint.is_writer:
                served = type_name.removesuffix("_Request")
                services.add(GraphService(carried.name, served, node))
        topics = (
            GraphTopic(
                name, types[name], tuple(sorted(publishers[name])), tuple(sorted(subscribers[name]))
            )
            for name in sorted(types)
        )
        ordered = sorted(services, key=lambda one: (one.name, one.type, one.node))
        return RobotGraph(tuple(sorted(self.nodes())), tuple(topics), tuple(ordered))
