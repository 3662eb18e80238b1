"""Answers that people give to tests of a diagnosis, as events in the record of the watcher.

They are inputs of the diagnosis: the tracker reads them from the record, live and in replay.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta, Struct

from amberbox.core.types import Batch

KIND: Final = "diagnosis_answer"
"""Kind of these events."""
ITEM: Final = "amberbox_event"
"""The item of all events."""


class RecordedAnswer(Struct, frozen=True):
    """What a test of a diagnosis gave, and who said so; ``command`` is the server's command."""

    diagnosis: Annotated[str, Meta(max_length=300)]
    test: Annotated[str, Meta(max_length=300)]
    answer: Annotated[str, Meta(max_length=300)]
    who: Annotated[str, Meta(max_length=128)] = ""
    command: Annotated[str, Meta(max_length=32)] = ""


_DECODER: msgspec.json.Decoder[RecordedAnswer] = msgspec.json.Decoder(RecordedAnswer)


def answer_event(given: RecordedAnswer, source: str) -> Mapping[str, Any]:
    """Return the values of the event that an answer is recorded as."""
    text = f"{given.who or 'somebody'} answered {given.test}: {given.answer}"
    details = msgspec.json.encode(given).decode()
    return {"kind": KIND, "text": text, "source": source, "details": details}


def answer_of(values: Mapping[str, Any]) -> RecordedAnswer | None:
    """Return the answer that an event records; None for any other event."""
    if values.get("kind") != KIND:
        return None
    try:
        return _DECODER.decode(str(values.get("details")))
    except msgspec.MsgspecError:
        return None


def answers_in(batch: Batch) -> Iterator[tuple[int, RecordedAnswer]]:
    """Yield the answers among rows of events, each with its log time (ns)."""
    kinds, details = batch.columns.get("kind"), batch.columns.get("details")
    if kinds is None or details is None:
        return
    for row, at_ns in enumerate(batch.log_time_ns.tolist()):
        if kinds[row] == KIND:
            found = answer_of({"kind": KIND, "details": details[row]})
            if found is not None:
                yield at_ns, found
