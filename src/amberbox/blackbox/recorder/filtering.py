"""Which messages are kept: the rate limit, schemas inferred from what is left, what changed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from operator import itemgetter
from typing import TypeAlias

import numpy as np

from amberbox.blackbox.recorder.streams import Stream, Tell, tell_unused
from amberbox.blackbox.unroll import UnrollError
from amberbox.blackbox.unroll.infer import widen
from amberbox.core.types import Topic

OPEN_VERSIONS = 32
"""Schemas of an item until new keys of its messages get columns no more: they are data, ids say."""
MOST_VERSIONS = 256
"""Schemas of an item in all; what does not fit the last one stays raw."""
QUIET_NS = 60_000_000_000
"""Changes of a schema that follow each other within this time are one event."""

Message: TypeAlias = tuple[Stream, bytes, int]


def rate_limited(taken: Iterable[Message], floor_ns: int, now_ns: int) -> list[Message]:
    """Return what the rate limits let pass, in order of time, none before ``floor_ns``."""
    kept: list[Message] = []
    for message in taken:
        stream, _, received_ns = message
        item = stream.item
        if item.options.keep == "none":
            continue
        if not floor_ns <= received_ns <= now_ns:  # stamped before a tick or a new epoch
            message = (stream, message[1], min(max(received_ns, floor_ns), now_ns))
        if item.rate is not None and not item.rate.accept(message[2]):
            item.counters.rate_limited += 1
            continue
        kept.append(message)
    kept.sort(key=itemgetter(2))
    return kept


def change_filtered(kept: list[Message], tell: Tell) -> list[Message]:
    """Infer schemas, then drop what did not change for items that ask for it."""
    places: dict[int, list[int]] = {}
    for place, (stream, _, _) in enumerate(kept):
        if stream.infers or stream.item.options.change is not None:
            places.setdefault(id(stream), []).append(place)
    unchanged: set[int] = set()
    for found in places.values():
        stream = kept[found[0]][0]
        if stream.infers:
            _infer(stream, [kept[place][1] for place in found], kept[found[-1]][2], tell)
        if stream.item.options.change is not None:
            unchanged.update(_unchanged(stream, kept, found))
    if not unchanged:
        return kept
    return [message for place, message in enumerate(kept) if place not in unchanged]


def _infer(stream: Stream, messages: Sequence[bytes], now_ns: int, tell: Tell) -> None:
    """Widen a stream's schema so that it holds all these messages; a wider one is an event."""
    topic, item = stream.topic, stream.item
    if item.versions >= MOST_VERSIONS:
        return
    closes = item.versions >= OPEN_VERSIONS
    schema, bad = widen(
        topic.schema,
        messages,
        topic.message_encoding,
        item.name,
        stream.told,
        closes=closes,
        letters=stream.letters,
    )
    if bad:
        _note_malformed(stream, len(bad), tell)
    if schema is topic.schema:
        return
    before = None if topic.schema is None else stream.columns()
    item.versions += 1
    if item.versions == MOST_VERSIONS:
        text = f"{item.name} had {MOST_VERSIONS} schemas; what does not fit the last one stays raw"
        tell("schema_unstable", text, item.source, item=item.name)
    stream.topic = Topic(topic.name, topic.message_encoding, schema, topic.latched)
    stream.channel = -1
    stream.compile()
    if before is not None:
        _tell_widened(stream, before, now_ns, tell)
    tell_unused(stream, tell)


def _tell_widened(stream: Stream, before: Mapping[str, str], now_ns: int, tell: Tell) -> None:
    """Say what became of a schema, once for changes that follow each other."""
    item, after = stream.item, stream.columns()
    new = [path for path in after if path not in before]
    is_wider = any(after.get(path, kind) != kind for path, kind in before.items())
    change = "wider" if is_wider and not new else "new"
    last_ns = item.widened_ns.get(change)
    item.widened_ns[change] = now_ns
    if last_ns is not None and now_ns - last_ns < QUIET_NS:
        return
    text = f"{item.name} has wider variables"
    if new:
        more = f" and {len(new) - 3} more" if len(new) > 3 else ""
        names = ", ".join(name[:60] for name in new[:3])
        limit = f"new keys get columns until it has had {OPEN_VERSIONS} schemas"
        text = f"{item.name} has new variables: {names}{more} ({limit})"
    elif not is_wider:
        text = f"{item.name} has had {OPEN_VERSIONS} schemas: new keys get no columns any more"
    tell("schema_widened", text, item.source, item=item.name)


def _note_malformed(stream: Stream, count: int, tell: Tell) -> None:
    item = stream.item
    if not item.malformed:
        encoding = stream.topic.message_encoding
        text = f"{item.name}: a message is no valid {encoding}, or nested too deep; kept as it came"
        tell("malformed", text, item.source, item=item.name)
    item.malformed += count


def _unchanged(stream: Stream, kept: list[Message], places: list[int]) -> list[int]:
    """Return the places of messages that the change filter drops; malformed ones stay."""
    if stream.stamps is None or stream.change is None:
        return []
    try:
        rows = stream.stamps.rows([kept[place][1] for place in places])
    except UnrollError as error:
        bad = {places[row] for row in error.bad}
        rest = [place for place in places if place not in bad]
        return _unchanged(stream, kept, rest) if rest else []
    times = np.fromiter((kept[place][2] for place in places), np.int64, len(places))
    mask = stream.change.mask(rows, times)
    dropped = [place for place, keep in zip(places, mask.tolist(), strict=True) if not keep]
    stream.counters.unchanged += len(dropped)
    return dropped
