"""Unrolling: messages of any type become flat, typed columns, compiled from their definition."""

from __future__ import annotations

from amberbox.blackbox.unroll.contract import Unroller, UnrollError
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Schema, Topic

__all__ = ["UnrollError", "Unroller", "unroller"]

MOST_SCHEMA_BYTES = 1 << 20
"""A longer definition is none: the longest of a public ROS package has 60 kB."""


def unroller(topic: Topic, stamp: str | None = None) -> Unroller:
    """Compile the unroller of a topic from its message definition.

    ``stamp`` is the path of the message's own time stamp: None finds it (``header/stamp``), an
    empty text means that there is none. Raises ``AmberboxError`` for definitions and encodings
    that cannot be unrolled, ``UsageError`` for a stamp that a ROS message does not have. Schemas of
    ``json`` and ``msgpack`` topics are those that ``infer.widen`` makes.
    """
    if topic.schema is None:
        raise AmberboxError(
            f"{topic.name} has no schema, so it has no columns",
            "json and msgpack topics get theirs from their messages (unroll.infer.widen)",
        )
    try:
        return _compiled(topic, topic.schema, stamp)
    except (AmberboxError, MemoryError):
        raise
    except Exception as error:  # schemas come from anybody, and fail in any way that text can
        raise AmberboxError(
            f"{topic.name}: its schema cannot be used: {type(error).__name__}: {error}"[:500],
            "the messages are still recorded, but have no columns",
        ) from error


def _compiled(topic: Topic, schema: Schema, stamp: str | None) -> Unroller:
    if len(schema.data) > MOST_SCHEMA_BYTES:
        raise AmberboxError(
            f"{topic.name}: its schema has more than {MOST_SCHEMA_BYTES >> 20} MB",
            "the messages are still recorded, but have no columns",
        )
    if topic.message_encoding in ("ros1", "cdr"):
        from amberbox.blackbox.unroll.ros import RosUnroller

        return RosUnroller(schema, topic.message_encoding == "cdr", stamp)
    if topic.message_encoding in ("json", "msgpack"):
        from amberbox.blackbox.unroll.documents import DocumentUnroller

        return DocumentUnroller(schema, topic.message_encoding, stamp)
    raise AmberboxError(
        f"{topic.name}: messages in {topic.message_encoding!r} cannot be unrolled",
        "they are recorded as they come; ros1, cdr, json and msgpack have columns",
    )
