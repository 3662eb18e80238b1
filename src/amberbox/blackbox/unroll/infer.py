"""Schemas of JSON and MessagePack topics, inferred from their messages and widened as needed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import msgspec

from amberbox.blackbox.unroll.decode import MalformedError, decode_plain, is_exact, make_decoder
from amberbox.blackbox.unroll.jsonschema import from_schema, to_schema
from amberbox.blackbox.unroll.notes import Notes, notes_of
from amberbox.blackbox.unroll.shapes import Shape, close, limit, nullable, observe, remember_names
from amberbox.core.types import Schema


def widen(
    schema: Schema | None,
    messages: Sequence[bytes],
    encoding: str,
    name: str,
    told: Notes | None = None,
    *,
    closes: bool = False,
    letters: bool = False,
) -> tuple[Schema, tuple[int, ...]]:
    """Widen a schema so that all messages unroll under it.

    ``encoding`` is ``json`` or ``msgpack``; ``told`` is what the sender says of units and codes,
    which a schema keeps once it has it. With ``closes`` no object gets further keys; with
    ``letters`` columns keep what words of other scripts say in their names. Returns the
    same object when nothing has changed, and the numbers of the messages that are malformed. The
    kinds of value in the schema depend only on which messages were seen, not on their order;
    column names on which came first.
    """
    fits = _checker(schema.data, encoding) if schema is not None else None
    unknown = [n for n, message in enumerate(messages) if fits is None or not fits(message)]
    if not unknown and schema is not None:
        return schema, ()
    shape = from_schema(schema) if schema is not None else nullable()
    shape.letters = shape.letters or letters
    if closes:
        close(shape)
    bad = [n for n in unknown if not _observed(shape, messages[n], encoding)]
    limit(shape)
    remember_names(shape)
    notes = notes_of(schema) if schema is not None else told
    widened = to_schema(shape, name if schema is None else schema.name, notes)
    same = schema is not None and widened.data == schema.data
    return (schema if same and schema is not None else widened), tuple(bad)


def _observed(shape: Shape, message: bytes, encoding: str) -> bool:
    try:
        value = decode_plain(message, encoding)
        observe(Shape(), value)  # fails before anything is added
        observe(shape, value)
    except (MalformedError, ValueError):
        return False
    return True


@lru_cache(maxsize=256)
def _checker(data: bytes, encoding: str) -> Callable[[bytes], bool]:
    """Make a quick test whether a message adds nothing to a schema."""
    shape = from_schema(Schema("", "jsonschema", data))
    decode = make_decoder(shape, encoding, exact=True)
    exact = is_exact(shape)

    def fits(message: bytes) -> bool:
        try:
            decode(message)
        except (MalformedError, msgspec.MsgspecError, ValueError):
            return False
        return exact

    return fits
