"""Unroll messages of any type into flat, typed columns, compiled from their definition."""

from __future__ import annotations

from amberbox.blackbox.columns import Unroller, UnrollError
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Topic

__all__ = ["UnrollError", "Unroller", "unroller"]

# a longer definition is refused; the longest of a public ROS package has 60 kB
MOST_SCHEMA_BYTES = 1 << 20


def unroller(topic: Topic, stamp: str | None = None) -> Unroller:
    """Compile the unroller of a topic from its message definition.

    ``stamp`` is the path of the message's own time stamp: None finds it (``header/stamp``), an
    empty text means that there is none. Raises ``AmberboxError`` for definitions and encodings
    that cannot be unrolled, ``UsageError`` for a stamp that a ROS message does not have. Schemas of
    ``json`` and ``msgpack`` topics are those of ``json_messages.widen_schema``.
    """
    if topic.schema is None:
        raise AmberboxError(
            f"{topic.name} has no schema, so it has no columns",
            "json and msgpack topics get theirs from their messages (unroll.infer.widen)",
        )
    try:
        if len(topic.schema.data) > MOST_SCHEMA_BYTES:
            raise AmberboxError(
                f"{topic.name}: its schema has more than {MOST_SCHEMA_BYTES >> 20} MB",
                "the messages are still recorded, but have no columns",
            )
        if topic.message_encoding in ("ros1", "cdr"):
            from amberbox.blackbox.columns.ros_messages import RosUnroller

            return RosUnroller(topic.schema, topic.message_encoding == "cdr", stamp)
        if topic.message_encoding in ("json", "msgpack"):
            from amberbox.blackbox.columns.json_messages import DocumentUnroller

            return DocumentUnroller(topic.schema, topic.message_encoding, stamp)
        encodings = topic.message_encoding, topic.schema.encoding
        if encodings == ("protobuf", "protobuf"):
            from amberbox.blackbox.columns.protobuf_messages import ProtobufUnroller

            return ProtobufUnroller(topic.schema, stamp)
        if encodings == ("frame", "amberbox_layout"):
            from amberbox.blackbox.columns.frame_layout import FrameUnroller

            return FrameUnroller(topic.schema, stamp)
        raise AmberboxError(
            f"{topic.name}: messages in {topic.message_encoding!r} cannot be unrolled",
            "they are recorded as they come; ros1, cdr, protobuf, json, msgpack and frames with a "
            "layout have columns",
        )
    except (AmberboxError, MemoryError):
        raise
    except Exception as error:  # schemas come from any sender, and any exception is possible
        raise AmberboxError(
            f"{topic.name}: its schema cannot be used: {type(error).__name__}: {error}"[:500],
            "the messages are still recorded, but have no columns",
        ) from error
