"""The reserved channels ``amberbox/...``: JSON, schema published (docs/reference/format.md)."""

from __future__ import annotations

import msgspec

from amberbox.blackbox.columns.json_schema import EXACT_COMMENT
from amberbox.core.types import Schema, Topic

PREFIX = "amberbox/"
SOURCE = "amberbox"

RUN = "amberbox/run"
CLOCK = "amberbox/clock"
COUNTERS = "amberbox/counters"
EVENT = "amberbox/event"
GAP = "amberbox/gap"
INCIDENT = "amberbox/incident"
MISSION = "amberbox/mission"
STATUS = "amberbox/status"
ALARM = "amberbox/alarm"
SYMPTOM = "amberbox/symptom"
DIAGNOSIS = "amberbox/diagnosis"
COMMAND = "amberbox/command"
EXPERIMENT = "amberbox/experiment"
# how far the writer of a derived journal had read others when it wrote the records beside it
CURSOR = "amberbox/cursor"

_TEXT: dict[str, object] = {"type": "string"}
_COUNT: dict[str, object] = {"type": "integer"}
_NUMBER: dict[str, object] = {"type": "number"}
_NUMBER_IF_ANY: dict[str, object] = {"type": ["number", "null"]}
_COUNT_IF_ANY: dict[str, object] = {"type": ["integer", "null"]}


def _list_of(**fields: dict[str, object]) -> dict[str, object]:
    return {"type": "array", "items": {"type": "object", "properties": fields}}


_TEXTS: dict[str, object] = {"type": "array", "items": _TEXT}
_FIELDS: dict[str, dict[str, object]] = {
    RUN: {
        "writer": _TEXT,
        "run": _COUNT,
        "store_id": _TEXT,
        "boot_id": _TEXT,
        "robot": _TEXT,
        "config_hash": _TEXT,
        "version": _TEXT,
        "items": _TEXT,
        "input": _TEXT,
    },
    CLOCK: {
        "offset_ns": _COUNT,
        "synchronised": {"type": ["boolean", "null"]},
        "boot_ns": _COUNT_IF_ANY,
    },
    COUNTERS: {
        "items": _list_of(
            item=_TEXT,
            received=_COUNT,
            kept=_COUNT,
            rate_limited=_COUNT,
            unchanged=_COUNT,
            dropped=_COUNT,
            bytes=_COUNT,
            last_received_ns=_COUNT,
            lost=_COUNT,
        ),
        "stalled_from_ns": _COUNT_IF_ANY,
        "stalled_to_ns": _COUNT_IF_ANY,
        "complete_ns": _COUNT_IF_ANY,
    },
    EVENT: {"kind": _TEXT, "text": _TEXT, "source": _TEXT, "details": _TEXT},
    GAP: {
        "item": _TEXT,
        "peer": _TEXT,
        "from_ns": _COUNT,
        "to_ns": _COUNT_IF_ANY,
        "reason": _TEXT,
        "count": _COUNT_IF_ANY,
    },
    INCIDENT: {
        "id": _TEXT,
        "state": _TEXT,
        "reason": _TEXT,
        "who": _TEXT,
        "trigger": _TEXT,
        "from_ns": _COUNT,
        "to_ns": _COUNT,
    },
    MISSION: {
        "id": _TEXT,
        "name": _TEXT,
        "state": _TEXT,
        "outcome": _TEXT,
        "from_ns": _COUNT,
        "to_ns": _COUNT_IF_ANY,
        "who": _TEXT,
        "details": _TEXT,
    },
    STATUS: {
        "robot": _TEXT,
        "component": _TEXT,
        "mode": _TEXT,
        "level": _TEXT,
        "state": _TEXT,
        "outputs": _list_of(
            name=_TEXT,
            type=_TEXT,
            value={"type": ["number", "null"]},
            text={"type": ["string", "null"]},
        ),
        "blocked_by": _TEXTS,
        "measured_ns": _COUNT,
        "since_ns": _COUNT,
        "reason": _TEXT,
        "config_hash": _TEXT,
        "live_only": {"type": "boolean"},
    },
    ALARM: {
        "id": _TEXT,
        "robot": _TEXT,
        "component": _TEXT,
        "severity": _TEXT,
        "state": _TEXT,
        "level": _TEXT,
        "reason": _TEXT,
        "opened_ns": _COUNT,
        "changed_ns": _COUNT,
        "count": _COUNT,
        "who": _TEXT,
        "until_ns": _COUNT_IF_ANY,
        "cause": _TEXT,
        "diagnosis": _TEXT,
        "config_hash": _TEXT,
        "live_only": {"type": "boolean"},
        "also": _TEXTS,
        "note": _TEXT,
        "said_ns": _COUNT_IF_ANY,
        "command": _TEXT,
    },
    SYMPTOM: {
        "id": _TEXT,
        "state": _TEXT,
        "address": _TEXT,
        "onset_ns": _COUNT_IF_ANY,
        "confirmed_ns": _COUNT_IF_ANY,
        "strength": _NUMBER,
        "source": _TEXT,
        "evidence": _list_of(address=_TEXT, from_ns=_COUNT, to_ns=_COUNT),
        "blocked_by": _TEXTS,
        "reason": _TEXT,
        "size": _NUMBER_IF_ANY,
    },
    DIAGNOSIS: {
        "id": _TEXT,
        "revision": _COUNT,
        "robot": _TEXT,
        "at_ns": _COUNT,
        "state": _TEXT,
        "symptoms": _TEXTS,
        "hypotheses": _list_of(
            id=_TEXT,
            faults=_TEXTS,
            probability=_NUMBER,
            explains=_TEXTS,
            unexplained=_TEXTS,
            contradicted=_TEXTS,
            ambiguity=_TEXTS,
            proof=_TEXT,
            criticality=_NUMBER,
            follows=_TEXTS,
        ),
        "groups": _list_of(members=_TEXTS, probability=_NUMBER, wider=_TEXTS, split_by=_TEXT),
        "mass_covered": _NUMBER,
        "incomplete": _TEXT,
        "findings": _TEXTS,
        "next_tests": _list_of(
            id=_TEXT,
            kind=_TEXT,
            text=_TEXT,
            role=_TEXT,
            cost_s=_NUMBER,
            risk=_NUMBER,
            gain_bits=_NUMBER,
            outcomes=_list_of(answer=_TEXT, probability=_NUMBER),
            run=_TEXT,
            moves={"type": "boolean"},
        ),
        "config_hash": _TEXT,
        "live_only": {"type": "boolean"},
        "make_safe": _TEXTS,
        "asked": _TEXTS,
    },
    COMMAND: {
        "robot": _TEXT,
        "state": _TEXT,
        "id": _TEXT,
        "text": _TEXT,
        "person": _TEXT,
        "action": _TEXT,
        "parameters": _TEXT,
        "risk": _TEXT,
        "issuer": _TEXT,
        "run": _TEXT,
        "step": _TEXT,
        "result": _TEXT,
    },
    EXPERIMENT: {
        "run": _TEXT,
        "experiment": _TEXT,
        "sha256": _TEXT,
        "robot": _TEXT,
        "number": _COUNT,
        "at_ns": _COUNT,
        "kind": _TEXT,
        "element": _TEXT,
        "task": _TEXT,
        "who": _TEXT,
        "text": _TEXT,
        "values": _TEXT,
    },
    CURSOR: {"cursor": _TEXT, "reader": _TEXT, "state": _TEXT},
}


def schema_of(name: str) -> Schema:
    """Return the JSON Schema of a reserved channel."""
    marks = {"$comment": EXACT_COMMENT, "title": name}
    document = {**marks, "type": "object", "properties": _FIELDS[name]}
    return Schema(name, "jsonschema", msgspec.json.encode(document))


def topic_of(name: str) -> Topic:
    """Return the topic of a reserved channel for MCAP.

    It has no MCAP schema, because readers that support only ROS 2 refuse files with other schemas.
    """
    return Topic(name, "json", None)


def names() -> list[str]:
    """Return the names of all reserved channels."""
    return list(_FIELDS)
