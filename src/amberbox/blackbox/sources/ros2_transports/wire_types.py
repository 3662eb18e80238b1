"""Definitions that publishers send with DDS discovery, where they do."""

from __future__ import annotations

from amberbox.blackbox.columns.ros2_types import type_hash
from amberbox.blackbox.sources.ros2_transports.cyclone import Endpoint, Participant
from amberbox.blackbox.sources.ros2_transports.recorded_topics import RecordedTopics
from amberbox.blackbox.sources.ros2_transports.xtypes import schema_of_type
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Schema

ANSWER_S = 1.0  # a participant describes its types within milliseconds


class WireTypes:
    """Asks participants for the types of their writers, each type once."""

    def __init__(self, participant: Participant, recorded: RecordedTopics) -> None:
        self._participant = participant
        self._recorded = recorded
        self._known: dict[tuple[str, str, str], Schema | None] = {}

    def schema(self, endpoint: Endpoint, type_name: str, wanted_hash: str) -> Schema | None:
        """Return the definition on the wire; None where one of the same hash is known, or none.

        A known one is better: it has constants, too.
        """
        if endpoint.type_id is None or self._recorded.knows(type_name, wanted_hash):
            return None
        key = (type_name, wanted_hash, repr(endpoint.type_id))
        if key not in self._known:
            self._known[key] = self._ask(endpoint, type_name, wanted_hash)
        return self._known[key]

    def _ask(self, endpoint: Endpoint, type_name: str, wanted_hash: str) -> Schema | None:
        try:
            root, _ = self._participant.type_object(endpoint, ANSWER_S)
            schema = schema_of_type(root)
            found_hash = type_hash(schema)
        except AmberboxError as error:
            text = f"{type_name}: {error}; the definitions known here are used"
            self._recorded.report_once(("wire", type_name), "ros2_type_not_sent", text)
            return None
        if schema.name != type_name:
            return None
        if wanted_hash and wanted_hash != found_hash:
            text = f"{type_name}: the type that is sent has not the hash that is announced"
            self._recorded.report_once(("hash", type_name), "ros2_type_hash_differs", text)
        return None if self._recorded.knows(type_name, found_hash) else schema
