"""Unrolling: messages of any type become flat, typed columns, compiled from their definition."""

from __future__ import annotations

from amberbox.blackbox.unroll.contract import Unroller, UnrollError
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Topic

__all__ = ["UnrollError", "Unroller", "unroller"]


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
    if topic.message_encoding in ("ros1", "cdr"):
        from amberbox.blackbox.unroll.ros import RosUnroller

        return RosUnroller(topic.schema, topic.message_encoding == "cdr", stamp)
    if topic.message_encoding in ("json", "msgpack"):
        from amberbox.blackbox.unroll.documents import DocumentUnroller

        return DocumentUnroller(topic.schema, topic.message_encoding, stamp)
    raise AmberboxError(
        f"{topic.name}: messages in {topic.message_encoding!r} cannot be unrolled",
        "they are recorded as they come; ros1, cdr, json and msgpack have columns",
    )
